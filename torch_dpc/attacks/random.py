"""The paper's benchmark: random noise of the same size as the attack."""

from __future__ import annotations

from torch import Tensor

from .base import Attack, AttackCall


class RandomAttack(Attack):
    """A random direction at the edge of the budget: for the relative ball p = rho |y_ini| v / |v|, v standard normal.

    Args:
        budget: the admissible perturbations.
    """

    def _perturb(self, call: AttackCall) -> Tensor:
        return self.budget.random(call.y_ini, call.generator)
