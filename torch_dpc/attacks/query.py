"""Attacks that only ask: they see the inputs that the controller plans for a window, and nothing of how it plans.

`controller` is any callable (u_ini, y_ini, *, y_ref, u_ref) -> u, `(*batch, horizon, n_u)`, or -> something with such a
`u`: a `DPCLayer`, or a wrapper of a controller of one's own. Many windows are asked in one call, and it is windows that
are counted. A plan that is not finite counts as none. The cost sees `u` alone: `TargetInput`, or `TrackingError` on the
attacker's own data.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..checks import check_callable, check_count, check_number
from ..layer import DPCLayer
from .base import Attack, AttackCall, Planner
from .budgets import Budget
from .budgets.base import standard_normal
from .costs import check_cost
from .gradient import ProjectedGradientAttack
from .loop import improves
from .objective import Objective, is_everyone


class SeenPlan(NamedTuple):
    """What a query shows: the planned inputs, `(*batch, horizon, n_u)`."""

    u: Tensor


class BlackBox:
    """A controller that is only asked, and how often: `n_queries` windows so far."""

    def __init__(self, controller: Planner):
        check_callable("controller", controller)
        self._controller: Callable[..., Any] = controller
        self._options = {"on_failure": "nan"} if isinstance(controller, DPCLayer) else {}
        self.n_queries = 0

    def __call__(self, u_ini: Tensor, y_ini: Tensor, *, y_ref: Any, u_ref: Any) -> Tensor:
        """Return the planned inputs, float64."""
        self.n_queries += y_ini.shape[:-2].numel()
        with torch.no_grad():
            seen = self._controller(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref, **self._options)
        return (seen if isinstance(seen, Tensor) else seen.u).double()


class QueryObjective(Objective):
    """psi(u*(p)) by queries, and its gradient by central differences.

    Args:
        controller: the black box.
        cost, u_ini, y_ini, y_ref, u_ref, step: as of every objective.
        probe: length of a difference, in the units of the outputs.
        directions: how many random directions stand for the gradient; None for every entry of the window.
        generator: of the directions.
    """

    def __init__(
        self,
        controller: BlackBox,
        cost: Any,
        u_ini: Any,
        y_ini: Any,
        y_ref: Any,
        u_ref: Any,
        step: int,
        *,
        probe: float = 1e-4,
        directions: int | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__(controller, cost, u_ini, y_ini, y_ref, u_ref, step)
        self.probe, self.directions, self.generator = probe, directions, generator
        self._last_u: Tensor | None = None

    def psi(self, p: Tensor, of: Tensor | None = None) -> Tensor:
        """Return psi at p, `(*batch,)`; infinity where there is no plan."""
        return self._all_psi(p[None], of)[0]

    def gradient(self, p: Tensor, of: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return psi and its estimated gradient in p, zero where a plan that it needs is missing."""
        directions = self._directions(p)
        spread = directions.reshape(len(directions), *(1,) * (p.ndim - 2), *directions.shape[-2:])
        psi, *around = self._all_psi(p + self.probe * torch.cat([torch.zeros_like(spread[:1]), spread, -spread]), of)
        ahead, behind = torch.stack(around).chunk(2)
        slopes = (ahead - behind) / (2 * self.probe)
        gradient = torch.einsum("i...,itn->...tn", slopes, directions)
        if self.directions is not None:
            gradient = gradient / self.directions  # the mean over normal directions d of (d'grad) d is grad
        known = psi.isfinite() & slopes.isfinite().all(0)
        return psi, torch.where(known[..., None, None], gradient, 0.0)

    def _directions(self, p: Tensor) -> Tensor:
        """Return the directions, `(how many, t_ini, n_y)`, the same for every sample."""
        size = p.shape[-2:].numel()
        if self.directions is None:
            flat = torch.eye(size, dtype=p.dtype, device=p.device)
        else:
            flat = standard_normal(p.new_empty(self.directions, size), self.generator)
        return flat.reshape(-1, *p.shape[-2:])

    def _all_psi(self, p: Tensor, of: Tensor | None) -> Tensor:
        """Return psi at several p, `(how many, *batch)`: one call of the controller, one of the cost for each p."""
        if is_everyone(of):
            y_ini = self.y_ini + p
            u = self.layer(self.u_ini.expand(*y_ini.shape[:-1], -1), y_ini, **self.refs)
            self._last_u = u[0]
        else:
            assert of is not None and self._last_u is not None, "the first call asks for every sample"
            y_ini = (self.y_ini + p)[:, of]
            part = self.layer(self.u_ini[of].expand(*y_ini.shape[:-1], -1), y_ini, **self._refs_of(of))
            u = self._last_u.expand(len(p), *self._last_u.shape).clone()
            u[:, of] = part
        with torch.no_grad():
            psi = torch.stack([self._judged(SeenPlan(plan)) for plan in u])
        return torch.where(u.isfinite().all(-1).all(-1), psi, torch.inf)


