"""What plans are possible under a budget, as a complementarity system over few variables.

The plan solves (:mod:`torch_dpc.problem.reduction`)

    v = v0 + Vp p - G lam,    lam in the normal cone of the box at v,

for a fixed window. Row by row that is one of three states: at the lower bound (lam <= 0), free (lam = 0), at the upper
bound (lam >= 0). With p = N s the budget is a set of few variables s: the singular value decomposition of Vp drops the
directions of p that no row can see, where the budget is a ball or an ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..budgets.base import NormBound

Array = NDArray[np.float64]

#: Singular values of p -> v at or below this fraction of the largest are dropped; the bound is lowered by their effect.
UNSEEN = 1e-8
#: Eigenvalues of G at or below this fraction of the largest mean that rows depend on each other.
DEPENDENT = 1e-12
#: Interval arithmetic goes on while a round shrinks the widths by more than this fraction.
PROGRESS = 1e-3


#: The states of a row, as bits of what is still allowed.
LOW, FREE, HIGH = 1, 2, 4


@dataclass(frozen=True, eq=False)
class Budgeted:
    """A budget in the variables s, p = N s.

    Attributes:
        N: `(t_ini n_y, d)`.
        pieces: their intersection is the budget.
        unseen: how far the dropped directions of p can move v at most, Euclidean.
    """

    N: Array
    pieces: list[NormBound]
    unseen: float

    def most(self, A: Array) -> Array:
        """Return an upper bound on |A_i s| for each row of A, `(n,)`; exact for one ball, and for a box."""
        bounds = [np.full(len(A), np.inf)]
        intervals = [piece for piece in self.pieces if len(piece.matrix) == 1]
        for piece in [*self.pieces, *([_stacked(intervals)] if intervals else [])]:
            radius = piece.radius + float(np.linalg.norm(piece.offset))
            if np.linalg.matrix_rank(piece.matrix) == piece.matrix.shape[1]:
                bounds.append(np.linalg.norm(A @ np.linalg.pinv(piece.matrix), axis=1) * radius)
        if intervals and len(intervals) == A.shape[1]:
            M = np.vstack([piece.matrix for piece in intervals])
            if np.linalg.matrix_rank(M) == len(M):
                radii = np.array([piece.radius + abs(piece.offset[0]) for piece in intervals])
                bounds.append(np.abs(A @ np.linalg.inv(M)) @ radii)
        return np.min(bounds, axis=0)


def in_few_variables(Vp: Array, pieces: list[NormBound]) -> Budgeted:
    """Return a budget in as few variables as the rows can see.

    Args:
        Vp: p -> v without bounds, `(N, t_ini n_y)`.
        pieces: the budget as pieces in p. Entries that an interval of radius 0 fixes at 0 are dropped.
    """
    fixed = [piece for piece in pieces if len(piece.matrix) == 1 and piece.radius == 0.0]
    moves = np.ones(Vp.shape[1], dtype=bool)
    for piece in fixed:
        moves[np.flatnonzero(piece.matrix[0])] = False
    N = np.eye(Vp.shape[1])[:, moves]
    rest = [NormBound(p.matrix @ N, p.offset, p.radius) for p in pieces if not any(p is f for f in fixed)]
    if len(rest) != 1 or np.any(rest[0].offset) or len(rest[0].matrix) < N.shape[1]:
        return Budgeted(N, rest, 0.0)
    (ball,) = rest  # p = N M^-1 q with |q| <= radius: only the directions of q that move v are kept
    to_p = N @ np.linalg.pinv(ball.matrix) * ball.radius
    _, size, directions = np.linalg.svd(Vp @ to_p, full_matrices=False)
    seen = int((size > UNSEEN * max(size[0], np.finfo(float).tiny)).sum()) if len(size) else 0
    unit = NormBound(np.eye(seen), np.zeros(seen), 1.0)
    return Budgeted(to_p @ directions[:seen].T, [unit], float(size[seen]) if seen < len(size) else 0.0)


def _stacked(intervals: list[NormBound]) -> NormBound:
    """Return a ball that holds an intersection of intervals."""
    radius = float(np.linalg.norm([piece.radius + abs(piece.offset[0]) for piece in intervals]))
    matrix = np.vstack([piece.matrix for piece in intervals])
    return NormBound(matrix, np.zeros(len(matrix)), radius)


@dataclass(eq=False)
class Rows:
    """The constrained rows that may reach a bound within the budget, and what is known of them.

    Attributes:
        index: their places in v, `(n,)`.
        v0: v at p = 0 without multipliers, `(n,)`.
        A: s -> v, `(n, d)`.
        G: of the reduction, `(n, n)`.
        lower, upper: their bounds, `(n,)`.
        most: a bound on |A_i s| over the budget, `(n,)`.
        H: G^-1, or None where rows depend on each other.
        most_H: a bound on |(H A)_i s|, `(n,)`.
        v_low, v_high, lam_low, lam_high: intervals that hold v and lam for every p of the budget, `(n,)`.
    """

    index: NDArray[np.int64]
    v0: Array
    A: Array
    G: Array
    lower: Array
    upper: Array
    most: Array
    H: Array | None
    most_H: Array
    v_low: Array
    v_high: Array
    lam_low: Array
    lam_high: Array

    #: How close to a bound an interval must come to reach it: rounding of the solver that found the interval.
    margin = 1e-7

    @staticmethod
    def of(
        index: NDArray[np.int64],
        v0: Array,
        A: Array,
        G: Array,
        bounds: tuple[Array, Array],
        nominal: tuple[Array, Array],
        budget: Budgeted,
    ) -> Rows:
        """Return rows with intervals from the nonexpansiveness of the projection.

        With G = C C' the plan is v = C x, x a projection of x0 + X s onto a polytope. A projection is firmly
        nonexpansive: dx = X s / 2 + w and C' dlam = X s - dx = X s / 2 - w with |w| <= |X s| / 2. So

            |dv_i| <= (|A_i s| + sqrt(G_ii) |X s|) / 2,    |dlam_i| <= (|(G^-1 A)_i s| + sqrt((G^-1)_ii) |X s|) / 2.

        Args:
            index: the rows.
            v0, A, G: of all rows of v.
            bounds: lower and upper, of all rows.
            nominal: v and lam of the plan at p = 0.
            budget: of s.
        """
        v0, A, G = v0[index], A[index], G[np.ix_(index, index)]
        lower, upper = (bound[index] for bound in bounds)
        v, lam = (x[index] for x in nominal)
        values, vectors = np.linalg.eigh(G)
        seen = values > DEPENDENT * values.max(initial=0.0)
        independent = bool(seen.all())
        root = vectors / np.sqrt(np.where(seen, values, np.inf))
        X = root.T @ A
        R = float(np.linalg.norm(budget.most(X)))
        if len(budget.pieces) == 1:
            R = min(R, float(np.linalg.norm(X @ np.linalg.pinv(budget.pieces[0].matrix), 2)) * budget.pieces[0].radius)
        most, most_H = budget.most(A), budget.most(root @ X)
        dv = (most + np.sqrt(G.diagonal()) * R) / 2
        # Dependent rows have multipliers of any size.
        dlam = (most_H + np.sqrt((root**2).sum(1)) * R) / 2 if independent else np.full(len(v), np.inf)
        return Rows(
            *(index, v0, A, G, lower, upper, most, root @ root.T if independent else None, most_H),
            v_low=np.maximum(lower, v - dv),
            v_high=np.minimum(upper, v + dv),
            lam_low=lam - dlam,
            lam_high=lam + dlam,
        )

    def copy(self) -> Rows:
        """Return the same rows with intervals of their own."""
        names = ("v_low", "v_high", "lam_low", "lam_high")
        return replace(self, **{name: getattr(self, name).copy() for name in names})

    def decide(self, row: int, state: int) -> None:
        """Put a row into one state."""
        if state != HIGH:
            self.lam_high[row] = min(self.lam_high[row], 0.0)
        if state != LOW:
            self.lam_low[row] = max(self.lam_low[row], 0.0)
        if state == HIGH:
            self.v_low[row] = self.upper[row]
        if state == LOW:
            self.v_high[row] = self.lower[row]

    def propagate(self, rounds: int = 20) -> bool:
        """Shrink the intervals by interval arithmetic; return whether they are still possible.

        Given the other rows, row i is a scalar problem in either form of the system:

            v_i + G_ii lam_i = w_i = (v0 + A s)_i - sum over j of G_ij lam_j,
            lam_i + H_ii v_i = h_i = (H (v0 + A s))_i - sum over j of H_ij v_j,

        so that v_i and lam_i are monotone functions of w_i, and of h_i. An interval that is empty by more than `margin`
        excludes the states that were decided.
        """
        for _ in range(rounds):
            size = (self.v_high - self.v_low).sum()
            if np.isfinite(self.lam_low).all() and np.isfinite(self.lam_high).all():
                diagonal = np.maximum(self.G.diagonal(), np.finfo(float).tiny)
                centre, spread = _others(self.G, self.lam_low, self.lam_high)
                self._meet(self.v0 - centre, self.most + spread, diagonal, 1.0)
            if self.H is not None and np.isfinite(self.v_low).all() and np.isfinite(self.v_high).all():
                centre, spread = _others(self.H, self.v_low, self.v_high)
                self._meet(self.H @ self.v0 - centre, self.most_H + spread, self.H.diagonal(), self.H.diagonal())
            slack = np.minimum(self.v_high - self.v_low, self.lam_high - self.lam_low)
            if slack.min(initial=0.0) < -self.margin:
                return False
            if not (self.v_high - self.v_low).sum() < size - PROGRESS * max(size, 1.0):
                break
        return True

    def _meet(self, centre: Array, radius: Array, of_lam: Array, of_v: Array | float) -> None:
        """Meet the intervals with those of scale_v v + scale_lam lam = w, w within radius of the centre.

        In the first form scale_v is 1 and scale_lam is G_ii; in the second they are H_ii and 1.
        """
        scale_lam = of_lam if isinstance(of_v, float) else np.ones_like(of_lam)
        for w, is_low in ((centre - radius, True), (centre + radius, False)):
            v = np.clip(w / of_v, self.lower, self.upper)
            lam = (w - of_v * v) / scale_lam
            if is_low:
                np.maximum(self.v_low, v, out=self.v_low)
                np.maximum(self.lam_low, lam, out=self.lam_low)
            else:
                np.minimum(self.v_high, v, out=self.v_high)
                np.minimum(self.lam_high, lam, out=self.lam_high)


def _others(M: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return centre and half width of M x without each row's own entry, for x in a box."""
    middle, half = (high + low) / 2, np.maximum(high - low, 0.0) / 2
    return M @ middle - M.diagonal() * middle, np.abs(M) @ half - np.abs(M.diagonal()) * half


def allowed_states(rows: Rows) -> NDArray[np.int8]:
    """Return the states that the intervals leave to each row, `(n,)`, bits of LOW, FREE and HIGH."""
    high = (rows.v_high >= rows.upper - rows.margin) & (rows.lam_high > rows.margin)
    low = (rows.v_low <= rows.lower + rows.margin) & (rows.lam_low < -rows.margin)
    free = (rows.lam_low <= rows.margin) & (rows.lam_high >= -rows.margin)
    return (LOW * low + FREE * (free | ~(low | high)) + HIGH * high).astype(np.int8)


def is_open(allowed: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return which rows have more than one state left."""
    return (allowed & (allowed - 1)) != 0
