"""Attacks of several gradient steps: one loop, with hooks for the start, the direction of a step and its projection.

The first walk starts at p = 0 with Algorithm 1's step, so Algorithm 1 is the loop cut off after that. The best
perturbation seen is kept, sample by sample: never worse than Algorithm 1, nor than no attack.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..checks import check_callable
from .base import Attack, AttackCall, Planner, within_budget
from .budgets import Budget
from .costs import check_cost
from .objective import Objective


@dataclass(frozen=True)
class WalkSettings:
    """Constants of the attacks by gradient."""

    noise_floor: float = 1e-10  # relative change of psi that is rounding: no step is taken for it, no answer kept
    patience: int = 6  # steps in a row without an improvement after which a sample stops
    shorter: float = 0.5  # factor on the step size of projected gradient after a step that did not improve psi
    longer: float = 1.5  # factor after one that did


SETTINGS = WalkSettings()


@dataclass
class Walk:
    """Where every sample of the batch stands.

    Attributes:
        p, psi, gradient: at present.
        best_p, best_psi, best_gradient: where psi was least so far.
        stalls: steps in a row that did not improve psi, `(*batch,)`.
        size: what has become of the step size, `(*batch, 1, 1)`.
        velocity: of momentum.
        first_p: after the first step.
    """

    p: Tensor
    psi: Tensor
    gradient: Tensor
    best_p: Tensor
    best_psi: Tensor
    best_gradient: Tensor
    stalls: Tensor
    size: Tensor
    velocity: Tensor
    first_p: Tensor

    @staticmethod
    def at(p: Tensor) -> Walk:
        """Return a walk that has seen nothing yet."""
        none, psi = torch.zeros_like(p), torch.full(p.shape[:-2], torch.inf, dtype=p.dtype, device=p.device)
        size = torch.ones_like(psi)[..., None, None]
        return Walk(p, psi, none, p, psi, none, torch.zeros_like(psi), size, none, p)

    def see(self, psi: Tensor, gradient: Tensor) -> None:
        """Take note of psi and its gradient at p."""
        better = improves(psi, self.best_psi)
        chosen = better[..., None, None]
        self.psi, self.gradient = psi, gradient
        self.best_p = torch.where(chosen, self.p, self.best_p)
        self.best_psi = torch.where(better, psi, self.best_psi)
        self.best_gradient = torch.where(chosen, gradient, self.best_gradient)
        self.stalls = torch.where(better, 0.0, self.stalls + 1)

    def return_to_best(self) -> None:
        """Take back steps that did not improve psi."""
        self.p, self.psi, self.gradient = self.best_p, self.best_psi, self.best_gradient


def improves(psi: Tensor, least: Tensor) -> Tensor:
    """Return whether psi is below the least so far by more than rounding."""
    return psi < torch.where(least.isfinite(), least - SETTINGS.noise_floor * least.abs(), least)


def algorithm_1_step(budget: Budget, y_ini: Tensor, p: Tensor, psi: Tensor, gradient: Tensor) -> Tensor:
    """Return argmin over the budget of <gradient, .>: Algorithm 1's step.

    A sample stays at p where there is no plan, or where the step promises no more than rounding: there a direction
    would be rounding amplified to the size of the budget.
    """
    vertex = budget.minimize_linear(gradient, y_ini)
    promised = (gradient * vertex).sum((-2, -1)).abs()
    worthwhile = promised > SETTINGS.noise_floor * psi.abs()  # never where psi is infinite
    return torch.where(worthwhile[..., None, None], vertex, p)


class IterativeAttack(Attack):
    """The loop: start, linearise, step, keep the best.

    Args:
        layer: what the attacker believes the controller solves, a surrogate if need be.
        cost: psi, a callable DPCSolution -> `(*batch,)`.
        budget: the admissible perturbations.
        steps: gradient steps after the first.
        restarts: walks, each from a start of its own: the first from zero, the others from random perturbations.
    """

    #: Whether a step that does not improve psi is taken back, so that the next one starts from the best.
    takes_back = False

    def __init__(self, layer: Planner, cost: Any, budget: Budget, steps: int = 20, *, restarts: int = 1):
        if not isinstance(steps, int) or isinstance(steps, bool) or steps < 0:
            raise ValueError(f"`steps` must be an integer, 0 or more, got {steps!r}.")
        if not isinstance(restarts, int) or isinstance(restarts, bool) or restarts < 1:
            raise ValueError(f"`restarts` must be an integer, 1 or more, got {restarts!r}.")
        super().__init__(budget)
        check_callable("layer", layer)
        check_cost(cost)
        self.layer, self.cost = layer, cost
        self.steps, self.restarts = steps, restarts

    def _perturb(self, call: AttackCall) -> Tensor:
        objective = self._objective(call)
        first: Tensor | None = None  # Algorithm 1's answer
        for restart in range(self.restarts):
            walk = self._walk(objective, self._start(restart, objective.y_ini, call.generator), restart == 0)
            if restart == 0:
                p, least, first = walk.best_p, walk.best_psi, walk.first_p
            else:
                better = improves(walk.best_psi, least)
                p = torch.where(better[..., None, None], walk.best_p, p)
                least = torch.where(better, walk.best_psi, least)
        if call.y_ini.dtype == torch.float64 or first is None:
            return p
        return self._as_seen(objective, call.y_ini, p, first)

    def _as_seen(self, objective: Objective, y_ini: Tensor, p: Tensor, first: Tensor) -> Tensor:
        """Return the better of two answers, each as the controller will see it in the lower precision of y_ini."""
        rounded = [within_budget(x.to(y_ini.dtype), y_ini, self.budget) for x in (p, first)]
        with torch.no_grad():
            psi = [objective.psi((y_ini + x).double() - objective.y_ini) for x in rounded]
        return torch.where((psi[0] <= psi[1])[..., None, None], rounded[0], rounded[1])

    def _walk(self, objective: Objective, start: Tensor, is_first: bool) -> Walk:
        """Go from one start; a sample whose gradient is at the floor, or whose psi stalls, leaves the batch."""
        walk = Walk.at(start)
        active = torch.ones_like(walk.psi, dtype=torch.bool)
        for k in range(self.steps + 1):
            walk.see(*objective.gradient(walk.p, active))
            if self.takes_back:
                walk.return_to_best()
            vertex = self.budget.minimize_linear(walk.gradient, objective.y_ini)
            promised = (walk.gradient * (walk.p - vertex)).sum((-2, -1))
            floor = torch.where(walk.psi.isfinite(), SETTINGS.noise_floor * walk.psi.abs(), torch.inf)
            active = active & (promised > floor) & (walk.stalls < SETTINGS.patience)
            if not bool(active.any()):
                return walk
            if is_first and k == 0:
                moved = algorithm_1_step(self.budget, objective.y_ini, walk.p, walk.psi, walk.gradient)
            else:
                step = self._direction(walk, vertex, objective.y_ini, k)
                moved = self._project(walk.p + step, objective.y_ini)
            walk.p = torch.where(active[..., None, None], moved, walk.p)
            walk.first_p = walk.p if k == 0 else walk.first_p
        return self._end(walk, objective, active)

    def _start(self, restart: int, y_ini: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return where a walk starts."""
        return torch.zeros_like(y_ini) if restart == 0 else self.budget.random(y_ini, generator)

    def _direction(self, walk: Walk, vertex: Tensor, y_ini: Tensor, k: int) -> Tensor:
        """Return the step from walk.p, length included; `vertex` minimises the linearisation there over the budget."""
        raise NotImplementedError

    def _project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        """Return what a step that may have left the budget becomes."""
        return self.budget.project(p, y_ini)

    def _end(self, walk: Walk, objective: Objective, active: Tensor) -> Walk:
        """Look at the last step."""
        with torch.no_grad():
            walk.see(objective.psi(walk.p, active), walk.gradient)
        return walk

    def _objective(self, call: AttackCall) -> Objective:
        """Return what is minimised in a call."""
        return Objective(self.layer, self.cost, call.u_ini, call.y_ini, call.y_ref, call.u_ref, call.step)
