"""The worst perturbation of a window, with a proof: the global minimum of the attacker's cost over a budget."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ... import plot
from ...checks import as_data, check_number, check_type
from ...errors import Status
from ...layer import DPCLayer
from ..base import within_budget
from ..budgets import Budget
from ..costs import TargetInput
from ..gradient import ProjectedGradientAttack
from .complementarity import Array, Budgeted, Rows, in_few_variables
from .relaxation import Quadratic
from .search import Search, search
from .tighten import others_that_reach, tighten

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ExactSettings:
    """Constants of the search."""

    restarts: int = 5  # walks of projected gradient that give the first value
    steps: int = 30  # of each
    samples: int = 200  # random perturbations that show which rows reach their bounds
    rounds: int = 2  # of interval tightening
    share: float = 0.5  # of the time limit that tightening may take


SETTINGS = ExactSettings()
#: The gap may exceed the tolerance by this much where the dual objective of the last program was rounded down.
SOLVER_ROUNDING = 5e-7


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The global minimum of psi over a budget.

    Attributes:
        p: the worst perturbation found, `(*batch, t_ini, n_y)`; it is in the budget, and psi there was computed by the
            layer itself.
        value: psi of the plan at y_ini + p, `(*batch,)`, float64.
        bound: no perturbation of the budget gives a smaller psi, `(*batch,)`, float64.
        gap: (value - bound) / |value|, `(*batch,)`.
        status: "optimal" where the gap is at most the tolerance, else "time limit"; of a batch, a list, flattened.
        nominal: psi without an attack, `(*batch,)`.
        nodes, seconds: convex programs solved by the search, and time taken, `(*batch,)`.
    """

    p: Tensor
    value: Tensor
    bound: Tensor
    gap: Tensor
    status: str | list[str]
    nominal: Tensor
    nodes: Tensor
    seconds: Tensor

    def plot(self, axes: Any = None) -> Figure:
        """Draw p, and its cost between the bound and that without an attack: :func:`torch_dpc.plot.worst_case`."""
        return plot.worst_case(self, axes)

    def __repr__(self) -> str:
        if self.value.ndim == 0:
            return (
                f"WorstCase(value={float(self.value):.6g}, bound={float(self.bound):.6g}, gap={float(self.gap):.1e}, "
                f"status={self.status!r}, nominal={float(self.nominal):.6g}, nodes={int(self.nodes)}, "
                f"seconds={float(self.seconds):.1f})"
            )
        proven = sum(status == "optimal" for status in self.status)
        return f"WorstCase(batch={tuple(self.value.shape)}, {proven} of {len(self.status)} optimal)"


