"""Attacks on the measurements: costs, budgets, and how to choose a perturbation."""

from ..data.predictor import Predictor
from .budgets import Ball, Box, Budget, Ellipsoid, L1Ball, PerChannel, RelativeBall, SparseBall
from .costs import Cost, TargetInput, TrackingError
from .gradient import LinearizedAttack
from .iterative import FrankWolfeAttack, ProjectedGradientAttack
from .network import AttackPolicy
from .policy import PolicyAttack
from .query import FiniteDifferenceAttack, RandomSearchAttack
from .random import RandomAttack

__all__ = [
    "AttackPolicy",
    "Ball",
    "Box",
    "Budget",
    "Cost",
    "Ellipsoid",
    "FiniteDifferenceAttack",
    "FrankWolfeAttack",
    "L1Ball",
    "LinearizedAttack",
    "PerChannel",
    "PolicyAttack",
    "Predictor",
    "ProjectedGradientAttack",
    "RandomAttack",
    "RandomSearchAttack",
    "RelativeBall",
    "SparseBall",
    "TargetInput",
    "TrackingError",
]
