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
    """A term of the cost, 1/2 (S a - target)'W (S a - target): W a matrix or a number; where in theta target begins."""

    W: Array
    S: Array
    start: int | None


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
        terms = tuple(Term(t.W.astype(dtype), t.S.astype(dtype), t.start) for t in self.terms)
        return replace(self, terms=terms, C=self.C.astype(dtype), Eq=self.Eq.astype(dtype), Z=self.Z.astype(dtype))

    def slope(self, A: Array) -> tuple[Array, Array]:
        """Return the slope of the cost on the kernel of Eq for each column of A, `(n_x, m)`, and its terms' size."""
        forces, n_theta = [], len(self.theta_scale)
        for term in self.terms:
            missed = term.S @ A
            if term.start is not None:
                missed[:, term.start : term.start + len(missed)] -= np.eye(len(missed), dtype=A.dtype)
            forces.append(term.S.T @ (term.W @ missed if term.W.ndim else term.W * missed))
        forces.append(np.concatenate([np.zeros((len(A), n_theta), A.dtype), self.C.T], axis=1))
        return self.Z.T @ sum(forces), sum(np.linalg.norm(force.astype(float), axis=0) for force in forces)

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
        T, CZ: the triangle of the cost, and C Z.
        kernel: orthonormal basis of the kernel of the cost in x, `(n_x, n_k)`.
        Eq_pinv: the pseudo-inverse of Eq.
    """

    values: Array
    A: Array
    T: Array
    CZ: Array
    kernel: Array
    Eq_pinv: Array


@dataclass(frozen=True)
class Verdict:
    """What the check found.

    Attributes:
        error: error of v in its units, then of the equalities in theirs: per unit of theta, and per unit of
            displacement by the multipliers, `(N + n_eq, 2)`. What rounding of the data explains is none.
        doubt: the largest bound on rounding, in the same units.
        excess: values minus the exact map, `(N, m)`; None where double precision did.
    """

    error: Array
    doubt: float
    excess: Array | None


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
    slope, size = posed.slope(found.A)
    excess = np.abs(found.values - posed.C @ found.A + found.CZ @ _moved(found, slope))
    own, missed = settings.rounding * np.abs(found.values), np.abs(posed.missed(found.A))
    of_v, of_eq = (settings.rounding * bound for bound in _rounding(posed, found, size))
    unexplained = excess > settings.explained * of_v, missed > settings.explained * of_eq
    error = np.where(unexplained[0], excess, 0.0) + own, np.where(unexplained[1], missed, 0.0)
    return Verdict(_in_units(posed, found, *error), float(_in_units(posed, found, of_v, of_eq).max(initial=0.0)), None)


def _rounding(posed: Posed, found: Map, size: Array) -> tuple[Array, Array]:
    """Return what a rounding of every product may do to v, `(N, m)`, and to the equalities, `(n_eq, m)`.

    Args:
        posed, found: the problem and its map.
        size: of the terms of the slope, `(m,)`.
    """
    norm = np.linalg.norm
    back = found.CZ.T
    if back.size:
        back = scipy.linalg.solve_triangular(found.T, _off_kernel(found, back), trans="T")
    length, own = norm(found.A, axis=0), np.abs(found.values)
    reached = norm(posed.C, axis=1)
    for term in posed.terms:  # a term that is off by its rounding moves v as its target does, which the map says
        rows = norm(term.S, axis=1)
        if term.start is not None:
            reached = reached + own[:, term.start : term.start + len(rows)] @ rows
        else:
            weight = np.einsum("ij,ij->", term.S, term.W @ term.S if term.W.ndim else term.W * term.S)
            reached = reached + norm(back, axis=0) * np.sqrt(weight)
    moved = norm(_off_kernel(found, scipy.linalg.solve_triangular(found.T, back)), axis=0)
    of_eq = norm(posed.Eq, axis=1) / posed.theta_scale[posed.places]
    return reached[:, None] * length + moved[:, None] * size + own, (of_eq[:, None] + 1) * (length + 1)


def _check_extended(posed: Posed, extended: Posed, found: Map, settings: VerificationSettings) -> Verdict:
    """Check in extended precision."""
    A = found.A.astype(np.longdouble)
    slope, _ = extended.slope(A)
    excess = found.values - extended.C @ A + found.CZ @ _moved(found, slope.astype(float))
    rounding = settings.rounding * np.abs(found.values)  # of values (theta, lam), in every sample
    missed = np.abs(extended.missed(A)).astype(float)
    error = _in_units(posed, found, np.abs(excess).astype(float) + rounding, missed)
    return Verdict(error, 0.0, excess.astype(float))


def _corrected(extended: Posed, found: Map) -> Map:
    """Return the map after one round of refinement."""
    A = found.A.astype(np.longdouble)
    missed = extended.missed(A).astype(float) * extended.theta_scale[extended.places, None]
    A = A - found.Eq_pinv @ missed
    slope, _ = extended.slope(A)
    A = A - extended.Z @ _moved(found, slope.astype(float))
    return replace(found, A=A, values=(extended.C @ A).astype(float))


def _moved(found: Map, slope: Array) -> Array:
    """Return (T'T)^-1 slope, by how much x is off, without what falls on the kernel of the cost: that moves no cost."""
    if not slope.size:
        return slope
    weighted = scipy.linalg.solve_triangular(found.T, _off_kernel(found, slope), trans="T")
    return _off_kernel(found, scipy.linalg.solve_triangular(found.T, weighted))


def _off_kernel(found: Map, x: Array) -> Array:
    return x - found.kernel @ (found.kernel.T @ x)


def _in_units(posed: Posed, found: Map, of_v: Array, of_eq: Array) -> Array:
    """Return the errors per unit of theta, and per unit of displacement, of v and of the equalities."""
    n_theta = len(posed.theta_scale)
    moved = -np.diagonal(found.values[:, n_theta:]) / posed.scale  # the displacement by a unit of each multiplier
    per_moved = np.divide(1.0, moved, out=np.zeros_like(moved), where=moved > 0)
    error = np.concatenate([of_v / posed.scale[:, None], of_eq])
    by_theta = error[:, :n_theta] @ posed.theta_scale
    return np.stack([by_theta, (error[:, n_theta:] * per_moved).max(axis=1, initial=0.0)], axis=1)
