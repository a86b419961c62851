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
from ...checks import as_data, check_number
from ...errors import Status
from ...layer import DPCLayer
from ..budgets import Budget
from ..costs import TargetInput
from ..gradient import ProjectedGradientAttack
from .complementarity import FREE, Array, Rows, allowed_states
from .moments import Moments
from .relaxation import DUAL_SLACK, Quadratic
from .search import Search, search
from .shrink import shrink
from .tighten import others_that_reach, tighten
from .window import Window, check_problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ExactSettings:
    """Constants of the search."""

    restarts: int = 5  # walks of projected gradient that give the first value
    steps: int = 30  # of each
    samples: int = 200  # random perturbations that show which rows reach their bounds
    rounds: int = 2  # of interval tightening
    share: float = 0.5  # of the time limit that each kind of tightening may take
    moment_rounds: int = 3  # of caps by channel, each followed by a bound
    progress: float = 0.02  # of the gap that a round must close for another one
    precision: float = 0.1  # of the tolerance, to which a moment relaxation is solved


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
    in its variables, and what is not convex is which row is at which bound. A moment relaxation bounds psi over all
    active sets at once (:mod:`torch_dpc.attacks.exact.moments`). What it leaves open is decided by branch and bound: a
    node leaves some rows undecided and relaxes them to the convex hull of their states. Intervals and multiplier bounds
    come from the nonexpansiveness of the projection and from programs over the budget; there is no big M to guess. Rows
    that cannot reach a bound carry no decision. Perturbations that leave the controller without a plan have no psi and
    are left out.

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
    check_problem(layer, budget)
    check_number("time_limit", time_limit, positive=True, finite=False)
    if not check_number("tolerance", tolerance, kind="at least 1e-6 and finite") >= 1e-6:
        raise ValueError(f"`tolerance` must be at least 1e-6, got {tolerance!r}.")
    u_ini, y_ini = as_data("u_ini", u_ini), as_data("y_ini", y_ini)
    theta, _ = layer.flatten(u_ini, y_ini, y_ref, u_ref)
    batch = theta.shape[:-1]
    flat = theta.reshape(-1, theta.shape[-1]).detach()
    results = [_Proof(Window(layer, budget, one), cost, step, time_limit, tolerance).solve() for one in flat]
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


