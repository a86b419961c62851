"""The objective: what scaled weights cost without and under attack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..attacks.budgets import Budget
from ..attacks.costs import Cost, check_cost
from ..attacks.gradient import LinearizedAttack
from ..checks import as_data, check_callable, check_count, check_number, check_type
from ..errors import Status
from ..factors import Factored
from ..layer import DPCLayer
from ..reprs import Described
from .gain import plan_gain
from .outcome import OutputModel, QuadraticCost, RunCost
from .scales import WeightScales, base_weight, with_weights

#: layer -> attack, with the call of every attack.
AttackMaker = Callable[[DPCLayer], Callable[..., Tensor]]


@dataclass(frozen=True, eq=False, repr=False)
class Windows(Described):
    """Where the runs that are judged begin.

    Attributes:
        u_ini, y_ini: past windows, unattacked, `(B, t_ini, n)`.
        y_ref, u_ref: references from the first step of the plan on: `(n,)`, or `(steps, n)`, or `(B, steps, n)`; the
            last row is held beyond its end. u_ref is zero by default.
    """

    u_ini: Tensor
    y_ini: Tensor
    y_ref: Tensor
    u_ref: Tensor | None = None

    def __post_init__(self) -> None:
        past = [as_data(name, getattr(self, name)) for name in ("u_ini", "y_ini")]
        if any(w.ndim != 3 for w in past) or past[0].shape[:2] != past[1].shape[:2]:
            came = " and ".join(str(tuple(w.shape)) for w in past)
            raise ValueError(f"`windows` must hold u_ini and y_ini of shape (B, t_ini, n), of one B, got {came}.")
        as_data("y_ref", self.y_ref)
        if self.u_ref is not None:
            as_data("u_ref", self.u_ref)


class RobustObjective(Described):
    """What a layer with scaled weights costs without and under attack; differentiable in the scales.

    Args:
        layer: the planning problem; its weights are where the scales start.
        windows: where the runs begin.
        budget: what the attacker may add to a window.
        psi: what the attacker minimises, a callable DPCSolution -> `(*batch,)`, as the attacks take it; with `at(step)`
            it moves with the run, step 0 being the first of the run here. By default minus the cost of the plan in
            force: the attacker wants the worst.
        predictor: what inputs truly do: `tuning.Predictor(other_data)` of a recording that the layer has not seen, or a
            model. It must be given: data that judge their own plans let the objective fall while the closed loop gets
            worse.
        cost: of a run; by default the quadratic one with the layer's present Q and R.
        plans: how many plans a run has, each from the window that the one before left.
        replan_every: steps of each plan that are applied; by default all.
        attacked_weight: of the cost under attack, beside a nominal one of weight 1.
        gain_weight: of :func:`torch_dpc.tuning.plan_gain`, how strongly the plan answers to any perturbation at all.
        through: "danskin" or "attack".
        iterations: linearised steps of the attacker, each from the last answer; 1 is Algorithm 1. More raise a convex
            cost further, as the default psi is one between kinks.
        attack: instead of that attacker, a callable layer -> attack; for "danskin" only.

    Example:
        >>> from torch_dpc import DPCLayer, HankelData, attacks, collect, systems
        >>> u, y = collect(systems.OscillatingMasses(), 120, generator=torch.Generator().manual_seed(0))
        >>> data = HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> windows = Windows(u[None, :4], y[None, :4], y_ref=torch.zeros(4))
        >>> other = collect(systems.OscillatingMasses(), 120, generator=torch.Generator().manual_seed(1))
        >>> from torch_dpc.tuning import Predictor, tune
        >>> predictor = Predictor(HankelData.from_trajectories(*other, t_ini=4, horizon=10))
        >>> objective = RobustObjective(
        ...     layer, windows, attacks.RelativeBall(0.1), predictor=predictor, plans=3, replan_every=5)
        >>> result = tune(objective, steps=3)
        >>> result.history[0]["total"] > result.best["total"]
        True
    """

    def __init__(
        self,
        layer: DPCLayer,
        windows: Windows,
        budget: Budget,
        *,
        psi: Any = None,
        predictor: OutputModel | None = None,
        cost: RunCost | None = None,
        plans: int = 1,
        replan_every: int | None = None,
        attacked_weight: float = 1.0,
        gain_weight: float = 0.0,
        through: str = "attack",
        iterations: int = 1,
        attack: AttackMaker | None = None,
    ):
        check_type("layer", layer, DPCLayer)
        check_type("windows", windows, Windows)
        check_type("budget", budget, Budget)
        if predictor is None:
            raise ValueError(
                "`predictor` must say what inputs truly do, as the data of the layer would judge their own plans: give "
                "tuning.Predictor(other_data) of another recording, or a model (u_ini, y_ini, u) -> y."
            )
        check_callable("predictor", predictor)
        for name, value in (("cost", cost), ("attack", attack)):
            check_callable(name, value, optional=True)
        if psi is not None:
            check_cost(psi, "psi")
        horizon = layer.data.horizon
        replan_every = horizon if replan_every is None else replan_every
        check_count("plans", plans)
        check_count("replan_every", replan_every)
        check_count("iterations", iterations)
        if replan_every > horizon:
            raise ValueError(f"`replan_every` must be at most the horizon, {horizon}, got {replan_every}.")
        if through not in ("danskin", "attack"):
            raise ValueError(f'`through` must be "danskin" or "attack", got {through!r}.')
        if attack is not None and through != "danskin":
            raise ValueError('an `attack` of your own has no derivative here: take `through="danskin"`.')
        check_number("attacked_weight", attacked_weight)
        check_number("gain_weight", gain_weight)
        self.layer, self.budget, self.psi, self.attack = layer, budget, psi, attack
        self.plans, self.replan_every, self.iterations = plans, replan_every, iterations
        self.attacked_weight, self.gain_weight, self.through = attacked_weight, gain_weight, through
        self.predictor = predictor
        self.cost = _own_cost(layer) if cost is None else cost
        self.u_ini, self.y_ini = _past(windows)
        rows = (plans - 1) * replan_every + horizon
        u_ref = torch.zeros(layer.data.n_u) if windows.u_ref is None else windows.u_ref
        self.y_ref = _reference("y_ref", windows.y_ref, len(self.u_ini), rows, layer.data.n_y)
        self.u_ref = _reference("u_ref", u_ref, len(self.u_ini), rows, layer.data.n_u)

    def __call__(self, scales: WeightScales) -> dict[str, Tensor]:
        """Return means over the windows, `nominal` and `attacked`, the `gain`, and `total`, their weighted sum.

        The gain is left out where its weight is zero.
        """
        planner = self._planner(scales)
        nominal, attacked = (cost.mean() for cost in self._costs(planner))
        values = {"nominal": nominal, "attacked": attacked, "total": nominal + self.attacked_weight * attacked}
        if self.gain_weight:
            values["gain"] = plan_gain(planner)
            values["total"] = values["total"] + self.gain_weight * values["gain"]
        return values

    def costs(self, scales: WeightScales) -> tuple[Tensor, Tensor]:
        """Return the cost of every run, without and under attack, `(B,)` each."""
        return self._costs(self._planner(scales))

    def _planner(self, scales: WeightScales) -> _FactoredOnce:
        return with_weights(_FactoredOnce, self.layer, scales(self.layer))

    def _costs(self, planner: DPCLayer) -> tuple[Tensor, Tensor]:
        perturb = self._attacker(planner)
        B, data = len(self.u_ini), self.layer.data
        u_ini, y_ini = self.u_ini.repeat(2, 1, 1), self.y_ini.repeat(2, 1, 1)  # the nominal runs, then the attacked
        us, ys = [], []
        for k in range(self.plans):
            now = slice(k * self.replan_every, k * self.replan_every + data.horizon)
            y_ref, u_ref = self.y_ref[:, now], self.u_ref[:, now]
            p = perturb(u_ini[B:], y_ini[B:], y_ref=y_ref, u_ref=u_ref, step=now.start)
            p = torch.cat([torch.zeros_like(p), p.detach() if self.through == "danskin" else p])
            plan = planner(u_ini, y_ini + p, y_ref=y_ref.repeat(2, 1, 1), u_ref=u_ref.repeat(2, 1, 1), on_failure="nan")
            solved = (plan.info.status == Status.SOLVED)[:, None, None]
            u = torch.where(solved, plan.u, u_ini[:, -1:])  # no plan: the last input goes on
            y = self.predictor(u_ini, y_ini, u)
            us.append(u[:, : self.replan_every])
            ys.append(y[:, : self.replan_every])
            u_ini = torch.cat([u_ini, us[-1]], dim=1)[:, -data.t_ini :]
            y_ini = torch.cat([y_ini, ys[-1]], dim=1)[:, -data.t_ini :]
        steps = self.plans * self.replan_every
        references = (self.u_ref[:, :steps].repeat(2, 1, 1), self.y_ref[:, :steps].repeat(2, 1, 1))
        costs = self.cost(torch.cat(us, dim=1), torch.cat(ys, dim=1), *references)
        return costs[:B], costs[B:]

    def _attacker(self, planner: DPCLayer) -> Callable[..., Tensor]:
        psi = WorstRun(self.cost, self.predictor) if self.psi is None else self.psi
        if self.through == "attack" and torch.is_grad_enabled():
            return LinearizedAttack(planner, psi, self.budget, iterations=self.iterations, keeps_graph=True)
        constant = planner
        weights = {name: getattr(planner, name) for name in ("Q", "R", "lambda_g", "lambda_s")}
        if any(w.requires_grad for w in weights.values()):
            constant = with_weights(_FactoredOnce, self.layer, {name: w.detach() for name, w in weights.items()})
        if self.attack is not None:
            return self.attack(constant)
        return LinearizedAttack(constant, psi, self.budget, iterations=self.iterations)


@dataclass(frozen=True)
class WorstRun:
    """psi = -(what the plan would truly cost): the attacker wants the worst.

    Attributes:
        cost: of a run.
        predictor: what inputs truly do from the unattacked window on.
    """

    cost: RunCost
    predictor: OutputModel

    def given(self, *, u_ini: Tensor, y_ini: Tensor, y_ref: Tensor, u_ref: Tensor) -> Cost:
        """Return psi of a plan made from this unattacked window for these references."""
        return lambda plan: -self.cost(plan.u, self.predictor(u_ini, y_ini, plan.u), u_ref, y_ref)


class _FactoredOnce(DPCLayer):
    """A layer for one evaluation: its weights never change, so the factors, graph included, are made once."""

    _kept: Factored | None = None

    def factored(self, device: torch.device) -> Factored:
        if self._kept is None:
            self._kept = super().factored(device)
        return self._kept


def _own_cost(layer: DPCLayer) -> QuadraticCost:
    """Return the layer's cost with its present weights of one step."""
    data = layer.data
    Q, R = base_weight("Q", layer.Q, data.n_y), base_weight("R", layer.R, data.n_u)
    if len(Q) != data.n_y or len(R) != data.n_u:
        raise ValueError("Q or R of the layer spans the horizon: say with `cost=` what a run costs.")
    return QuadraticCost(Q.clone(), R.clone())


