"""Attacks on the measurements: costs, budgets, and how to choose a perturbation."""

from .budgets import Ball, Box, Budget, Ellipsoid, RelativeBall
from .costs import Cost, TargetInput
from .gradient import LinearizedAttack
from .iterative import FrankWolfeAttack, ProjectedGradientAttack
from .random import RandomAttack

__all__ = [
    "Ball",
    "Box",
    "Budget",
    "Cost",
    "Ellipsoid",
    "FrankWolfeAttack",
    "LinearizedAttack",
    "ProjectedGradientAttack",
    "RandomAttack",
    "RelativeBall",
    "TargetInput",
]
