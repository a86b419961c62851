"""Attacks on the measurements: costs, budgets, and how to choose a perturbation."""

from ..data.predictor import Predictor
from .base import Attack, Planner
from .budgets import (
    BallBudget,
    BoxBudget,
    Budget,
    EllipsoidBudget,
    L1BallBudget,
    PerChannelBudget,
    PerSampleBudget,
    RelativeBallBudget,
    SparseBallBudget,
    StealthyBudget,
)
from .certificate import SensitivityBound, sensitivity_bound
from .costs import BoundViolation, Cost, TargetInput, TrackingError
from .ensemble import Ensemble
from .exact import CertifiedInterval, WorstCase, certified_interval, worst_case
from .gradient import FrankWolfeAttack, LinearizedAttack, ProjectedGradientAttack
from .influence import weigh_windows, window_influence
from .on_signal import AttackOn
from .policy import AttackPolicy, PolicyAttack
from .query import FiniteDifferenceAttack, RandomSearchAttack
from .random import RandomAttack
from .recording import Poisoned, PoisonedRecording
from .robustness import RobustnessCurve, robustness_curve
from .signal import RunError, SignalAttack

# Short names, as in `attacks.Ball(0.1)`: the same classes.
Ball, Box, Ellipsoid = BallBudget, BoxBudget, EllipsoidBudget
L1Ball, PerChannel = L1BallBudget, PerChannelBudget
RelativeBall, SparseBall, Stealthy = RelativeBallBudget, SparseBallBudget, StealthyBudget

__all__ = [
    "Attack",
    "AttackOn",
    "AttackPolicy",
    "Ball",
    "BallBudget",
    "BoundViolation",
    "Box",
    "BoxBudget",
    "Budget",
    "CertifiedInterval",
    "Cost",
    "Ellipsoid",
    "EllipsoidBudget",
    "Ensemble",
    "FiniteDifferenceAttack",
    "FrankWolfeAttack",
    "L1Ball",
    "L1BallBudget",
    "LinearizedAttack",
    "PerChannel",
    "PerChannelBudget",
    "PerSampleBudget",
    "Planner",
    "Poisoned",
    "PoisonedRecording",
    "PolicyAttack",
    "Predictor",
    "ProjectedGradientAttack",
    "RandomAttack",
    "RandomSearchAttack",
    "RelativeBall",
    "RelativeBallBudget",
    "RobustnessCurve",
    "RunError",
    "SensitivityBound",
    "SignalAttack",
    "SparseBall",
    "SparseBallBudget",
    "Stealthy",
    "StealthyBudget",
    "TargetInput",
    "TrackingError",
    "WorstCase",
    "certified_interval",
    "robustness_curve",
    "sensitivity_bound",
    "weigh_windows",
    "window_influence",
    "worst_case",
]
