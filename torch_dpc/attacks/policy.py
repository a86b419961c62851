"""Attacks by a trained network: one small forward pass in place of a solve and its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ..checks import as_data, is_finite
from .budgets import Ball, Budget, Ellipsoid

#: How far outside its budget a perturbation may be, relative to its size, before it is a defect.
BUDGET_TOLERANCE = 1e-9


class PolicyAttack(nn.Module):
    """A network chooses the direction, the budget the size.

    The network sees what Algorithm 1 sees, the windows and the references, and returns a direction d, `(*batch, t_ini,
    n_y)`. The attack is a point of the budget that is as far out along d as the budget allows, in one of two ways:

        reach="support":     p = argmax over the budget of <d, p>, as Algorithm 1 does with d = -grad;
        reach="projection":  p = Proj(|s| d / |d|), s that support point.

    For balls the two are one, p = radius d / |d|. The support point is smooth in d where the budget has no corners
    (balls and ellipsoids, for which it is the default). Where it has, the support point is a corner whose derivative is
    zero and from which nothing could be learned; the projection still has one. At d = 0 both are 0.

    p carries the graph of the network's parameters and of the measurements, so the attack can be trained through the
    layer, and through a closed loop by `simulate` with a differentiable plant. `requires_grad_(False)` on the network
    makes it as free of graphs as the other attacks.

    Args:
        policy: (u_ini, y_ini, y_ref, u_ref, step) -> d: a :class:`torch_dpc.attacks.AttackPolicy`, or any module.
        budget: the admissible perturbations.
        reach: "support" or "projection"; by default what suits the budget.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> data = dpc.HankelData.from_trajectories(*dpc.collect(plant, 120, generator=generator), t_ini=4, horizon=10)
        >>> policy = dpc.attacks.AttackPolicy(data, generator=generator)
        >>> attack = PolicyAttack(policy, dpc.attacks.RelativeBall(0.1))
        >>> p = attack(torch.zeros(4, 2), torch.ones(4, 4))
        >>> p.shape, round(float(p.detach().norm() / torch.ones(4, 4).norm()), 6)
        (torch.Size([4, 4]), 0.1)
    """

    def __init__(self, policy: nn.Module, budget: Budget, *, reach: str | None = None):
        super().__init__()
        if reach not in (None, "support", "projection"):
            raise ValueError(f'`reach` must be "support", "projection" or None, got {reach!r}.')
        self.policy = policy
        self.budget = budget
        self.reach = reach or ("support" if isinstance(budget, (Ball, Ellipsoid)) else "projection")

    def forward(
        self,
        u_ini: Any,
        y_ini: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        generator: torch.Generator | None = None,
        step: Any = 0,
    ) -> Tensor:
        """Return p, the shape of y_ini; the call of every attack.

        Args:
            u_ini, y_ini: the true windows, `(*batch, t_ini, n)`.
            y_ref, u_ref: references, as the layer takes them.
            generator: unused; every attack takes the same call.
            step: of the run, an integer, or one for each sample, `(*batch,)`.

        Raises:
            ValueError: bad windows, or a direction that does not fit them or is not finite.
        """
        u_ini, y_ini = as_data("u_ini", u_ini), as_data("y_ini", y_ini)
        direction = self.policy(u_ini, y_ini, y_ref, u_ref, step)
        if direction.shape != y_ini.shape:
            raise ValueError(
                f"`policy` must return a direction of the shape of y_ini, {tuple(y_ini.shape)}, got "
                f"{tuple(direction.shape)}."
            )
        if not is_finite(direction):
            raise ValueError(
                "`policy` returned a direction that is not finite; its weights or inputs are out of range."
            )
        p = self._reach(direction.to(y_ini), y_ini)
        self._check(p.detach(), y_ini.detach())
        return p

    def _reach(self, direction: Tensor, y_ini: Tensor) -> Tensor:
        support = self.budget.minimize_linear(-direction, y_ini)
        if self.reach == "support":
            return support
        length, size = (torch.linalg.vector_norm(x, dim=(-2, -1), keepdim=True) for x in (support, direction))
        # Nothing of length 0 is projected: a budget may divide by it.
        somewhere = torch.where(size > 0, direction, 1.0) * (_or_one(length) / _or_one(size))
        return torch.where(size > 0, self.budget.project(somewhere, y_ini), 0.0)

    def _check(self, p: Tensor, y_ini: Tensor) -> None:
        tolerance = BUDGET_TOLERANCE if p.dtype == torch.float64 else 10 * torch.finfo(p.dtype).eps
        worst = self.budget.excess(p, y_ini)
        if not bool((worst <= tolerance).all()):
            raise AssertionError(f"the attack left its budget by {float(worst.max()):.1e} of its size.")


def _or_one(size: Tensor) -> Tensor:
    return torch.where(size > 0, size, 1.0)
