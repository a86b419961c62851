"""Differentiable data-driven predictive control for PyTorch, and attacks on it."""

from . import systems
from .errors import ExcitationWarning, InfeasibleError, SolveError, Status
from .hankel import HankelData, excitation_order, hankel
from .layer import DPCLayer
from .problem import CompactForm
from .sets import Box, ConvexSet, Reals
from .solution import DPCSolution, SolveInfo

__version__ = "0.1.0"

__all__ = [
    "Box",
    "CompactForm",
    "ConvexSet",
    "DPCLayer",
    "DPCSolution",
    "ExcitationWarning",
    "HankelData",
    "InfeasibleError",
    "Reals",
    "SolveError",
    "SolveInfo",
    "Status",
    "excitation_order",
    "hankel",
    "systems",
]
