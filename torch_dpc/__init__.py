"""Differentiable data-driven predictive control for PyTorch, and attacks on it."""

import importlib
import logging
from types import ModuleType

from . import attacks, detection, plot, systems, tuning
from . import operators as _operators  # noqa: F401  # defines torch.ops.torch_dpc
from .attacks import (
    BallBudget,
    BoxBudget,
    EllipsoidBudget,
    L1BallBudget,
    PerChannelBudget,
    PerSampleBudget,
    RelativeBallBudget,
    SparseBallBudget,
    StealthyBudget,
)
from .control.controller import DPCController
from .control.log import ClosedLoopLog
from .control.nearest import NearestWindows
from .control.simulation import simulate
from .data.hankel import HankelData, excitation_order, hankel
from .data.hankel_batch import HankelBatch
from .data.stream import HankelStream
from .errors import ExcitationWarning, InfeasibleError, SolveError, Status
from .layer import DPCLayer
from .problem.compact_form import CompactForm
from .saving import register_set
from .sets import Ball, Box, ConvexSet, NonNegative, Product, Reals, SecondOrderCone, SoftBox
from .solution import DPCSolution
from .solve.info import SolveInfo
from .systems.plant import Plant, collect

__version__ = "0.1.0"

logging.getLogger(__name__).addHandler(logging.NullHandler())  # the application decides what is shown

__all__ = [
    "Ball",
    "BallBudget",
    "Box",
    "BoxBudget",
    "ClosedLoopLog",
    "CompactForm",
    "ConvexSet",
    "DPCController",
    "DPCLayer",
    "DPCSolution",
    "EllipsoidBudget",
    "ExcitationWarning",
    "HankelBatch",
    "HankelData",
    "HankelStream",
    "InfeasibleError",
    "L1BallBudget",
    "NearestWindows",
    "NonNegative",
    "PerChannelBudget",
    "PerSampleBudget",
    "Plant",
    "Product",
    "Reals",
    "RelativeBallBudget",
    "SecondOrderCone",
    "SoftBox",
    "SolveError",
    "SolveInfo",
    "SparseBallBudget",
    "Status",
    "StealthyBudget",
    "attacks",
    "detection",
    "collect",
    "excitation_order",
    "hankel",
    "plot",
    "register_set",
    "simulate",
    "systems",
    "tuning",
]


def __getattr__(name: str) -> ModuleType:
    """Import `torch_dpc.envs` when it is first used: it needs the extra `gym`."""
    if name == "envs":
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
