"""Figures of data, plans, runs and damage (extra `plot`).

Every function takes axes, or makes a figure, and returns the figure. matplotlib is imported by the first call and no
backend is chosen: in a script `matplotlib.pyplot.show()` opens the figures, in a notebook they appear below the cell,
and `figure.savefig(path)` writes them. `log.plot()`, `plan.plot()` and `data.plot()` are these functions as methods.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .animation import animate
    from .attacks import damage, perturbation, worst_case
    from .plans import plan
    from .recordings import data
    from .runs import log

_HOMES = {
    "animate": "animation",
    "damage": "attacks",
    "data": "recordings",
    "log": "runs",
    "perturbation": "attacks",
    "plan": "plans",
    "worst_case": "attacks",
}

__all__ = ["animate", "damage", "data", "log", "perturbation", "plan", "worst_case"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        raise ImportError("figures need matplotlib: pip install 'torch_dpc[plot]'.") from error


def __dir__() -> list[str]:
    return sorted(__all__)