def worst_case(
    layer: DPCLayer,
    cost: TargetInput,
    budget: Budget,
    u_ini: Any,
    y_ini: Any,
    *,
    y_ref: Any = None,
    u_ref: Any = None,
    time_limit: float = 60.0,
    step: int = 0,
    tolerance: float = 1e-4,
) -> WorstCase:
    """Minimise psi(u*(p)) = 1/2 |u*(p) - u_target|^2 over the budget, with a proven lower bound.

    The plan is the solution of a complementarity system (:mod:`torch_dpc.attacks.exact.complementarity`), psi is convex
    in its variables, and what is not convex is which row is at which bound. Branch and bound decides that: a node
    leaves some rows undecided and relaxes them to the convex hull of their states. The intervals that the hull needs
    come from the nonexpansiveness of the projection and from convex programs over the budget; there is no big M to
    guess. Rows that cannot reach a bound carry no decision. Perturbations that leave the controller without a plan have
    no psi and are left out.

    Args:
        layer: the controller's layer; its sets are boxes, and it is one problem, not a batch of weights.
        cost: the attacker's target.
        budget: a ball, box, ellipsoid, balls for each channel, or any other that has `norm_bounds`.
        u_ini, y_ini: the true windows, `(*batch, t_ini, n)`; each sample is a search of its own.
        y_ref, u_ref: references, as the layer takes them.
        time_limit: for each sample [s].
        step: of the run, for a target that moves with it.
        tolerance: relative gap at which the search stops; at least 1e-6, the accuracy of the convex programs.

    Raises:
        ImportError: Clarabel is missing (extra `exact`).
        ValueError: a cost, budget or layer of another kind; bad windows.
        SolveError: there is no plan without an attack.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=5)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-0.5, 0.5))
        >>> cost = dpc.attacks.TargetInput(torch.ones(2))
        >>> result = worst_case(layer, cost, dpc.attacks.RelativeBall(0.1), u[:4], y[:4])
        >>> result.status, bool(result.bound <= result.value < result.nominal)
        ('optimal', True)
    """
    try:
        import clarabel  # noqa: F401  # the convex programs need it; say so before any work
    except ImportError as error:
        raise ImportError("`worst_case` needs Clarabel: pip install 'torch_dpc[exact]'.") from error
    if not isinstance(cost, TargetInput):
        raise ValueError(f"`cost` must be a TargetInput, whose psi is convex in the plan, got {type(cost).__name__}.")
    check_type("layer", layer, DPCLayer)
    check_type("budget", budget, Budget)
    if not layer.has_bounds:
        raise ValueError("`layer` must have boxes as its sets: curved sets have more than three states a row.")
    check_number("time_limit", time_limit, positive=True, finite=False)
    if not check_number("tolerance", tolerance, kind="at least 1e-6 and finite") >= 1e-6:
        raise ValueError(f"`tolerance` must be at least 1e-6, got {tolerance!r}.")
    u_ini, y_ini = as_data("u_ini", u_ini), as_data("y_ini", y_ini)
    theta, _ = layer.flatten(u_ini, y_ini, y_ref, u_ref)
    batch = theta.shape[:-1]
    flat = theta.reshape(-1, theta.shape[-1]).detach()
    results = [_Window(layer, cost, budget, one, step, time_limit, tolerance).solve() for one in flat]
    p = torch.stack([result[0] for result in results]) if results else y_ini.new_zeros(0, *y_ini.shape[-2:])
    columns = torch.tensor([result[1] for result in results], dtype=torch.float64).reshape(-1, 5)
    value, bound, nominal, nodes, seconds = (column.reshape(batch) for column in columns.unbind(1))
    gap = (value - bound) / value.abs().clamp_min(torch.finfo(torch.float64).tiny)
    status = ["optimal" if g <= tolerance + SOLVER_ROUNDING else "time limit" for g in gap.flatten().tolist()]
    return WorstCase(
        p=p.reshape(*batch, *p.shape[1:]).to(y_ini),
        value=value,
        bound=bound,
        gap=gap,
        status=status if batch else status[0],
        nominal=nominal,
        nodes=nodes.long(),
        seconds=seconds,
    )


