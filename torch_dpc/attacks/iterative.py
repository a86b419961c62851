"""Attacks of several gradient steps: one loop, and one hook for the step.

They start from Algorithm 1's answer, keep the best perturbation seen, sample by sample, and so are never worse than it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_data
from ..layer import DPCLayer
from .budgets import Budget
from .gradient import LinearizedAttack, checked, psi_and_gradient


class IterativeAttack:
    """The loop: linearise at p, step, keep the best.

    Args:
        layer: what the attacker believes the controller solves.
        cost: psi, a callable DPCSolution -> `(*batch,)`.
        budget: the admissible perturbations.
        steps: gradient steps after the first.
    """

    def __init__(self, layer: DPCLayer, cost: Any, budget: Budget, steps: int = 20):
        if not isinstance(steps, int) or steps < 0:
            raise ValueError(f"`steps` must be an integer, 0 or more, got {steps!r}.")
        self.layer, self.cost, self.budget, self.steps = layer, cost, budget, steps

    def __call__(
        self,
        u_ini: Any,
        y_ini: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        generator: torch.Generator | None = None,
        step: int = 0,
    ) -> Tensor:
        """Return p, the shape of y_ini; the call of every attack."""
        y_ini = as_data("y_ini", y_ini)
        p = LinearizedAttack(self.layer, self.cost, self.budget)(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref, step=step)
        best, least = p, None
        for k in range(self.steps + 1):
            psi, gradient = psi_and_gradient(self.layer, self.cost, u_ini, y_ini, p, y_ref, u_ref, step)
            better = psi < least if least is not None else torch.ones_like(psi, dtype=torch.bool)
            best = torch.where(better[..., None, None], p, best)
            least = psi if least is None else torch.minimum(psi, least)
            p = self._step(p, gradient, y_ini, k)
        return checked(best, y_ini, self.budget)

    def _step(self, p: Tensor, gradient: Tensor, y_ini: Tensor, k: int) -> Tensor:
        raise NotImplementedError


class ProjectedGradientAttack(IterativeAttack):
    """Projected gradient: p <- Proj(p - step_size (1 - k / steps) r grad / |grad|), r the size of the budget.

    Args:
        step_size: of the first step, as a fraction of the budget's size in the gradient's direction.
    """

    def __init__(self, layer: DPCLayer, cost: Any, budget: Budget, steps: int = 20, step_size: float = 0.5):
        super().__init__(layer, cost, budget, steps)
        if not step_size > 0:
            raise ValueError(f"`step_size` must be positive, got {step_size!r}.")
        self.step_size = step_size

    def _step(self, p: Tensor, gradient: Tensor, y_ini: Tensor, k: int) -> Tensor:
        size = torch.linalg.vector_norm(self.budget.minimize_linear(gradient, y_ini), dim=(-2, -1), keepdim=True)
        norm = torch.linalg.vector_norm(gradient, dim=(-2, -1), keepdim=True)
        direction = torch.where(norm > 0, gradient / torch.where(norm > 0, norm, 1.0), 0.0)
        length = self.step_size * (1 - k / (self.steps + 1)) * size
        return self.budget.project(p - length * direction, y_ini)


class FrankWolfeAttack(IterativeAttack):
    """Frank-Wolfe: p <- p + 2 / (k + 2) (argmin over the budget of <grad, s> - p); it needs no projection."""

    def _step(self, p: Tensor, gradient: Tensor, y_ini: Tensor, k: int) -> Tensor:
        return p + 2 / (k + 2) * (self.budget.minimize_linear(gradient, y_ini) - p)
