"""The convex program of a node: the rows that are undecided may be anywhere in the convex hull of their states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..budgets.base import NormBound
from .complementarity import HIGH, LOW, Array, Rows

#: The bound of a node is the dual objective, lowered by this fraction of its size: the solver's own tolerance is 1e-8.
DUAL_SLACK = 1e-7


class Relaxed(NamedTuple):
    """The optimum of a node's convex program.

    Attributes:
        bound: no plan of the node has a lower objective; infinity where the node is empty.
        s, lam, v: where the optimum is; v and lam of the rows.
    """

    bound: float
    s: Array
    lam: Array
    v: Array


@dataclass(frozen=True, eq=False)
class Quadratic:
    """1/2 |a + B_s s + B_lam lam|^2, an objective over s and the multipliers of the rows."""

    a: Array
    B_s: Array
    B_lam: Array

    def in_z(self, to_lam: Array, d: int) -> tuple[Array, Array, float]:
        """Return P, q, r of 1/2 z'Pz + q'z + r, lam = to_lam z and s the first d of z."""
        B = self.B_lam @ to_lam
        B[:, :d] += self.B_s
        return B.T @ B, self.a @ B, 0.5 * float(self.a @ self.a)


@dataclass(frozen=True, eq=False)
class Linear:
    """c_s's + c_lam'lam."""

    c_s: Array
    c_lam: Array

    def in_z(self, to_lam: Array, d: int) -> tuple[Array, Array, float]:
        """Return P, q, r of 1/2 z'Pz + q'z + r, lam = to_lam z and s the first d of z."""
        q = self.c_lam @ to_lam
        q[:d] += self.c_s
        return np.zeros((len(q), len(q))), q, 0.0


#: Rows of a conic constraint: matrix, right side, and which cone the difference right - matrix z lies in.
Block = tuple[Array, Array, str]


@dataclass(frozen=True, eq=False)
class Region:
    """The relaxation of the rows' allowed states, a convex set of z.

    z holds s, and of each row that may be at its upper (lower) bound a multiplier lam+ (lam-) >= 0.

    Attributes:
        blocks: what bounds it.
        to_lam: lam = to_lam z, `(n, n_z)`.
        B: v = v0 + B z, `(n, n_z)`.
        d: entries of s, the first of z.
    """

    blocks: list[Block]
    to_lam: Array
    B: Array
    d: int

    @staticmethod
    def of(
        rows: Rows,
        budget: list[NormBound],
        allowed: NDArray[np.int8],
    ) -> Region:
        """Return the relaxation.

        Args:
            rows: the rows and their intervals.
            budget: pieces in s.
            allowed: the states left to each row, `(n,)`.
        """
        high, low, d = np.flatnonzero(allowed & HIGH), np.flatnonzero(allowed & LOW), rows.A.shape[1]
        to_lam = np.zeros((len(rows.v0), d + len(high) + len(low)))
        to_lam[high, d + np.arange(len(high))], to_lam[low, d + len(high) + np.arange(len(low))] = 1.0, -1.0
        B = -rows.G @ to_lam
        B[:, :d] = rows.A
        blocks = [*_of_states(rows, allowed, B), *_hulls(rows, allowed, B), *_of_budget(budget, B.shape[1])]
        return Region([block for block in blocks if len(block[1])], to_lam, B, d)


def relax(rows: Rows, budget: list[NormBound], allowed: NDArray[np.int8], objective: Quadratic | Linear) -> Relaxed:
    """Minimise an objective over the convex relaxation of the rows' allowed states.

    Args:
        rows: the rows and their intervals.
        budget: pieces in s.
        allowed: the states left to each row, `(n,)`.
        objective: of s and lam.
    """
    import clarabel
    from scipy import sparse

    region = Region.of(rows, budget, allowed)
    kinds: dict[str, Any] = {
        "zero": clarabel.ZeroConeT,
        "nonnegative": clarabel.NonnegativeConeT,
        "cone": clarabel.SecondOrderConeT,
    }
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    P, q, constant = objective.in_z(region.to_lam, region.d)
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(P)),
        q,
        sparse.csc_matrix(np.vstack([matrix for matrix, _, _ in region.blocks])),
        np.concatenate([right for _, right, _ in region.blocks]),
        [kinds[kind](len(right)) for _, right, kind in region.blocks],
        settings,
    ).solve()
    status, z = str(solution.status), np.array(solution.x)
    bound = -np.inf  # nothing is known of a node that the solver gave up
    if "PrimalInfeasible" in status:
        bound = np.inf
    elif "Solved" in status:
        value = solution.obj_val_dual + constant
        bound = value - DUAL_SLACK * (1.0 + abs(value))
    return Relaxed(bound, z[: region.d], region.to_lam @ z, rows.v0 + region.B @ z)


def _of_states(rows: Rows, allowed: NDArray[np.int8], B: Array) -> list[Block]:
    """Return what holds of v: equal to a bound where that is decided, else within the bounds that it may reach."""
    only_high, only_low = allowed == HIGH, allowed == LOW
    top = ~only_high & np.isfinite(rows.upper) & (rows.v_high >= rows.upper - rows.margin)
    bottom = ~only_low & np.isfinite(rows.lower) & (rows.v_low <= rows.lower + rows.margin)
    return [
        (B[only_high], (rows.upper - rows.v0)[only_high], "zero"),
        (B[only_low], (rows.lower - rows.v0)[only_low], "zero"),
        (B[top], (rows.upper - rows.v0)[top], "nonnegative"),
        (-B[bottom], (rows.v0 - rows.lower)[bottom], "nonnegative"),
    ]


def _hulls(rows: Rows, allowed: NDArray[np.int8], B: Array) -> list[Block]:
    """Return what holds of the multipliers: their signs, their intervals, and the hull of "free or at the bound".

    With 0 <= lam+ <= lam_high and v_low <= v that hull is  lam+ / lam_high + (upper - v) / (upper - v_low) <= 1;
    the lower bound likewise, with v and lam negated.
    """
    blocks: list[Block] = []
    column = rows.A.shape[1]
    for side, sign in ((HIGH, 1.0), (LOW, -1.0)):
        i = np.flatnonzero(allowed & side)
        own = np.zeros((len(i), B.shape[1]))
        own[np.arange(len(i)), column + np.arange(len(i))] = 1.0
        column += len(i)
        least, most = (rows.lam_low, rows.lam_high) if sign > 0 else (-rows.lam_high, -rows.lam_low)
        room = rows.upper - rows.v_low if sign > 0 else rows.v_high - rows.lower
        to_bound = rows.upper - rows.v0 if sign > 0 else rows.v0 - rows.lower
        decided = allowed[i] == side
        blocks.append((-own, -np.where(decided, np.maximum(least[i], 0.0), 0.0), "nonnegative"))
        held = decided & np.isfinite(most[i])
        blocks.append((own[held], most[i][held], "nonnegative"))
        hull = ~decided & np.isfinite(most[i])
        cap, rest, gap = most[i][hull], room[i][hull], to_bound[i][hull]
        left = own[hull] * rest[:, None] - sign * cap[:, None] * B[i][hull]
        scale = np.maximum(np.maximum(rest, cap), np.finfo(float).tiny)
        blocks.append((left / scale[:, None], cap * (rest - gap) / scale, "nonnegative"))
    return blocks


def _of_budget(budget: list[NormBound], n_z: int) -> list[Block]:
    blocks: list[Block] = []
    for piece in budget:
        matrix = np.zeros((len(piece.matrix), n_z))
        matrix[:, : piece.matrix.shape[1]] = piece.matrix
        if len(matrix) == 1:
            ends = piece.radius - piece.offset, piece.radius + piece.offset
            blocks.append((np.vstack([matrix, -matrix]), np.concatenate(ends), "nonnegative"))
        else:
            blocks.append(_cone(matrix, piece.offset, piece.radius))
    return blocks


def _cone(matrix: Array, offset: Array, radius: float) -> Block:
    """Return |matrix z + offset| <= radius."""
    return np.vstack([np.zeros((1, matrix.shape[1])), -matrix]), np.concatenate([[radius], offset]), "cone"
