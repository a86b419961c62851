"""Intervals of v and lam over the whole budget: what they decide needs no branching."""

from __future__ import annotations

import time

import numpy as np

from .complementarity import HIGH, LOW, Array, Budgeted, Rows, allowed_states, is_open
from .relaxation import Linear, relax
from .search import reaches


def tighten(rows: Rows, budget: Budgeted, deadline: float) -> None:
    """Shrink the intervals of every undecided row, in place, by convex programs and by interval arithmetic.

    Args:
        rows: the rows.
        budget: of s.
        deadline: of `time.monotonic`; no program is begun after it.
    """
    rows.propagate()
    for i in np.flatnonzero(is_open(allowed_states(rows))).tolist():
        for side, sign in ((HIGH, 1.0), (LOW, -1.0)):
            # Towards the bound first: what cannot reach it needs nothing further.
            for of, direction in (("v", sign), ("lam", sign), ("v", -sign), ("lam", -sign)):
                states = allowed_states(rows)
                if not states[i] & side or not is_open(states)[i] or time.monotonic() > deadline:
                    break
                most = -relax(rows, budget.pieces, states, _row(rows, i, of, -direction)).bound
                _note(rows, i, of, direction, most)
        rows.propagate()


def others_that_reach(
    rows: Rows, budget: Budgeted, v0: Array, A: Array, G: Array, bounds: tuple[Array, Array], deadline: float
) -> list[int]:
    """Return which other rows, v = v0 + A s - G lam, may reach a bound while `rows` hold theirs.

    Args:
        rows: the rows that are held.
        budget: of s.
        v0, A, G: of the other rows, `(m,)`, `(m, d)` and `(m, n)`.
        bounds: lower and upper of the other rows, `(m,)` each.
        deadline: of `time.monotonic`; a row that is not judged by then counts as one that may.
    """
    states, spread = allowed_states(rows), budget.most(A)
    low = np.where(states & LOW, rows.lam_low, 0.0)
    high = np.where(states & HIGH, rows.lam_high, 0.0)
    reach = []
    for i in range(len(v0)):
        for sign, room in ((1.0, bounds[1][i] - v0[i]), (-1.0, v0[i] - bounds[0][i])):
            pull = -sign * G[i]
            with np.errstate(invalid="ignore"):  # 0 times an infinite multiplier is 0
                by_intervals = spread[i] + np.nan_to_num(np.maximum(pull * low, pull * high), posinf=np.inf).sum()
            if by_intervals < room - rows.margin:
                continue
            if reaches(rows, budget.pieces, Linear(-sign * A[i], sign * G[i]), room - rows.margin, deadline):
                reach.append(i)
                break
    return reach


def _row(rows: Rows, i: int, of: str, factor: float) -> Linear:
    """Return factor times v_i - v0_i, or factor times lam_i."""
    if of == "v":
        return Linear(factor * rows.A[i], -factor * rows.G[i])
    unit = np.zeros(len(rows.v0))
    unit[i] = factor
    return Linear(np.zeros(rows.A.shape[1]), unit)


def _note(rows: Rows, i: int, of: str, direction: float, most: float) -> None:
    """Take note of the largest (direction 1) or smallest v or lam of a row; `most` is direction times it, less v0."""
    if not np.isfinite(most):
        return
    value = direction * most + (rows.v0[i] if of == "v" else 0.0)
    low, high = (rows.v_low, rows.v_high) if of == "v" else (rows.lam_low, rows.lam_high)
    if direction > 0:
        high[i] = min(high[i], value)
    else:
        low[i] = max(low[i], value)
