"""Differentiable data-driven predictive control for PyTorch, and attacks on it."""

from . import attacks, systems, tuning
from .controller import DPCController
from .errors import ExcitationWarning, InfeasibleError, SolveError, Status
from .hankel import HankelData, excitation_order, hankel
from .layer import DPCLayer
from .problem import CompactForm
from .sets import Box, ConvexSet, Reals
from .simulation import ClosedLoopLog, Plant, collect, simulate
from .solution import DPCSolution, SolveInfo

__version__ = "0.1.0"

__all__ = [
    "Box",
    "ClosedLoopLog",
    "CompactForm",
    "ConvexSet",
    "DPCController",
    "DPCLayer",
    "DPCSolution",
    "ExcitationWarning",
    "HankelData",
    "InfeasibleError",
    "Plant",
    "Reals",
    "SolveError",
    "SolveInfo",
    "Status",
    "attacks",
    "collect",
    "excitation_order",
    "hankel",
    "simulate",
    "systems",
    "tuning",
]
