"""What an attacker may add to the measured window: the admissible sets of p.

Every budget works on windows `(*batch, t_ini, n_y)` and takes the window itself as the second argument: with
`relative=True` the size that a budget was given is a fraction of |y_ini|, in the budget's own norm and over the entries
that share this size. A relative budget at y_ini = 0 is {0}.
"""

from .budget_base import Budget
from .entry_budgets import Box, Ellipsoid
from .norm_budgets import Ball, L1Ball, PerChannel, RelativeBall, SparseBall

__all__ = ["Ball", "Box", "Budget", "Ellipsoid", "L1Ball", "PerChannel", "RelativeBall", "SparseBall"]
