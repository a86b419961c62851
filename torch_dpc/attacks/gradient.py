"""Algorithm 1 of the paper."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from ..layer import DPCLayer
from .budgets import Budget
from .loop import NOISE_FLOOR, IterativeAttack, Walk
from .objective import BUDGET_TOLERANCE, Objective, checked, psi_and_gradient

__all__ = ["BUDGET_TOLERANCE", "NOISE_FLOOR", "LinearizedAttack", "checked", "psi_and_gradient"]


class LinearizedAttack(IterativeAttack):
    """Algorithm 1: minimise the attacker's cost, linearised at p = 0, over the budget.

        p* = argmin over the budget of <d psi(u*(p)) / dp at 0, p>,

    for the ball |p| <= rho |y_ini| the step p* = -rho |y_ini| grad / |grad|. The gradient comes from the projected KKT
    system of the layer, whichever its `backward` is. Rows of the plan that only touch their bounds count as free (see
    `sol.info.n_weakly_active`). The loop cut off after its first step, which is returned as it is, unjudged.

    Args:
        layer: what the attacker believes the controller solves: the controller's own layer, or a surrogate made of
            other data, weights or horizon.
        cost: psi, a callable DPCSolution -> `(*batch,)`, such as `TargetInput`.
        budget: the admissible perturbations.

    Example:
        >>> import torch
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> cost = dpc.attacks.TargetInput(torch.ones(2))
        >>> attack = LinearizedAttack(layer, cost, dpc.attacks.RelativeBall(0.01))
        >>> p = attack(u[:4], y[:4])
        >>> bool(cost(layer(u[:4], y[:4] + p)) < cost(layer(u[:4], y[:4])))
        True
    """

    def __init__(self, layer: DPCLayer, cost: Any, budget: Budget):
        super().__init__(layer, cost, budget, steps=0)

    def _end(self, walk: Walk, objective: Objective, active: Tensor) -> Walk:
        walk.best_p = walk.p
        return walk
