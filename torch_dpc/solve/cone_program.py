"""A sample of the problem in extended precision as a cone program, and its solution back as a plan with multipliers.

Rows that the equalities decide have no multiplier; intervals of no width, and balls of radius zero, are equalities and
are eliminated. What is left is scaled: rows to unit length, and the unknowns so that the way from the unconstrained
minimiser to the sets is near 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..problem.extended import Extended, Sample
from ..problem.long_double import Array, kernel_of
from .cones import inside
from .interior_point import ConeProgram, Point, solve
from .polish import polished

#: Charge on directions in which the cost is flat, relative to the other directions: it breaks ties.
CHARGE = 1e-12
#: Equalities whose part outside the span of the others is below this follow from them.
DEPENDENT = 1e-13
#: The charge on flat directions changes multipliers by less than this fraction.
LITTLE = 1e-3


@dataclass(frozen=True, eq=False)
class Block:
    """Rows of v that a ball (center and radius) or a cone (no center; the first row is the bound) holds."""

    rows: Array
    center: Array | None
    radius: float

    @property
    def is_point(self) -> bool:
        """Whether it is a ball of radius zero."""
        return self.center is not None and self.radius == 0


@dataclass(frozen=True, eq=False)
class Ends:
    """The sets of one sample in units, as plain arrays.

    Attributes:
        lower, upper, price: `(N,)`; infinite where there is none, and infinite prices where the interval is hard.
        blocks: the balls and cones.
    """

    lower: Array
    upper: Array
    price: Array
    blocks: list[Block]


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The unknowns y of a program: x = start + columns free y, and what holds x to that.

    Attributes:
        start: `(n_x,)`, and
        free: `(n_x, n)`, a basis of what the held rows leave, in
        columns: scaled coordinates, `(n_x,)`.
        held: rows of v that are equalities, and
        pinv: the pseudo-inverse of their rows, divided by
        length: their lengths.
    """

    start: Array
    free: Array
    columns: Array
    held: Array
    pinv: Array
    length: Array

    @property
    def basis(self) -> Array:
        """How y moves x, `(n_x, n)`."""
        return self.columns[:, None] * self.free