def _past(windows: Windows) -> tuple[Tensor, Tensor]:
    """Return u_ini and y_ini, checked, in float64."""
    u_ini, y_ini = (as_data(name, getattr(windows, name)).double() for name in ("u_ini", "y_ini"))
    if u_ini.ndim != 3 or y_ini.ndim != 3 or len(u_ini) != len(y_ini) or len(u_ini) == 0:
        raise ValueError(
            "`windows` must hold u_ini and y_ini of shape (B, t_ini, n), B at least 1, got "
            f"{tuple(u_ini.shape)} and {tuple(y_ini.shape)}."
        )
    return u_ini, y_ini


def _reference(name: str, value: Any, windows: int, rows: int, channels: int) -> Tensor:
    """Return a reference `(windows, rows, channels)`, its last row held beyond its end."""
    tensor = as_data(name, value).double()
    tensor = tensor[None] if tensor.ndim == 1 else tensor
    if tensor.ndim not in (2, 3) or tensor.shape[-1] != channels or tensor.ndim == 3 and len(tensor) != windows:
        raise ValueError(
            f"`{name}` must have shape ({channels},), (steps, {channels}) or ({windows}, steps, {channels}), "
            f"got {tuple(tensor.shape)}."
        )
    tensor = tensor[..., :rows, :].expand(windows, -1, -1)
    return torch.cat([tensor, tensor[:, -1:].expand(-1, rows - tensor.shape[1], -1)], dim=1)
