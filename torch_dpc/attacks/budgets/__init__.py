"""What an attacker may add to the measured window: the admissible sets of p.

Every budget works on windows `(*batch, t_ini, n_y)` and takes the window itself as the second argument. With
`relative=True` the size of a budget is a fraction of |y_ini|, in the budget's own norm and over the entries that share
this size. A relative budget at y_ini = 0 is {0}.
"""

from .base import Budget
from .entries import BoxBudget, EllipsoidBudget
from .norms import BallBudget, L1BallBudget, PerChannelBudget, PerSampleBudget, RelativeBallBudget, SparseBallBudget
from .stealthy import QuadraticDetector, StealthyBudget

__all__ = [
    "BallBudget",
    "BoxBudget",
    "Budget",
    "EllipsoidBudget",
    "L1BallBudget",
    "PerChannelBudget",
    "PerSampleBudget",
    "QuadraticDetector",
    "RelativeBallBudget",
    "SparseBallBudget",
    "StealthyBudget",
]