class _Window:
    """The search of one window."""

    def __init__(
        self,
        layer: DPCLayer,
        cost: TargetInput,
        budget: Budget,
        theta: Tensor,
        step: int,
        time_limit: float,
        tolerance: float,
    ):
        self.began = time.monotonic()
        self.deadline = self.began + time_limit
        self.tighten_until = self.began + SETTINGS.share * time_limit
        data = layer.data
        sizes = [n * data.t_ini for n in (data.n_u, data.n_y)] + [n * data.horizon for n in (data.n_u, data.n_y)]
        u_ini, y_ini, u_ref, y_ref = theta.split(sizes)
        u_of_window = theta[: data.t_ini * data.n_u].reshape(-1, data.n_u)
        budget = budget.given(u_of_window)
        self.layer, self.cost, self.budget, self.step, self.tolerance = layer, cost, budget, step, tolerance
        self.u_ini, self.y_ini = u_ini.reshape(-1, data.n_u), y_ini.reshape(-1, data.n_y)
        self.refs = {"y_ref": y_ref.reshape(-1, data.n_y), "u_ref": u_ref.reshape(-1, data.n_u)}
        reduction = layer.reduction.detach()
        self.v0, self.G = (x.cpu().numpy() for x in (reduction.V @ theta, reduction.G))
        Vp = reduction.V[:, sizes[0] : sizes[0] + sizes[1]].cpu().numpy()
        lower, upper = (b.detach().cpu().expand(len(self.v0)).numpy() for b in layer.bounds(theta.device))
        self.bounds = lower, upper
        self.of_s: Budgeted = in_few_variables(Vp, budget.norm_bounds(self.y_ini))
        self.A = Vp @ self.of_s.N
        self.n_u = data.horizon * data.n_u
        self.target = cost.rows_at(step, data.horizon).double().cpu().expand(data.horizon, data.n_u).flatten().numpy()

    def solve(self) -> tuple[Tensor, tuple[float, float, float, float, float]]:
        """Return p, and value, bound, psi without an attack, nodes and seconds."""
        nominal = self.layer(self.u_ini, self.y_ini, **self.refs, on_failure="raise")
        psi = float(self.cost.at(self.step)(nominal))
        found = Search(np.zeros(self.A.shape[1]), psi, bound=psi)
        if self.A.size:
            active = self._first(found)
            rows, cost = self._rows(nominal.lam.cpu().numpy(), active, found)
            search(
                *(rows, self.of_s.pieces, cost, self._replay, found),
                tolerance=self.tolerance,
                deadline=self.deadline,
            )
            found.bound -= self._effect_of_unseen(rows, found.value)
        seconds = time.monotonic() - self.began
        return self._perturbation(found.s), (found.value, found.bound, psi, float(found.nodes), seconds)

    def _first(self, found: Search) -> NDArray[np.bool_]:
        """Note the answer of projected gradient; return which rows are active under it or a random perturbation."""
        generator = torch.Generator(self.y_ini.device).manual_seed(0)
        attack = ProjectedGradientAttack(self.layer, self.cost, self.budget, SETTINGS.steps, restarts=SETTINGS.restarts)
        p = attack(self.u_ini, self.y_ini, **self.refs, generator=generator, step=self.step)
        s = np.linalg.lstsq(self.of_s.N, p.flatten().cpu().numpy(), rcond=None)[0]
        value = self._replay(s)
        if value < found.value:
            found.s, found.value = s, value
        many = self.y_ini.expand(SETTINGS.samples, -1, -1)
        y_ini = torch.cat([many + self.budget.random(many, generator), (self.y_ini + p)[None]])
        plans = self.layer(self.u_ini.expand(len(y_ini), -1, -1), y_ini, **self.refs, on_failure="nan")
        solved = plans.info.status == Status.SOLVED
        return (plans.lam[solved] != 0).any(0).cpu().numpy()

    def _rows(self, lam: Array, active: NDArray[np.bool_], found: Search) -> tuple[Rows, Quadratic]:
        """Return the rows that may reach a bound, their intervals tightened, and psi over s and their multipliers.

        Inputs come first. Another row is added if the plan that does not know its bound could pass it; where none
        could, that plan is the plan of the whole problem.
        """
        finite = np.isfinite(self.bounds[0]) | np.isfinite(self.bounds[1])
        chosen = finite & (active | (lam != 0) | (np.arange(len(lam)) < self.n_u))
        while True:
            index = np.flatnonzero(chosen)
            nominal = self.v0 - self.G @ lam, lam
            rows = Rows.of(index, self.v0, self.A, self.G, self.bounds, nominal, self.of_s)
            for _ in range(SETTINGS.rounds):
                tighten(rows, self.of_s, self.tighten_until)
            rest = np.flatnonzero(finite & ~chosen)
            other = self.v0[rest], self.A[rest], self.G[np.ix_(rest, index)]
            ends = self.bounds[0][rest], self.bounds[1][rest]
            more = others_that_reach(rows, self.of_s, *other, ends, self.tighten_until)
            if not more:
                return rows, self._psi(rows)
            chosen[rest[more]] = True

    def _psi(self, rows: Rows) -> Quadratic:
        B_lam = -self.G[: self.n_u, rows.index]
        return Quadratic(self.v0[: self.n_u] - self.target, self.A[: self.n_u], B_lam)

    def _effect_of_unseen(self, rows: Rows, value: float) -> float:
        """Return by how much the directions of p that were dropped can lower psi."""
        values = np.linalg.eigvalsh(rows.G) if len(rows.G) else np.ones(1)
        moved = self.of_s.unseen * float(np.sqrt(values[-1] / values[values > 1e-12 * values[-1]][0]))
        return moved * (2 * value) ** 0.5

    def _perturbation(self, s: Array) -> Tensor:
        p = torch.from_numpy(self.of_s.N @ s).to(self.y_ini).reshape(self.y_ini.shape)
        return within_budget(self.budget.project(p, self.y_ini), self.y_ini, self.budget)

    def _replay(self, s: Array) -> float:
        plan = self.layer(self.u_ini, self.y_ini + self._perturbation(s), **self.refs, on_failure="nan")
        return float(self.cost.at(self.step)(plan)) if int(plan.info.status) == Status.SOLVED else np.inf
