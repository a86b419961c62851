"""One problem in extended precision, solved for its unconstrained minimiser from the rows as posed.

With Eq a = e eliminated and a QR of the weighted rows in long double, the problem of one sample reads

    minimise 1/2 |xi - xi0|^2 + rest   over x = (xi, eta),      a = a0 + A x,   v = c + M x in the sets,

eta the directions in which the cost is flat; their columns of A are orthonormal, and those of xi orthogonal to them, so
that |a|^2 is least where |eta|^2 is. Nothing of the factors in double precision is used but the number of flat
directions. v is in units of its channels, as everything that is judged is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .factorization import ROUNDING
from .long_double import Array, back, kernel_of, triangle
from .reduction import Reduction, _map_tensors, _one_of
from .verification import Posed

#: Equality rows, in their units, whose part outside the span of the others is below this follow from them.
DEPENDENT = 1e-10
#: A row of v that the flat directions move by at most this fraction of how far it moves at all is not moved by them.
STILL = 1e-11


@dataclass(frozen=True, eq=False)
class Sample:
    """The numbers of one theta, in long double.

    Attributes:
        a0: `(r,)`, and
        c: `(N,)`, the plan at x = 0.
        xi0: `(n_xi,)`.
        theta: as given.
    """

    a0: Array
    c: Array
    xi0: Array
    theta: Array


@dataclass(frozen=True, eq=False)
class Extended:
    """The problem of all samples of one reduction.

    Attributes:
        posed: the problem as posed, in long double.
        A: `(r, n_x)`, the columns of xi before those of eta.
        M: rows of v, in units, `(N, n_x)`; zero where the equalities decide a row.
        a_theta, xi_theta: a0 and xi0 are these times theta.
        n_xi: how many columns are those of xi.
        unit: of the rows of v, `(N,)`.
    """

    posed: Posed
    A: Array
    M: Array
    a_theta: Array
    xi_theta: Array
    n_xi: int
    unit: Array

    @staticmethod
    def of_reduction(reduction: Reduction, i: int, unit: Array) -> Extended:
        """Factor problem i of a reduction of a flattened batch, or its only problem."""
        alone = reduction.G.ndim == 2
        flat = _map_tensors(reduction, lambda x: x[None]) if alone else reduction
        i = 0 if alone else i
        return Extended.of(_one_of(flat, i, not alone), int((flat.kernel_in_a[i] != 0).any(0).sum()), unit)

    @staticmethod
    def of(posed: Posed, n_flat: int, unit: Array) -> Extended:
        """Factor a problem whose cost has a kernel of n_flat dimensions, in the units of the rows of v."""
        exact = posed.to(np.longdouble)
        n_theta, r = len(posed.theta_scale), posed.C.shape[1]
        a_theta, Z = _eliminated(exact, n_theta, r)
        E, f = _weighted_rows(exact, Z, a_theta)
        T, side, order = triangle(E, f)
        k, eye = Z.shape[1] - n_flat, np.eye(Z.shape[1], dtype=np.longdouble)[:, order]
        X_xi = eye[:, :k] @ back(T[:k, :k], np.eye(k, dtype=np.longdouble))
        X_eta = eye[:, k:] - X_xi @ T[:k, k:]
        if n_flat:
            R, _, swapped = triangle(X_eta, np.zeros((len(eye), 0)))
            X_eta = X_eta[:, swapped] @ back(R, np.eye(n_flat, dtype=np.longdouble))
            X_eta = X_eta @ (1.5 * np.eye(n_flat) - 0.5 * X_eta.T @ X_eta)
            X_xi = X_xi - X_eta @ (X_eta.T @ X_xi)
        CZ = _moving(exact.C, Z)
        M = CZ @ np.concatenate([X_xi, X_eta], axis=1)
        length = [np.sqrt(np.square(rows).sum(axis=1)) for rows in (M[:, k:], CZ)]
        M[length[0] <= STILL * length[1], k:] = 0
        A = Z @ np.concatenate([X_xi, X_eta], axis=1)
        return Extended(exact, A, M / unit[:, None], a_theta, side[:k], k, unit.astype(np.longdouble))

    def sample(self, theta: Array) -> Sample:
        """Return the numbers of one theta, `(n_theta,)`."""
        theta = theta.astype(np.longdouble)
        a0 = self.a_theta @ theta
        return Sample(a0, self.posed.C @ a0 / self.unit, self.xi_theta @ theta, theta)

    def cost(self, a: Array, theta: Array) -> tuple[np.floating[Any], Array]:
        """Return the terms of the cost as posed and their slope in x."""
        total: np.floating[Any] = np.longdouble(0)
        slope = np.zeros_like(a)
        for term in self.posed.terms:
            missed = term.S @ a
            if term.start is not None:
                missed = missed - theta[term.start : term.start + len(missed)]
            force = term.W @ missed if term.W.ndim else term.W * missed
            total, slope = total + missed @ force / 2, slope + term.S.T @ force
        return total, self.A.T @ slope


def _eliminated(posed: Posed, n_theta: int, r: int) -> tuple[Array, Array]:
    """Return the matrix of a0 and a basis of the kernel of Eq."""
    a_theta = np.zeros((r, n_theta), dtype=np.longdouble)
    if not len(posed.Eq):
        return a_theta, np.eye(r, dtype=np.longdouble)
    own = posed.theta_scale[posed.places].astype(np.longdouble)
    rows = posed.Eq / own[:, None]
    length = np.sqrt(np.square(rows).sum(axis=1))
    length[length == 0] = 1
    pinv, Z = kernel_of(rows / length[:, None], DEPENDENT)
    a_theta[:, posed.places] = pinv / (length * own)
    return a_theta, Z


def _weighted_rows(posed: Posed, Z: Array, a_theta: Array) -> tuple[Array, Array]:
    """Return E and the matrix of f, the cost being 1/2 |E z - f|^2 for a = a0 + Z z."""
    E, f = [], []
    for term in posed.terms:
        root = _root(term.W, len(term.S))
        target = -term.S @ a_theta
        if term.start is not None:
            target[:, term.start : term.start + len(target)] += np.eye(len(target))
        E.append(root @ _moving(term.S, Z))
        f.append(root @ target)
    return np.concatenate(E), np.concatenate(f)


def _moving(rows: Array, Z: Array) -> Array:
    """Return rows Z for orthonormal Z, zero where only rounding of the data is left of a row."""
    product = rows @ Z
    size, whole = (np.sqrt(np.square(x).sum(axis=1)) for x in (product, rows))
    product[size <= ROUNDING * whole] = 0
    return product


def _root(W: Array, n: int) -> Array:
    """Return S with S'S = W, exact for weights of each row's own; eigenvalues at rounding level are zero."""
    if not W.ndim:
        return np.sqrt(W) * np.eye(n, dtype=np.longdouble)
    diagonal = W.diagonal()
    if not (W - np.diag(diagonal)).any():
        return np.diag(np.sqrt(diagonal))
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    values, vectors = np.linalg.eigh((W / np.outer(size, size)).astype(float))
    keep = values > 1e-15 * n * values[-1]
    return np.sqrt(values[keep].astype(np.longdouble))[:, None] * vectors.T[keep] * size
