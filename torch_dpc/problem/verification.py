"""The reduced map, checked against the problem as posed, and corrected where rounding shows.

A plan is optimal iff two things hold. Its multipliers fit the sets, row by row: every sample checks that. And
a = A_theta theta - A_lam lam solves the linear conditions

    sum over the terms of the cost of S'W (S a - target) + C'lam = 0  on the kernel of Eq,     Eq a = e,     v = C a.

They hold for all samples if they hold for the matrices, so they are checked once for each set of weights: from the rows
of the data, the weights and the equalities, with no factor of the reduction in between. The factors serve afterwards,
to tell by how far each row of v is off where a condition is missed by a little. Rounding is bounded; where the bound
does not convince, the check is made anew in extended precision, and the map is corrected (iterative refinement).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class VerificationSettings:
    """How sure the map must be; errors of v are in its units, for theta in its units.

    Attributes:
        rounding: of a product of matrices, relative to the norms of its factors: a bound that is seldom reached.
        explained: a factorisation is off by so many roundings of a product.
        doubtful: the bound on rounding above which double precision does not do.
        convincing: error below which nothing is corrected.
        corrections: rounds of refinement in extended precision; each gains what double precision allows T.
    """

    rounding: float = 16 * 2.0**-53
    explained: float = 8.0
    doubtful: float = 1e-6
    convincing: float = 1e-10
    corrections: int = 5


SETTINGS = VerificationSettings()


@dataclass(frozen=True)
class Term:
    """A term of the cost, 1/2 (S a - target)'W (S a - target).

    Attributes:
        W: a matrix or a number.
        S: rows, `(k, r)`.
        start: where in theta the target begins; None for zero.
        of_v: where S is a part of C, which part.
    """

    W: Array
    S: Array
    start: int | None
    of_v: slice | None = None

    def missed(self, A: Array, v: Array) -> Array:
        """Return S a - target for each column of A, `(k, m)`, given v = C A."""
        missed = self.S @ A if self.of_v is None else v[self.of_v].copy()
        if self.start is not None:
            rows = np.arange(len(missed))
            missed[rows, self.start + rows] -= 1
        return missed

    def force(self, missed: Array) -> Array:
        """Return S'W missed, `(r, m)`."""
        weighted: Array = self.S.T @ self.W if self.W.ndim else self.S.T * self.W
        return weighted @ missed


@dataclass(frozen=True)
class Posed:
    """One problem as posed.

    Attributes:
        terms: the cost.
        C: rows of v, `(N, r)`.
        Eq, places: the equality rows, `(n_eq, r)`, and which entries of theta they equal.
        reach: basis of the range of Eq in its units where that is not everything, `(n_eq, rank)`.
        Z: basis of the kernel of Eq, `(r, n_x)`.
        scale, theta_scale: units of v and theta.
    """

    terms: tuple[Term, ...]
    C: Array
    Eq: Array
    places: Array
    reach: Array | None
    Z: Array
    scale: Array
    theta_scale: Array

    def to(self, dtype: Any) -> Posed:
        """Return the same numbers in another precision."""
        terms = tuple(replace(term, W=term.W.astype(dtype), S=term.S.astype(dtype)) for term in self.terms)
        return replace(self, terms=terms, C=self.C.astype(dtype), Eq=self.Eq.astype(dtype), Z=self.Z.astype(dtype))

    def slope(self, A: Array, v: Array) -> tuple[Array, Array]:
        """Return the slope of the cost on the kernel of Eq for each column of A, `(n_x, m)`, and its terms' size.

        Args:
            A: columns, `(r, m)`.
            v: C A, `(N, m)`.
        """
        total, n_theta = np.zeros_like(A), len(self.theta_scale)
        total[:, n_theta:] = self.C.T
        size = np.zeros(A.shape[1])
        size[n_theta:] = _norms(self.C.T)
        for term in self.terms:
            force = term.force(term.missed(A, v))
            size += _norms(force)
            total += force
        return self.Z.T @ total, size

    def missed(self, A: Array) -> Array:
        """Return Eq a - e, in its units, for each column of A, `(n_eq, m)`; what no a can reach is left out."""
        missed = self.Eq @ A
        missed[np.arange(len(self.places)), self.places] -= 1
        missed = missed / self.theta_scale[self.places, None]
        return missed if self.reach is None else self.reach @ (self.reach.T @ missed)


