"""Attacks by gradient: Algorithm 1 of the paper, projected gradient and Frank-Wolfe."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import check_callable, check_count, check_number
from ..layer import DPCLayer
from .base import Attack, AttackCall, Planner
from .budgets import Budget
from .budgets.base import direction, euclidean
from .costs import check_cost
from .loop import SETTINGS, IterativeAttack, Walk, algorithm_1_step
from .objective import Objective


class LinearizedAttack(Attack):
    """Algorithm 1: minimise the attacker's cost, linearised at p = 0, over the budget.

        p* = argmin over the budget of <d psi(u*(p)) / dp at 0, p>,

    for the ball |p| <= rho |y_ini| the step p* = -rho |y_ini| grad / |grad|. The gradient comes from the projected KKT
    system of the layer, whichever its `backward` is. Rows of the plan that only touch their bounds count as free (see
    `sol.info.n_weakly_active`).

    Args:
        layer: what the attacker believes the controller solves: the controller's own layer, or a surrogate made of
            other data, weights or horizon.
        cost: psi, a callable DPCSolution -> `(*batch,)`, such as `TargetInput`.
        budget: the admissible perturbations.
        iterations: linearised steps, each at the last answer: p <- argmin over the budget of <d psi / dp at p, .>.
            One is Algorithm 1. More raise a convex cost further; the answer is the last one, not the best.
        keeps_graph: whether p carries its derivative with respect to the windows and the weights of the layer, through
            second derivatives of the layer.

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

    def __init__(self, layer: DPCLayer, cost: Any, budget: Budget, *, iterations: int = 1, keeps_graph: bool = False):
        super().__init__(budget)
        check_callable("layer", layer)
        check_cost(cost)
        self.layer, self.cost = layer, cost
        self.iterations, self.keeps_graph = check_count("iterations", iterations), keeps_graph

    def _perturb(self, call: AttackCall) -> Tensor:
        problem = (call.u_ini, call.y_ini, call.y_ref, call.u_ref, call.step)
        objective = Objective(self.layer, self.cost, *problem, keeps_graph=self.keeps_graph)
        p = torch.zeros_like(objective.y_ini)
        for _ in range(self.iterations):
            p = algorithm_1_step(self.budget, objective.y_ini, p, *objective.gradient(p))
        return p


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
        layer: Planner,
        cost: Any,
        budget: Budget,
        steps: int = 20,
        step_size: float = 0.5,
        *,
        momentum: float = 0.0,
        restarts: int = 1,
    ):
        super().__init__(layer, cost, budget, steps, restarts=restarts)
        check_number("step_size", step_size, positive=True, kind="positive and finite")
        if not check_number("momentum", momentum) < 1:
            raise ValueError(f"`momentum` must be at least 0 and below 1, got {momentum!r}.")
        self.step_size, self.momentum = step_size, momentum

    def _direction(self, walk: Walk, vertex: Tensor, y_ini: Tensor, k: int) -> Tensor:
        stalled = (walk.stalls > 0)[..., None, None]
        walk.size = walk.size * torch.where(stalled, SETTINGS.shorter, SETTINGS.longer)
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
