"""Is there a plan at all: the least violation, relative to each channel, by HiGHS (intervals) or Clarabel (others)."""

from dataclasses import replace

import numpy as np
from scipy.optimize import linprog

from .blocks import Block
from .conic import conic
from .extended import LONG, Array, long
from .reduction import Reduced

CONFIRMED = 1e-9  # v / scale of the solver and of the rows agree to this, or nothing is decided
RANGE = 1e-9  # singular values below this share of the largest do not move v
MARGIN = 1e-3  # sets are shrunk by up to so much, so that a plan that exists lies inside beyond a solver's tolerance


def least_violation(reduced: Reduced, blocks: list[Block]) -> float:
    """Return the least over x of the largest violation of a hard set, relative to its channel; nan if undecided."""
    hard = [b for b in blocks if b.hard]
    if not hard:
        return 0.0
    c = np.asarray(reduced.c, float)
    left, size, right = np.linalg.svd(np.asarray(reduced.natural, float), full_matrices=False)
    moving = size > RANGE * max(size.max(initial=0.0), 1e-300)
    basis = left[:, moving]
    magnitude = max(1.0, float(np.abs(c).max()))  # numbers near 1 for the solvers
    if all(b.kind == "interval" for b in hard):
        x = _linear(hard, basis, c / magnitude, magnitude)
    else:
        x = _curved(hard, basis, c, magnitude)
    if x is None:
        return np.nan
    v = basis @ (x * magnitude) + c
    # The basis has rounding errors, and a far x can live on them: the rows themselves must reach v.
    reached = reduced.natural @ long(right[moving].T @ (x * magnitude / size[moving])) + reduced.c
    if np.abs(reached - v).max(initial=0.0) > CONFIRMED:
        return np.nan
    return max(float(b.violation(b.z_of(v))) for b in hard)


def _linear(hard: list[Block], basis: Array, c: Array, magnitude: float) -> Array | None:
    """Return x that minimises t subject to lower - t <= v <= upper + t."""
    rows, ends = [], []
    for b in hard:
        row, at = basis[b.rows[0]], c[b.rows[0]]
        for sign, end in ((1, b.upper), (-1, b.lower)):
            if np.isfinite(end):
                rows.append(np.append(sign * row, -1.0))
                ends.append(sign * (float(end) / magnitude - at))
    n = basis.shape[1]
    answer = linprog(
        np.append(np.zeros(n), 1.0), A_ub=np.array(rows), b_ub=np.array(ends),
        bounds=[(None, None)] * n + [(-MARGIN, None)],
        method="highs", options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )  # fmt: skip
    return answer.x[:n] if answer.x is not None else None


def _curved(hard: list[Block], basis: Array, c: Array, magnitude: float) -> Array | None:
    """Return the same with balls whose radius and cones whose bound grow by t."""
    n = basis.shape[1]
    one = np.zeros(1)
    floor = Block("interval", np.zeros(1, int), one + 1, one, np.zeros((1, n + 1)), one, -LONG(MARGIN))
    parts = [(floor, np.append(np.zeros(n), 1.0)[None], one)]
    for b in hard:
        M = np.asarray(b.shares[:, None] * basis[b.rows], float)
        m = np.asarray(b.z_of(c), float) / magnitude
        if b.kind == "interval":
            for sign, end in ((1, b.upper), (-1, b.lower)):
                if np.isfinite(end):
                    row = np.hstack([sign * M, [[-1.0]]])
                    parts.append((replace(b, lower=LONG(-np.inf), upper=sign * end / magnitude), row, sign * m))
        elif b.kind == "cone":
            grow = np.zeros((len(M), 1))
            grow[0] = 1
            parts.append((b, np.hstack([M, grow]), m))
        else:  # |z| <= radius + t is a cone with its bound first
            M = np.vstack([np.append(np.zeros(n), 1.0), np.hstack([M, np.zeros((len(M), 1))])])
            parts.append((replace(b, kind="cone"), M, np.concatenate([[float(b.radius) / magnitude], m])))
    x, _ = conic(np.zeros((n + 1, n + 1)), np.append(np.zeros(n), 1.0), parts, 1e-11)
    return x[:n] if np.isfinite(x).all() else None