class FiniteDifferenceAttack(ProjectedGradientAttack):
    """Algorithm 1 by queries: the gradient by central differences, then the step over the budget.

    One gradient asks for 1 + 2 t_ini n_y windows, or 1 + 2 `directions`, and the answer is judged by one more; it is
    never worse than no attack. With `steps` it goes on as projected gradient. At a kink of the plan a central
    difference is the mean of the slopes on both sides, not the one-sided slope that the layer counts.

    Args:
        controller: what is asked, see :mod:`torch_dpc.attacks.query`.
        cost: psi, a callable of something with the planned `u`.
        budget: the admissible perturbations.
        steps: gradient steps after the first.
        probe: length of a difference, in the units of the outputs.
        directions: random directions in place of every entry of the window: fewer queries, a rougher gradient.
        options: `step_size`, `momentum` and `restarts` of projected gradient.

    Example:
        >>> import torch
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> problem = (layer, dpc.attacks.TargetInput(torch.ones(2)), dpc.attacks.RelativeBall(0.01))
        >>> asking, knowing = FiniteDifferenceAttack(*problem), dpc.attacks.LinearizedAttack(*problem)
        >>> torch.allclose(asking(u[:4], y[:4]), knowing(u[:4], y[:4]), rtol=1e-5), asking.n_queries
        (True, 34)
    """

    def __init__(
        self,
        controller: Planner,
        cost: Any,
        budget: Budget,
        steps: int = 0,
        *,
        probe: float = 1e-4,
        directions: int | None = None,
        **options: Any,
    ):
        self.controller = BlackBox(controller)
        super().__init__(self.controller, cost, budget, steps, **options)
        check_number("probe", probe, positive=True, kind="positive and finite")
        if directions is not None:
            check_count("directions", directions)
        self.probe, self.directions = probe, directions

    @property
    def n_queries(self) -> int:
        """Windows asked for so far, by all calls."""
        return self.controller.n_queries

    def _objective(self, call: AttackCall) -> Objective:
        problem = (call.u_ini, call.y_ini, call.y_ref, call.u_ref, call.step)
        return QueryObjective(
            self.controller,
            self.cost,
            *problem,
            probe=self.probe,
            directions=self.directions,
            generator=call.generator,
        )


class RandomSearchAttack(Attack):
    """Accept if better: a random step from the best perturbation so far, kept when the controller's answer says so.

    The size of a sample's steps, at first the whole budget, grows by half with a success and shrinks by a tenth
    without: about one step in five is to succeed (Rechenberg 1973).

    Args:
        controller: what is asked, see :mod:`torch_dpc.attacks.query`.
        cost: psi, a callable of something with the planned `u`.
        budget: the admissible perturbations.
        queries: windows asked for, a sample; the first is the unattacked one.
    """

    def __init__(self, controller: Planner, cost: Any, budget: Budget, queries: int = 100):
        check_count("queries", queries)
        check_cost(cost)
        super().__init__(budget)
        self.controller, self.cost, self.queries = BlackBox(controller), cost, queries

    @property
    def n_queries(self) -> int:
        """Windows asked for so far, by all calls."""
        return self.controller.n_queries

    def _perturb(self, call: AttackCall) -> Tensor:
        problem = (call.u_ini, call.y_ini, call.y_ref, call.u_ref, call.step)
        objective = QueryObjective(self.controller, self.cost, *problem)
        p = torch.zeros_like(objective.y_ini)
        least, size = objective.psi(p), torch.ones_like(p[..., :1, :1])
        for _ in range(self.queries - 1):
            step = size * self.budget.random(objective.y_ini, call.generator)
            trial = self.budget.project(p + step, objective.y_ini)
            psi = objective.psi(trial)
            better = improves(psi, least)
            p = torch.where(better[..., None, None], trial, p)
            least = torch.where(better, psi, least)
            size = torch.where(better[..., None, None], size * 1.5, size * 0.9).clamp_max(1.0)
        return p
