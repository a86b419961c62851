"""Dense factorisations in extended precision, which LAPACK does not have: NumPy's long double, column by column."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def triangle(matrix: Array, rhs: Array) -> tuple[Array, Array, Array]:
    """Return R `(n, n)`, Q' rhs `(m, k)` and the order of the columns of a pivoted QR of `matrix`, `(m, n)`.

    Householder's reflections with rows sorted by size and columns pivoted are backward stable row by row (Cox and
    Higham, BIT 38, 1998), so light rows keep their accuracy beside heavy ones. Missing rows count as zero.
    """
    m, n = matrix.shape
    sort = np.argsort(-np.abs(matrix).max(axis=1, initial=0.0), kind="stable")
    work = np.concatenate([matrix[sort], rhs[sort]], axis=1).astype(np.longdouble)
    order, k_most = np.arange(n), min(m, n)
    for k in range(k_most):
        norms = np.square(work[k:, k:n]).sum(axis=0)
        j = k + int(norms.argmax())
        if norms[j - k] == 0:
            break
        work[:, [k, j]], order[[k, j]] = work[:, [j, k]], order[[j, k]]
        w = work[k:, k].copy()
        w[0] += np.copysign(np.sqrt(norms[j - k]), w[0])
        w /= np.sqrt(np.square(w).sum())
        work[k:, k:] -= np.outer(2 * w, w @ work[k:, k:])
        work[k + 1 :, k] = 0
    R = np.zeros((n, n), dtype=np.longdouble)
    R[:k_most] = np.triu(work[:k_most, :n])
    return R, work[:, n:], order


def back(R: Array, rhs: Array) -> Array:
    """Return R^-1 rhs for an upper triangle."""
    x = np.array(rhs, dtype=np.longdouble)
    for i in range(len(R) - 1, -1, -1):
        x[i] = (x[i] - R[i, i + 1 :] @ x[i + 1 :]) / R[i, i]
    return x


def forward(R: Array, rhs: Array) -> Array:
    """Return R'^-1 rhs for an upper triangle."""
    x = np.array(rhs, dtype=np.longdouble)
    for i in range(len(R)):
        x[i] = (x[i] - R[:i, i] @ x[:i]) / R[i, i]
    return x


def cholesky(matrix: Array) -> Array:
    """Return R with R'R = matrix, upper triangular; a pivot that rounding makes negative becomes infinite.

    A direction with such a pivot is left where it is by the solves with R.
    """
    S = np.array(matrix, dtype=np.longdouble)
    floor = np.finfo(np.longdouble).eps * S.diagonal()
    R = np.zeros_like(S)
    for i in range(len(S)):
        if not S[i, i] > floor[i]:
            R[i, i] = np.inf
            continue
        R[i, i:] = S[i, i:] / np.sqrt(S[i, i])
        S[i + 1 :, i + 1 :] -= np.outer(R[i, i + 1 :], R[i, i + 1 :])
    return R


def kernel_of(rows: Array, cutoff: float) -> tuple[Array, Array]:
    """Return the pseudo-inverse `(n, m)` and an orthonormal basis of the kernel `(n, n - rank)` of rows `(m, n)`.

    Args:
        rows: near unit length.
        cutoff: rows whose part outside the span of others is below this follow from them.
    """
    m, n = rows.shape
    R, Q_t, order = triangle(rows.T, np.eye(n, dtype=np.longdouble))
    # triangle() sorts the rows of its argument: Q_t is Q' for the rows as they were given.
    size = np.abs(R.diagonal())[: min(m, n)]
    rank = int((size > cutoff * size.max(initial=0.0)).sum()) if size.size and size.max() > 0 else 0
    pinv = np.zeros((n, m), dtype=np.longdouble)
    if rank:
        L = R[:rank].T  # rows[order] = L Q', the rows that follow share in it by least squares
        T, side, inner = triangle(L, np.eye(m, dtype=np.longdouble))
        solved = np.zeros((rank, m), dtype=np.longdouble)
        solved[inner] = back(T, side[:rank])
        pinv[:, order] = Q_t[:rank].T @ solved
    return pinv, Q_t[rank:].T