class _Proof:
    """The search of one window."""

    def __init__(self, window: Window, cost: TargetInput, step: int, time_limit: float, tolerance: float):
        self.began = time.monotonic()
        self.deadline = self.began + time_limit
        self.share_of_time = SETTINGS.share * time_limit
        self.window, self.cost, self.step, self.tolerance = window, cost.at(step), step, tolerance
        self.target_input = cost
        horizon = window.layer.data.horizon
        target = cost.rows_at(step, horizon).double().cpu().expand(horizon, -1)
        self.target = target.flatten().numpy()

    def solve(self) -> tuple[Tensor, tuple[float, float, float, float, float]]:
        """Return p, and value, bound, psi without an attack, nodes and seconds."""
        window = self.window
        psi = float(self.cost(window.nominal))
        found = Search(np.zeros(window.A.shape[1]), psi, bound=psi)
        if window.A.size:
            active = self._first(found)
            rows = self._reachable()
            if rows.H is None:
                rows, least = self._rows(active), 0.0  # psi is not negative
            else:
                least = self._by_moments(rows, found)
            if least < found.value - self.tolerance * abs(found.value) and time.monotonic() < self.deadline:
                pieces = window.of_s.pieces
                search(
                    *(rows, pieces, self._psi(rows), self._replay, found),
                    tolerance=self.tolerance,
                    deadline=self.deadline,
                )
                least = max(least, found.bound)
            found.bound = min(least, found.value) - self._effect_of_unseen(rows, found.value)
        seconds = time.monotonic() - self.began
        return window.perturbation(found.s), (found.value, found.bound, psi, float(found.nodes), seconds)

    def _first(self, found: Search) -> NDArray[np.bool_]:
        """Note the answer of projected gradient; return which rows are active under it or a random perturbation."""
        window = self.window
        generator = torch.Generator(window.y_ini.device).manual_seed(0)
        attack = ProjectedGradientAttack(
            window.layer, self.target_input, window.budget, SETTINGS.steps, restarts=SETTINGS.restarts
        )
        p = attack(window.u_ini, window.y_ini, **window.refs, generator=generator, step=self.step)
        s = np.linalg.lstsq(window.of_s.N, p.flatten().cpu().numpy(), rcond=None)[0]
        value = self._replay(s)
        if value < found.value:
            found.s, found.value = s, value
        many = window.y_ini.expand(SETTINGS.samples, -1, -1)
        y_ini = torch.cat([many + window.budget.random(many, generator), (window.y_ini + p)[None]])
        plans = window.layer(window.u_ini.expand(len(y_ini), -1, -1), y_ini, **window.refs, on_failure="nan")
        solved = plans.info.status == Status.SOLVED
        return (plans.lam[solved] != 0).any(0).cpu().numpy()

    def _reachable(self) -> Rows:
        """Return the rows that the intervals of nonexpansiveness let reach a bound."""
        index = np.flatnonzero(self.window.has_bound)
        for _ in range(2):  # intervals of fewer rows, which may be independent, are narrower
            rows = self.window.rows(index)
            rows.propagate()
            index = index[allowed_states(rows) != FREE]
        return self.window.rows(index)

    def _by_moments(self, rows: Rows, found: Search) -> float:
        """Return a lower bound of psi, and shrink the rows' intervals to what is left of plans below the value."""
        window, psi = self.window, self._psi(rows)
        lam, channel, until = window.lam[rows.index], window.channel[rows.index], self.began + self.share_of_time
        rows.propagate()
        least, goal = 0.0, found.value - self.tolerance * abs(found.value)
        for _ in range(SETTINGS.moment_rounds):
            moments = Moments(rows, window.of_s.pieces, lam)
            precision = SETTINGS.precision * self.tolerance * abs(found.value)
            options: dict[str, Any] = {"enough": goal + 2 * precision, "tolerance": precision, "deadline": until}
            bounded = moments.minimum(moments.quadratic(psi), **options)
            found.nodes += 1
            if bounded is None:
                break
            before, least = least, max(least, bounded.bound - DUAL_SLACK * (1 + abs(bounded.bound)))
            closed = least - before > SETTINGS.progress * (found.value - least)
            if least >= goal or not closed or time.monotonic() > until:
                break
            if not shrink(rows, window.of_s.pieces, lam, channel, until, (psi, found.value)):
                return found.value
        else:
            tighten(rows, window.of_s, until)
        return least

    def _rows(self, active: NDArray[np.bool_]) -> Rows:
        """Return the rows that may reach a bound, their intervals tightened.

        Inputs come first. Another row is added if the plan that does not know its bound could pass it; where none
        could, that plan is the plan of the whole problem.
        """
        window, until = self.window, self.began + self.share_of_time
        lam, finite = window.lam, window.has_bound
        chosen = finite & (active | (lam != 0) | (np.arange(len(lam)) < window.n_u))
        while True:
            index = np.flatnonzero(chosen)
            rows = window.rows(index)
            for _ in range(SETTINGS.rounds):
                tighten(rows, window.of_s, until)
            rest = np.flatnonzero(finite & ~chosen)
            other = window.v0[rest], window.A[rest], window.G[np.ix_(rest, index)]
            ends = window.bounds[0][rest], window.bounds[1][rest]
            more = others_that_reach(rows, window.of_s, *other, ends, until)
            if not more:
                return rows
            chosen[rest[more]] = True

    def _psi(self, rows: Rows) -> Quadratic:
        window, n_u = self.window, self.window.n_u
        return Quadratic(window.v0[:n_u] - self.target, window.A[:n_u], -window.G[:n_u, rows.index])

    def _effect_of_unseen(self, rows: Rows, value: float) -> float:
        """Return by how much the directions of p that were dropped can lower psi."""
        values = np.linalg.eigvalsh(rows.G) if len(rows.G) else np.ones(1)
        moved = self.window.of_s.unseen * float(np.sqrt(values[-1] / values[values > 1e-12 * values[-1]][0]))
        return moved * (2 * value) ** 0.5

    def _replay(self, s: Array) -> float:
        plan = self.window.plan(s)
        return float(self.cost(plan)) if int(plan.info.status) == Status.SOLVED else np.inf
