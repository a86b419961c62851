"""The compiled kernels of one sample, which read its windows where they lie; they need :func:`kernels.are_built`."""

from __future__ import annotations

import numpy as np

from .kernel_settings import _kernels
from .kernels import SETTINGS, Map, SetArrays


def plan_one(
    of: Map, sets: SetArrays, windows: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, bool]:
    """Return theta and the plan of one sample: theta, v, lam, active, weak, info, convinces, as `plan` does.

    Args:
        of: the reduced problem.
        sets: in units, from `set_arrays`.
        windows: address, count and places to fill of each part of theta in turn: float64 numbers, repeated until the
            places are full, or zeros for the address 0.
    """
    n, n_theta = len(of.unit), len(of.per_theta)
    theta, v, lam, info = np.empty(n_theta), np.empty(n), np.empty(n), np.empty(5)
    active, weak = np.empty(n, dtype=bool), np.empty(n, dtype=bool)
    options = SETTINGS.compiled, 1
    convinces = _kernels.plan_one(of.arguments, sets, windows, theta, v, lam, active, weak, info, *options)
    return theta, v, lam, active, weak, info, convinces


def adjoint_one(
    of: Map, sets: SetArrays, at: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], windows: tuple[int, ...]
) -> np.ndarray | None:
    """Return theta_bar `(n_theta,)` of one sample; None if its held directions are dependent.

    Args:
        of: the reduced problem.
        sets: in units, from `set_arrays`.
        at: v, lam, active and weak rows of the plan, `(N,)`, as for `plan_adjoint`.
        windows: address, count and places to fill of the parts of v_bar and then lam_bar, as for `plan_one`.
    """
    bars, theta_bar = np.empty(2 * len(of.unit)), np.empty(len(of.per_theta))
    options = SETTINGS.compiled, 1
    return theta_bar if _kernels.adjoint_one(of.arguments, sets, *at, windows, bars, theta_bar, *options) else None


def holds(address: int, numbers: np.ndarray) -> bool:
    """Return whether the memory at an address holds the same bytes as a contiguous array."""
    same: bool = _kernels.holds(address, numbers)
    return same