@dataclass(frozen=True)
class Map:
    """The reduced map of one problem: v = values (theta, lam), a = A (theta, lam).

    Attributes:
        values: [V, -G], `(N, m)`.
        A: [A_theta, -A_lam], `(r, m)`; in extended precision while it is corrected.
        T, Ct: the triangle of the cost, and C Z T^-1.
        kernel: orthonormal basis of the kernel of the cost in x, `(n_x, n_k)`.
        Eq_pinv: the pseudo-inverse of Eq.
    """

    values: Array
    A: Array
    T: Array
    Ct: Array
    kernel: Array
    Eq_pinv: Array

    def moved_x(self, slope: Array) -> Array:
        """Return (T'T)^-1 slope, by how much x is off for a slope of the cost.

        What falls on the kernel of the cost moves no cost, and is left out.
        """
        return self._off_kernel(_solve(self.T, self._weighted(slope)))

    def moved_v(self, slope: Array) -> Array:
        """Return C Z (T'T)^-1 slope, by how much v is off, likewise."""
        return self.Ct @ (self.T @ self.moved_x(slope) if self.kernel.size else self._weighted(slope))

    def moved_by_rounding(self) -> tuple[Array, Array]:
        """Return the norms of the rows of C Z (T'T)^-1 and of C Z T^-1, off the kernel, `(N,)` each."""
        back = self._weighted(self.T.T @ self.Ct.T) if self.kernel.size else self.Ct.T
        return _norms(self._off_kernel(_solve(self.T, back))), _norms(back)

    def _weighted(self, slope: Array) -> Array:
        return _solve(self.T, self._off_kernel(slope), is_transposed=True)

    def _off_kernel(self, x: Array) -> Array:
        return x - self.kernel @ (self.kernel.T @ x) if self.kernel.size else x


@dataclass(frozen=True)
class Verdict:
    """What the check found.

    Attributes:
        error: error of v in its units, then of the equalities in theirs: per unit of theta, and per unit of
            displacement by the multipliers, `(N + n_eq, 2)`. What rounding of the data explains is none.
        doubt: the largest bound on rounding, in the same units.
        excess: values minus the exact map, `(N, m)`; None where double precision did.
        rounding: of each entry of values, relative to it, if that is all of the error of v; else 0.
    """

    error: Array
    doubt: float
    excess: Array | None
    rounding: float = 0.0


def verify(posed: Posed, found: Map, settings: VerificationSettings = SETTINGS) -> tuple[Map, Verdict]:
    """Return the map, corrected if need be, and what is known of its errors."""
    verdict = _check(posed, found, settings)
    if verdict.doubt <= settings.doubtful and verdict.error.max(initial=0.0) <= settings.convincing:
        return found, verdict
    extended = posed.to(np.longdouble)
    best, verdict = found, _check_extended(posed, extended, found, settings)
    for _ in range(settings.corrections):
        if verdict.error.max(initial=0.0) <= settings.convincing:
            break
        candidate = _corrected(extended, best)
        judged = _check_extended(posed, extended, candidate, settings)
        if not judged.error.max() < verdict.error.max():
            break
        best, verdict = candidate, judged
    return replace(best, A=best.A.astype(float)), verdict


def _check(posed: Posed, found: Map, settings: VerificationSettings) -> Verdict:
    """Check in double precision. An error that a rounding of the data explains is none."""
    v = posed.C @ found.A
    slope, size = posed.slope(found.A, v)
    excess = np.subtract(found.values, v, out=v)  # arrays of this size are worth reusing
    excess += found.moved_v(slope)
    np.abs(excess, out=excess)
    own, missed = np.abs(found.values), np.abs(posed.missed(found.A))
    of_v, of_eq = _rounding(posed, found, size, own)
    of_v *= settings.rounding
    of_eq *= settings.rounding
    doubt = float(_in_units(posed, found, of_v, of_eq).max(initial=0.0))
    of_v *= settings.explained
    excess *= excess > of_v
    rounding = 0.0 if excess.any() else settings.rounding
    own *= settings.rounding
    excess += own
    missed *= missed > settings.explained * of_eq
    return Verdict(_in_units(posed, found, excess, missed), doubt, None, rounding)


