"""Caps of multipliers and intervals of rows over a whole budget, many at once."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from ..budgets.base import NormBound
from .complementarity import Array, Rows
from .moments import Moments
from .relaxation import Quadratic

#: Tolerance of the largest sum of multipliers of a channel, in units of each row's own reach.
COARSE = 1.0


def shrink(
    rows: Rows,
    pieces: list[NormBound],
    lam: Array,
    channel: NDArray[np.int64],
    deadline: float,
    better_than: tuple[Quadratic, float] | None = None,
) -> bool:
    """Shrink the intervals of all rows in place, channel by channel; return whether they are still possible.

    The largest sum of |lam| over the rows of a channel caps each of them, and its proof is an ellipsoid that holds
    every plan: that bounds each v and lam of every channel.

    Args:
        rows: with intervals.
        pieces: the budget in s.
        lam: of the plan at s = 0, of these rows.
        channel: of these rows.
        deadline: of `time.monotonic`.
        better_than: only plans with a smaller psi than this value count.
    """
    for one in np.unique(channel):
        moments = Moments(rows, pieces, lam, better_than)
        weight = (channel[moments.pick] == one).astype(float)
        if not weight.any():
            continue
        if time.monotonic() > deadline:
            break
        found = moments.minimum(moments.multipliers(weight), weight, tolerance=COARSE, deadline=deadline)
        if found is None:
            break
        caps = np.where(weight > 0, -found.bound, np.inf) * moments.scale
        _note(rows, moments, caps, caps)
        if found.most is not None:
            high, low = found.most(moments.lam) * moments.scale, found.most(-moments.lam) * moments.scale
            _note(rows, moments, high, low)
            pick = moments.pick
            rows.v_high[pick] = np.minimum(rows.v_high[pick], found.most(moments.v) / moments.scale)
            rows.v_low[pick] = np.maximum(rows.v_low[pick], -found.most(-moments.v) / moments.scale)
        if not rows.propagate():
            return False
    return True


def _note(rows: Rows, moments: Moments, high: Array, low: Array) -> None:
    pick = moments.pick
    rows.lam_high[pick] = np.minimum(rows.lam_high[pick], high)
    rows.lam_low[pick] = np.maximum(rows.lam_low[pick], -low)
