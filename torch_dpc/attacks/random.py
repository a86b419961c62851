"""The benchmark every attack has to beat."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_data
from .budgets import Budget
from .objective import checked


class RandomAttack:
    """A random direction at the edge of the budget: for the relative ball p = rho |y_ini| v / |v|, v standard normal.

    Args:
        budget: the admissible perturbations.
    """

    def __init__(self, budget: Budget):
        self.budget = budget

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
        return checked(self.budget.random(y_ini, generator), y_ini, self.budget)
