"""What an attacker wants: costs psi of the planned trajectory, to be made small.

A cost is any callable DPCSolution -> `(*batch,)`. Two optional methods let it know more than the plan: `at(step)`
returns the cost of a plan made at a step of the run, and `given(u_ini=..., y_ini=..., y_ref=..., u_ref=...)` the cost
of a plan made when the unattacked window and the references are these. Every attack asks for both, once a call.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, as_index, last_rows, to_horizon
from ..data.hankel import HankelData
from ..data.predictor import Predictor
from ..problem.weights import weight_matrix
from ..reprs import Described, shown
from ..solution import DPCSolution

#: A cost of a plan, `(*batch,)`; any callable will do.
Cost = Callable[[DPCSolution], Tensor]

#: Where the predicted outputs follow the reference to this fraction of their size, the difference is rounding.
FOLLOWED = 1e-10


class TargetInput:
    """psi(u) = 1/2 |u - u_target|^2: make the controller apply the attacker's input (the paper's cost).

    Args:
        u_target: `(n_u,)` or `(horizon, n_u)`, in the units of the inputs. Where a plan has another horizon, the rows
            are cut, or the last one held.
        trajectory: instead, a target for the whole run, `(>= steps, n_u)`: the plan of step k is compared with its rows
            k, ..., k + horizon - 1, the last row held beyond its end.
    """

    def __init__(self, u_target: Any = None, *, trajectory: Any = None):
        if (u_target is None) == (trajectory is None):
            raise ValueError("give either `u_target` or `trajectory=`.")
        name, value = ("u_target", u_target) if trajectory is None else ("trajectory", trajectory)
        self.target = as_data(name, value, integers=True)
        self.moves = trajectory is not None
        self._name = name
        if self.target.ndim not in ((2,) if self.moves else (1, 2)) or not self.target.numel():
            wanted = "(>= steps, n_u)" if self.moves else "(n_u,) or (horizon, n_u)"
            raise ValueError(f"`{name}` must have shape {wanted}, got {tuple(self.target.shape)}.")

    def at(self, step: int) -> Cost:
        """Return the cost of a plan made at a step of the run."""
        if self.moves:
            step = as_index("`step` must be an integer, 0 or more", step)
            if step < 0:
                raise ValueError(f"`step` must be an integer, 0 or more, got {step}.")

        def psi(solution: DPCSolution) -> Tensor:
            target = self.rows_at(step, solution.u.shape[-2]).to(solution.u)
            if target.shape[-1] != solution.u.shape[-1]:
                came = f"{target.shape[-1]} channels for plans of {solution.u.shape[-1]}"
                raise ValueError(f"`{self._name}` must have one value for each input, got {came}.")
            return 0.5 * (solution.u - target).square().sum((-2, -1))

        return psi

    def rows_at(self, step: int, horizon: int) -> Tensor:
        """Return the inputs wanted of a plan made at a step, `(horizon, n_u)`, or `(n_u,)` for all of its steps."""
        target = self.target[min(step, len(self.target) - 1) :] if self.moves else self.target
        return to_horizon(target, horizon)

    def __call__(self, solution: DPCSolution) -> Tensor:
        """Return psi of a plan made at step 0, `(*batch,)`."""
        return self.at(0)(solution)

    def __repr__(self) -> str:
        return f"TargetInput({self._name}={shown(self.target)})"


class TrackingError(Described):
    """psi = -1/2 |y_true - y_ref|_Q^2: drive the true output away from its reference.

    The plan's own y is what the controller was made to believe. y_true is what its inputs will do: the output that the
    data predict for u* from the *unattacked* window (:class:`torch_dpc.attacks.Predictor`). Where that follows the
    reference to 1e-10 the error counts as none: psi has its maximum there and no direction leads down, so the attack of
    one step is zero; give attacks `restarts=`.

    Args:
        data: the recording that predicts, usually `layer.data`.
        Q: output weight, as the layer takes it.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> attack = dpc.attacks.LinearizedAttack(layer, TrackingError(data, Q=10.0), dpc.attacks.RelativeBall(0.01))
        >>> attack(u[:4], y[:4], y_ref=torch.ones(4)).shape
        torch.Size([4, 4])
    """

    def __init__(self, data: HankelData, Q: Any = 1.0):
        self.predictor = Predictor(data)
        self.Q = weight_matrix("Q", Q, data.n_y, data.horizon)

    def given(self, *, u_ini: Tensor, y_ini: Tensor, y_ref: Any = None, u_ref: Any = None) -> Cost:
        """Return the cost of a plan made from a window that is truly (u_ini, y_ini), under this reference."""
        t_ini, horizon = self.predictor.t_ini, self.predictor.horizon
        u_ini, y_ini = last_rows(u_ini, t_ini), last_rows(y_ini, t_ini)
        reference = torch.zeros(()) if y_ref is None else to_horizon(as_data("y_ref", y_ref, integers=True), horizon)

        def psi(solution: DPCSolution) -> Tensor:
            if solution.u.shape[-2] != horizon:
                raise ValueError(
                    f"the plans have {solution.u.shape[-2]} steps and the `data` of TrackingError predict {horizon}: "
                    "give it the data of the attacker's own layer."
                )
            y_true = self.predictor(u_ini, y_ini, solution.u)
            wanted = reference.to(y_true).expand_as(y_true)
            scale = torch.maximum(y_true.detach().abs(), wanted.abs()).amax((-2, -1), keepdim=True)
            error = y_true - wanted
            error = torch.where(error.abs() > FOLLOWED * scale, error, 0.0).flatten(-2)
            return -0.5 * (error * (error @ self.Q.to(error))).sum(-1)

        return psi

    def __call__(self, solution: DPCSolution) -> Tensor:
        """Refuse: a plan alone does not say where the system is."""
        raise ValueError(
            "`TrackingError` needs the unattacked window: call cost.given(u_ini=..., y_ini=..., y_ref=...)."
        )


class BoundViolation(Described):
    """psi = -(sum of what the planned outputs exceed bounds by): take the controller's plan away.

    A problem with hard bounds has no violation; it has no plan. So give the attack a surrogate of the controller whose
    outputs have a soft box (:class:`torch_dpc.SoftBox`) of a high price: it leaves the box only where it must, and
    there the same problem with hard bounds is infeasible. Bounds of the cost that are narrower than the box lead there.
    y_ini enters the cost of a plan and none of its constraints: only an attack on u_ini
    (:class:`torch_dpc.attacks.AttackOn`) can take the plan away.

    Args:
        lower, upper: of the outputs, a number, `(n_y,)` or `(horizon, n_y)`, in their units.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> soft = dpc.SoftBox(-0.2, 0.2, weight=1e3)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, y_set=soft)
        >>> cost = BoundViolation(-0.1, 0.1)
        >>> p = dpc.attacks.LinearizedAttack(layer, cost, dpc.BallBudget(0.1))(u[:4], y[:4])
        >>> bool(cost(layer(u[:4], y[:4] + p)) < cost(layer(u[:4], y[:4])))
        True
    """

    def __init__(self, lower: Any, upper: Any):
        self.lower, self.upper = as_data("lower", lower), as_data("upper", upper)
        if not bool((self.lower <= self.upper).all()):
            raise ValueError(f"`lower` must be at most `upper`, got {lower!r} and {upper!r}.")

    def __call__(self, solution: DPCSolution) -> Tensor:
        """Return psi, `(*batch,)`."""
        if not hasattr(solution, "y"):
            raise ValueError("`BoundViolation` needs the planned outputs: give the attack a DPCLayer.")
        above = (solution.y - self.upper.to(solution.y)).clamp_min(0.0)
        below = (self.lower.to(solution.y) - solution.y).clamp_min(0.0)
        return -(above + below).sum((-2, -1))


def check_cost(cost: Any, name: str = "cost") -> None:
    """Raise ValueError unless a cost can be called, or made callable for a step or a window."""
    if isinstance(cost, type) or not (callable(cost) or hasattr(cost, "at") or hasattr(cost, "given")):
        came = f"the class {cost.__name__}: make an object of it" if isinstance(cost, type) else type(cost).__name__
        raise ValueError(f"`{name}` must be a callable DPCSolution -> (*batch,), got {came}.")


def at_step(cost: Any, step: int) -> Cost:
    """Return the cost of a plan made at a step; a cost without `at` is the same at every step."""
    return cost.at(step) if hasattr(cost, "at") else cost


def bound(cost: Any, step: int, u_ini: Tensor, y_ini: Tensor, y_ref: Any = None, u_ref: Any = None) -> Cost:
    """Return the cost of a plan made at a step, from this unattacked window and for these references."""
    cost = at_step(cost, step)
    return cost.given(u_ini=u_ini, y_ini=y_ini, y_ref=y_ref, u_ref=u_ref) if hasattr(cost, "given") else cost