def _rounding(posed: Posed, found: Map, size: Array, own: Array) -> tuple[Array, Array]:
    """Return what a rounding of every product may do to v, `(N, m)`, and to the equalities, `(n_eq, m)`.

    Args:
        posed, found: the problem and its map.
        size: of the terms of the slope, `(m,)`.
        own: |values|, `(N, m)`.
    """
    length, reached = _norms(found.A), _norms(posed.C.T)
    by_slope, back = found.moved_by_rounding()
    for term in posed.terms:  # a term that is off by its rounding moves v as its target does, which the map says
        if term.start is not None:
            reached = reached + own[:, term.start : term.start + len(term.S)] @ _norms(term.S.T)
        else:
            weight = np.einsum("ij,ij->", term.S, term.W @ term.S if term.W.ndim else term.W * term.S)
            reached = reached + back * np.sqrt(weight)
    of_v = np.stack([reached, by_slope], axis=1) @ np.stack([length, size])
    of_v += own
    of_eq = _norms(posed.Eq.T) / posed.theta_scale[posed.places]
    return of_v, (of_eq[:, None] + 1) * (length + 1)


def _check_extended(posed: Posed, extended: Posed, found: Map, settings: VerificationSettings) -> Verdict:
    """Check in extended precision."""
    A = found.A.astype(np.longdouble)
    v = extended.C @ A
    slope, _ = extended.slope(A, v)
    excess = found.values - v + found.moved_v(slope.astype(float))
    rounding = settings.rounding * np.abs(found.values)  # of values (theta, lam), in every sample
    missed = np.abs(extended.missed(A)).astype(float)
    error = _in_units(posed, found, np.abs(excess).astype(float) + rounding, missed)
    return Verdict(error, 0.0, excess.astype(float))


def _corrected(extended: Posed, found: Map) -> Map:
    """Return the map after one round of refinement."""
    A = found.A.astype(np.longdouble)
    missed = extended.missed(A).astype(float) * extended.theta_scale[extended.places, None]
    A = A - found.Eq_pinv @ missed
    slope, _ = extended.slope(A, extended.C @ A)
    A = A - extended.Z @ found.moved_x(slope.astype(float))
    return replace(found, A=A, values=(extended.C @ A).astype(float))


def _in_units(posed: Posed, found: Map, of_v: Array, of_eq: Array) -> Array:
    """Return errors `(N, m)` and `(n_eq, m)` per unit of theta, and per unit of displacement, `(N + n_eq, 2)`."""
    n_theta = len(posed.theta_scale)
    moved = -np.diagonal(found.values[:, n_theta:]) / posed.scale  # the displacement by a unit of each multiplier
    per_moved = np.divide(1.0, moved, out=np.zeros_like(moved), where=moved > 0)

    def in_units(error: Array) -> Array:
        by_lam = (error[:, n_theta:] * per_moved).max(axis=1, initial=0.0)
        return np.stack([error[:, :n_theta] @ posed.theta_scale, by_lam], axis=1)

    return np.concatenate([in_units(of_v) / posed.scale[:, None], in_units(of_eq)])


def _norms(columns: Array) -> Array:
    """Return the norm of each column, in double precision."""
    columns = columns.astype(float, copy=False)
    norms: Array = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    return norms


def _solve(T: Array, rhs: Array, *, is_transposed: bool = False) -> Array:
    """Return T^-1 rhs, or T'^-1 rhs, T an upper triangle."""
    if not rhs.size:
        return rhs
    solved: Array = scipy.linalg.solve_triangular(T, rhs, trans=int(is_transposed), check_finite=False)
    return solved
