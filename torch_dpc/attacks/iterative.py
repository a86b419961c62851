"""Attacks of several gradient steps: how the loop goes on from Algorithm 1's answer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..layer import DPCLayer
from .budget_base import Budget, direction, euclidean
from .loop import IterativeAttack, Walk

#: What a projected-gradient step that does not improve psi makes of the step size, and one that does.
SHORTER, LONGER = 0.5, 1.5


class ProjectedGradientAttack(IterativeAttack):
    """Projected gradient: p <- Proj(p - size r m / |m|), m the gradient with momentum, r the budget's reach along it.

    The walk never climbs: a step that improves psi makes the next one half as long again, one that does not is taken
    back and halves it, each sample by itself.

    Args:
        layer, cost, budget, steps, restarts: as of every iterative attack.
        step_size: of the first step, as a fraction of the budget.
        momentum: m <- momentum m + gradient / |gradient|; 0 for none. Forgotten when a step is taken back.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-0.3, 0.3))
        >>> problem = (layer, dpc.attacks.TargetInput(torch.ones(2)), dpc.attacks.RelativeBall(0.2))
        >>> attack, first = ProjectedGradientAttack(*problem), dpc.attacks.LinearizedAttack(*problem)
        >>> psi = [problem[1](layer(u[:4], y[:4] + a(u[:4], y[:4]))) for a in (attack, first)]
        >>> bool(psi[0] <= psi[1])
        True
    """

    takes_back = True

    def __init__(
        self,
        layer: DPCLayer,
        cost: Any,
        budget: Budget,
        steps: int = 20,
        step_size: float = 0.5,
        *,
        momentum: float = 0.0,
        restarts: int = 1,
    ):
        super().__init__(layer, cost, budget, steps, restarts=restarts)
        if not step_size > 0:
            raise ValueError(f"`step_size` must be positive, got {step_size!r}.")
        if not 0 <= momentum < 1:
            raise ValueError(f"`momentum` must be at least 0 and below 1, got {momentum!r}.")
        self.step_size, self.momentum = step_size, momentum

    def _direction(self, walk: Walk, vertex: Tensor, y_ini: Tensor, k: int) -> Tensor:
        stalled = (walk.stalls > 0)[..., None, None]
        walk.size = walk.size * torch.where(stalled, SHORTER, LONGER)
        velocity = self.momentum * walk.velocity + direction(walk.gradient)
        walk.velocity = torch.where(stalled, direction(walk.gradient), velocity)
        reach = euclidean(self.budget.minimize_linear(walk.velocity, y_ini))
        return -self.step_size * walk.size * reach * direction(walk.velocity)


class FrankWolfeAttack(IterativeAttack):
    """Frank-Wolfe: p <- p + 2 / (k + 2) (argmin over the budget of <grad, s> - p); it needs no projection.

    Algorithm 1 is its step k = 0. Over a budget that is not convex a mean of two perturbations may be outside; there,
    and only there, it is projected.
    """

    def _direction(self, walk: Walk, vertex: Tensor, y_ini: Tensor, k: int) -> Tensor:
        return 2 / (k + 2) * (vertex - walk.p)

    def _project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return p if self.budget.convex else super()._project(p, y_ini)
