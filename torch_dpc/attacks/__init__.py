"""Attacks on the measurements: costs, budgets, and how to choose a perturbation."""

from .budgets import Ball, Box, Budget, Ellipsoid, RelativeBall
from .costs import Cost, TargetInput
from .gradient import LinearizedAttack
from .random import RandomAttack

__all__ = [
    "Ball",
    "Box",
    "Budget",
    "Cost",
    "Ellipsoid",
    "LinearizedAttack",
    "RandomAttack",
    "RelativeBall",
    "TargetInput",
]
