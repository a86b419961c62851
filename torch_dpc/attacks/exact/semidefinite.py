"""A primal-dual interior-point method for bounds by quadratic forms (the dual of a moment relaxation).

Let z = (1, s, lam) be what is possible, F an objective z'Fz, and (a_k'z)(b_k'z) and z'D_m z forms that are known to be
zero or not negative for every possible z. Then, for multipliers y of the right sign,

    M(y) = F - y_0 e_0 e_0' - sum_k y_k sym(a_k b_k') - sum_m y_m D_m positive semidefinite   gives   z'Fz >= y_0.

Forms of rank two make the Schur complement of the Newton step products of small matrices: with Y the moments and
Z = M^-1 it holds tr(Q_k Y Q_l Z), four elementwise products (the HKM direction: Helmberg, Rendl, Vanderbei, Wolkowicz
1996; predictor and corrector of Mehrotra 1992). Every iterate is feasible, so every iterate is a proof.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from .complementarity import Array


@dataclass(frozen=True)
class InteriorSettings:
    """Constants of the method."""

    iterations: int = 60  # of Newton; 12 to 30 are usual
    shorten: float = 0.95  # of the step to the boundary
    least_centring: float = 1e-3  # share of the barrier parameter that is kept at least
    residual: float = 1e-3  # of the moments, at which the gap counts
    regularization: float = 1e-13  # of the scaled Schur complement
    starts: int = 60  # times that y_0 is lowered until M(y) is positive definite
    lower: float = 1.4  # factor on each lowering
    enlarge: float = 1.1  # factor on the multipliers of the D_m, likewise


SETTINGS = InteriorSettings()


class Program(NamedTuple):
    """The forms of a bound, in coordinates in which e_0 is `a[0]`.

    Attributes:
        F: objective, `(N, N)`.
        a, b: forms of rank two, `(K, N)`; the first is e_0 e_0'.
        D: dense forms, `(m, N, N)`, not negative; together they bound s.
        inequality: which of the K forms are not negative; the others are zero.
    """

    F: Array
    a: Array
    b: Array
    D: Array
    inequality: NDArray[np.bool_]

    def values(self, Y: Array) -> Array:
        """Return <Q_k, Y> of every form."""
        return np.concatenate([((self.a @ Y) * self.b).sum(1), (self.D * Y).sum((1, 2))])

    def combine(self, y: Array) -> Array:
        """Return sum_k y_k Q_k."""
        K = len(self.a)
        X = (self.a * y[:K, None]).T @ self.b
        return (X + X.T) / 2 + np.tensordot(y[K:], self.D, 1)


class Proof(NamedTuple):
    """What the method ends with.

    Attributes:
        bound: y_0; z'Fz is at least this.
        y: multipliers.
        M: M(y), positive definite.
    """

    bound: float
    y: Array
    M: Array


def prove(
    program: Program, y: Array, *, enough: float = np.inf, tolerance: float = 1e-3, deadline: float = np.inf
) -> Proof | None:
    """Raise y_0 until it is `enough`, within `tolerance` of the optimum, or the deadline of `time.monotonic` passes.

    Args:
        program: the forms.
        y: multipliers to start from; y_0 is lowered until M(y) is positive definite. None is returned where that fails.
        enough: a bound that is as good as any.
        tolerance: gap between bound and optimum, absolute.
        deadline: no iteration is begun after it.
    """
    iterate = _Iterate.begin(program, y)
    if iterate is None:
        return None
    for _ in range(SETTINGS.iterations):
        if iterate.y[0] >= enough or iterate.is_converged(tolerance) or time.monotonic() > deadline:
            break
        if not iterate.step():
            break
    return Proof(float(iterate.y[0]), iterate.y, iterate.M)


class _Direction(NamedTuple):
    y: Array
    M: Array
    Y: Array
    slack: Array


class _Iterate:
    """Multipliers y with M = M(y) > 0, moments Y > 0 and their slacks, not yet feasible."""

    def __init__(self, program: Program, y: Array, M: Array, root: Array):
        self.program, self.y, self.M = program, y, M
        self._invert(root)
        self.signed = np.append(program.inequality, np.ones(len(program.D), bool))
        mu = 1 / float(program.a[0] @ self.Z @ program.a[0])  # the moment of 1 is 1
        self.Y, self.slack = mu * self.Z, np.where(self.signed, mu / np.where(self.signed, y, 1.0), 0.0)
        self.degree = len(M) + int(self.signed.sum())

    @staticmethod
    def begin(program: Program, y: Array) -> _Iterate | None:
        """Return a feasible start, or None."""
        y, K, down = y.copy(), len(program.a), 1.0
        for _ in range(SETTINGS.starts):
            M = program.F - program.combine(y)
            root = _cholesky(M)
            if root is not None:
                return _Iterate(program, y, M, root)
            down *= SETTINGS.lower
            y[0] -= down
            y[K:] *= SETTINGS.enlarge
        return None

    def _invert(self, root: Array) -> None:
        self.inverse_root = scipy.linalg.solve_triangular(root, np.eye(len(root)), lower=True, check_finite=False)
        self.Z = self.inverse_root.T @ self.inverse_root

    @property
    def mu(self) -> float:
        """The barrier parameter."""
        return float(((self.Y * self.M).sum() + self.slack[self.signed] @ self.y[self.signed]) / self.degree)

    def _residual(self) -> Array:
        wanted = np.zeros(len(self.y))
        wanted[0] = 1.0
        return wanted - (self.program.values(self.Y) - self.slack)

    def is_converged(self, tolerance: float) -> bool:
        """Return whether the optimum is known to be within the tolerance."""
        return self.mu * self.degree < tolerance and float(np.abs(self._residual()).max()) < SETTINGS.residual

    def step(self) -> bool:
        """Move by a predictor and a corrector; return whether there was a way."""
        solve, mu = self._schur(), self.mu
        moments_root = _cholesky(self.Y)
        if solve is None or moments_root is None:
            return False
        inverse = scipy.linalg.solve_triangular(moments_root, np.eye(len(self.Y)), lower=True, check_finite=False)
        ahead = self._direction(solve, 0.0, 0.0, 0.0)
        dual, primal = (min(1.0, length) for length in self._lengths(ahead, inverse))
        pairs = ((self.Y + primal * ahead.Y) * (self.M + dual * ahead.M)).sum()
        signed = (self.slack + primal * ahead.slack)[self.signed] @ (self.y + dual * ahead.y)[self.signed]
        share = float((pairs + signed) / self.degree / mu)
        centring = max(min(1.0, max(share, 0.0) ** 2), SETTINGS.least_centring) if min(dual, primal) > 0.1 else 1.0
        X = ahead.Y @ ahead.M @ self.Z
        way = self._direction(solve, centring * mu, (X + X.T) / 2, ahead.slack * ahead.y)
        dual, primal = (min(1.0, SETTINGS.shorten * length) for length in self._lengths(way, inverse))
        for _ in range(20):
            y = self.y + dual * way.y
            M = self.program.F - self.program.combine(y)
            root = _cholesky(M)
            if root is not None:
                break
            dual *= 0.7
        else:
            return False
        self.y, self.M = y, M
        self.Y, self.slack = self.Y + primal * way.Y, self.slack + primal * way.slack
        self._invert(root)
        return max(dual, primal) > 1e-6

    def _schur(self) -> Callable[[Array], Array] | None:
        """Return the solver of the Newton system, whose matrix holds tr(Q_k Y Q_l Z)."""
        a, b, D = self.program.a, self.program.b, self.program.D
        K, n = len(a), len(a) + len(D)
        aY, bY, aZ, bZ = a @ self.Y, b @ self.Y, a @ self.Z, b @ self.Z
        H = np.empty((n, n))
        X = (aY @ b.T).T * (aZ @ b.T)
        X += X.T
        X += (bY @ b.T) * (aZ @ a.T)
        X += (aY @ a.T) * (bZ @ b.T)
        H[:K, :K] = X / 4
        for m, form in enumerate(D):
            X = self.Y @ form @ self.Z
            H[K + m] = H[:, K + m] = self.program.values((X + X.T) / 2)
        diagonal = np.arange(n)
        H[diagonal, diagonal] += np.where(self.signed, self.slack / np.where(self.signed, self.y, 1.0), 0.0)
        scale = 1 / np.sqrt(np.maximum(H[diagonal, diagonal], np.finfo(float).tiny))
        H *= scale[:, None] * scale
        H[diagonal, diagonal] += SETTINGS.regularization
        try:
            factor = scipy.linalg.cho_factor(H, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        return lambda right: scale * scipy.linalg.cho_solve(factor, scale * right, check_finite=False)

    def _direction(
        self, solve: Callable[[Array], Array], mu: float, curved: Array | float, curved_slack: Array | float
    ) -> _Direction:
        """Return the step towards barrier parameter mu; `curved` are the second-order terms of the predictor."""
        positive = np.where(self.signed, self.y, 1.0)
        W = mu * self.Z - self.Y - curved
        w = np.where(self.signed, (mu - self.slack * self.y - curved_slack) / positive, 0.0)
        y = solve(self._residual() - self.program.values(W) + w)
        M = -self.program.combine(y)
        X = self.Y @ M @ self.Z
        return _Direction(y, M, W - (X + X.T) / 2, np.where(self.signed, w - self.slack * y / positive, 0.0))

    def _lengths(self, way: _Direction, moments_inverse: Array) -> tuple[float, float]:
        """Return how far multipliers and moments may go."""
        on = self.signed
        dual = min(_until_singular(self.inverse_root, way.M), _until_zero(self.y[on], way.y[on]))
        primal = min(_until_singular(moments_inverse, way.Y), _until_zero(self.slack[on], way.slack[on]))
        return dual, primal


def _cholesky(X: Array) -> Array | None:
    try:
        return scipy.linalg.cholesky(X, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None


def _until_singular(inverse_root: Array, change: Array) -> float:
    least = scipy.linalg.eigvalsh(inverse_root @ change @ inverse_root.T, check_finite=False, subset_by_index=[0, 0])[0]
    return 1 / max(-float(least), 1e-12)


def _until_zero(x: Array, change: Array) -> float:
    return 1 / max(float((-change / x).max(initial=0.0)), 1e-12)