@dataclass(frozen=True, eq=False)
class Scaled:
    """A cone program and the way back from it.

    Attributes:
        program: in units of `reach`.
        at: the unknowns.
        places, signs, sizes: the rows of v behind the rows of the program, at which end, and what they were divided by.
        blocks, of_blocks: the blocks behind its cones, and what they were divided by.
        weight: of each entry of x in the cost.
        reach: the unit of y.
    """

    program: ConeProgram
    at: Coordinates
    places: Array
    signs: Array
    sizes: Array
    blocks: list[Block]
    of_blocks: list[float]
    weight: Array
    reach: float

    def back(self, problem: Extended, sample: Sample, point: Point) -> tuple[Array, Array]:
        """Return x and the multipliers of v of a point, `(n_x,)` and `(N,)`."""
        at, x = self.at, self.at.start + self.reach * (self.at.basis @ point.y)
        lam = self._multipliers(point, len(sample.c))
        if len(at.held):
            slope = np.zeros_like(x)
            slope[: problem.n_xi] = x[: problem.n_xi] - sample.xi0
            lam[at.held] = self._of_held(slope + lam @ problem.M)
        return x, without_work(lam, problem.M[:, problem.n_xi :])

    def direction(self, problem: Extended, point: Point) -> Array:
        """Return the direction of the multipliers of an iterate that diverges, `(N,)`; zero on rows with a price."""
        d = self._multipliers(replace(point, z=np.where(np.isinf(self.program.price), point.z, 0)), len(problem.M))
        if len(self.at.held):
            d[self.at.held] = self._of_held(d @ problem.M)
        size = np.abs(d).max(initial=0.0)
        return d / size if size > 0 else d

    def _of_held(self, slope: Array) -> Array:
        """Return the multipliers of the held rows that balance a slope in x."""
        at = self.at
        balance: Array = -(at.pinv.T @ (at.columns * slope)) / at.length
        return balance

    def _multipliers(self, point: Point, n: int) -> Array:
        """Return the multipliers of v `(n,)` of the rows and cones of the program."""
        lam = np.zeros(n, dtype=np.longdouble)
        binds = point.z > np.maximum(point.s, 0)  # a multiplier that is small beside its slack is zero
        np.add.at(lam, self.places, np.where(binds, self.signs * point.z * self.reach / self.sizes, 0))
        deep = inside(point.s_cone)
        for k, (block, size) in enumerate(zip(self.blocks, self.of_blocks, strict=True)):
            z = point.z_cone[k]
            if z[0] > max(deep[k], 0):
                k_rows = len(block.rows)
                held = z[:k_rows] if block.center is None else z[1 : k_rows + 1]
                lam[block.rows] -= held * self.reach / size
        return lam


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the method found for a sample, in long double.

    Attributes:
        candidates: x with multipliers of v, `(n_x,)` and `(N,)`: polished, and as the method left them.
        direction: of its last multipliers, which separates trajectories and sets where there is no plan, `(N,)`.
    """

    candidates: list[tuple[Array, Array]]
    direction: Array


def outcome_of(problem: Extended, sample: Sample, ends: Ends, centre: Array) -> Outcome:
    """Solve a sample; flat directions of the cost are charged for how far they lead from `centre`, `(n_k,)`."""
    scaled = scaled_program(problem, sample, ends, centre)
    best, last = solve(scaled.program)
    candidates = [scaled.back(problem, sample, one) for one in (polished(scaled.program, best), best)]
    return Outcome(candidates, scaled.direction(problem, last))


def scaled_program(problem: Extended, sample: Sample, ends: Ends, centre: Array) -> Scaled:
    """Return the program of a sample."""
    moves = np.abs(problem.M).max(axis=1, initial=0.0) > 0
    origin = np.concatenate([sample.xi0, centre])
    at = _coordinates(problem, sample, ends, moves, origin)
    M, c = problem.M @ at.basis, sample.c + problem.M @ at.start
    places, signs = _interval_ends(ends, moves, at.held)
    G = signs[:, None] * M[places]
    h = signs * (np.where(signs > 0, ends.upper[places], ends.lower[places]) - c[places])
    sizes = _lengths(G)
    price = np.where(np.isfinite(ends.price[places]), ends.price[places] * sizes, np.inf)
    blocks = [block for block in ends.blocks if moves[block.rows].any() and not block.is_point]
    of_blocks = [float(_lengths(M[block.rows]).max()) for block in blocks]
    depth = max((len(block.rows) + (block.center is not None) for block in blocks), default=1)
    B = np.zeros((len(blocks), depth, M.shape[1]), dtype=np.longdouble)
    b = np.zeros((len(blocks), depth), dtype=np.longdouble)
    for k, (block, size) in enumerate(zip(blocks, of_blocks, strict=True)):
        first, n = int(block.center is not None), len(block.rows)
        B[k, first : first + n] = -M[block.rows] / size
        b[k, first : first + n] = (c[block.rows] - (0 if block.center is None else block.center)) / size
        if first:
            b[k, 0] = block.radius / size
    outside = max((-h / sizes).max(initial=0.0), (-inside(b)).max(initial=0.0))
    reach: Any = outside if outside > 0 else np.longdouble(1)
    weight = np.ones(len(at.start), dtype=np.longdouble)
    weight[problem.n_xi :] = CHARGE
    P, q = (at.basis.T * weight) @ at.basis, at.basis.T @ (weight * (at.start - origin))
    program = ConeProgram(P, q / reach, G / sizes[:, None], h / sizes / reach, price / reach, B, b / reach)
    return Scaled(program, at, places, signs, sizes, blocks, of_blocks, weight, reach)


def _coordinates(problem: Extended, sample: Sample, ends: Ends, moves: Array, start: Array) -> Coordinates:
    """Return the unknowns, held rows eliminated, near a start `(n_x,)`."""
    M, n = problem.M, problem.M.shape[1]
    columns = np.ones(n, dtype=np.longdouble)
    flat = np.abs(M[:, problem.n_xi :]).max(axis=0, initial=0.0)
    columns[problem.n_xi :] = 1 / np.where(flat > 0, flat, 1)
    is_held, target = (ends.lower == ends.upper) & np.isinf(ends.price), ends.lower.astype(np.longdouble)
    for block in ends.blocks:
        if block.is_point:
            is_held[block.rows], target[block.rows] = True, block.center
    held = (is_held & moves).nonzero()[0]
    if not len(held):
        return Coordinates(start, np.eye(n, dtype=np.longdouble), columns, held, np.zeros((n, 0)), np.zeros(0))
    rows = M[held] * columns
    length = _lengths(rows)
    pinv, free = kernel_of(rows / length[:, None], DEPENDENT)
    missed = target[held] - sample.c[held] - M[held] @ start
    return Coordinates(start + columns * (pinv @ (missed / length)), free, columns, held, pinv, length)


def _interval_ends(ends: Ends, moves: Array, held: Array) -> tuple[Array, Array]:
    """Return the rows of v that have an upper end and those that have a lower one, and the signs of the ends."""
    may = moves.copy()
    may[held] = False
    above, below = ((np.isfinite(end) & may).nonzero()[0] for end in (ends.upper, ends.lower))
    return np.concatenate([above, below]), np.repeat([1.0, -1.0], [len(above), len(below)])


def _lengths(rows: Array) -> Array:
    """Return the length of each row; 1 for rows of zeros."""
    length: Array = np.sqrt(np.square(rows).sum(axis=1))
    return np.where(length > 0, length, 1)


def without_work(lam: Array, K: Array) -> Array:
    """Return the multipliers without the work along K `(N, n_k)` that the charge on flat directions leaves them."""
    on = (lam != 0).nonzero()[0]
    rows = (K[on] * np.abs(lam[on])[:, None]).T
    some = np.square(rows).sum(axis=1) > 0
    if not some.any():
        return lam
    length = _lengths(rows[some])
    work = K[on][:, some].T @ lam[on]
    change = kernel_of(rows[some] / length[:, None], DEPENDENT)[0] @ (work / length)
    if not np.abs(change).max() < LITTLE:
        return lam
    out = lam.copy()
    out[on] -= np.abs(lam[on]) * change
    return out
