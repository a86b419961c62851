"""Attacks on the measurements: costs, budgets, and how to choose a perturbation."""

from .budgets import Ball, Box, Budget, Ellipsoid, RelativeBall
from .costs import Cost, TargetInput
from .gradient import LinearizedAttack
from .iterative import FrankWolfeAttack, ProjectedGradientAttack
from .network import AttackPolicy
from .policy import PolicyAttack
from .random import RandomAttack

__all__ = [
    "AttackPolicy",
    "Ball",
    "Box",
    "Budget",
    "Cost",
    "Ellipsoid",
    "FrankWolfeAttack",
    "LinearizedAttack",
    "PolicyAttack",
    "ProjectedGradientAttack",
    "RandomAttack",
    "RelativeBall",
    "TargetInput",
]
