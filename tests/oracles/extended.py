"""Dense linear algebra in long double (64-bit mantissa): LAPACK stops at double."""

import numpy as np

Array = np.ndarray
LONG = np.longdouble


def long(x) -> Array:
    return np.asarray(x, dtype=LONG)


def qr(a: Array) -> tuple[Array, Array, Array]:
    """Return Q (m, m), R (m, n) and the column order p with a[:, p] = Q R, by Householder reflections with pivoting."""
    r = np.array(a, dtype=LONG)
    m, n = r.shape
    p = np.arange(n)
    reflectors = []
    for k in range(min(m, n)):
        norms = (r[k:, k:] ** 2).sum(0)
        j = k + int(norms.argmax())
        if norms[j - k] == 0:
            break
        r[:, [k, j]], p[[k, j]] = r[:, [j, k]], p[[j, k]]
        w = r[k:, k].copy()
        w[0] += np.copysign(np.sqrt((w**2).sum()), w[0])
        w /= np.sqrt((w**2).sum())
        r[k:, k:] -= np.outer(2 * w, w @ r[k:, k:])
        r[k + 1 :, k] = 0
        reflectors.append(w)
    q = np.eye(m, dtype=LONG)
    for k in reversed(range(len(reflectors))):
        w = reflectors[k]
        q[k:, k:] -= np.outer(2 * w, w @ q[k:, k:])
    return q, r, p


def rank_of(r: Array, cutoff: float) -> int:
    """Return the rank that the diagonal of a pivoted triangle shows, relative to its largest entry."""
    size = np.abs(np.diagonal(r))
    return int((size > cutoff * size[0]).sum()) if size.size and size[0] > 0 else 0


def solve_upper(r: Array, b: Array) -> Array:
    """Return r^-1 b for an upper triangle."""
    x = np.array(b, dtype=LONG)
    for i in reversed(range(len(r))):
        x[i] = (x[i] - r[i, i + 1 :] @ x[i + 1 :]) / r[i, i]
    return x


def solve_upper_transposed(r: Array, b: Array) -> Array:
    """Return r^-T b for an upper triangle."""
    x = np.array(b, dtype=LONG)
    for i in range(len(r)):
        x[i] = (x[i] - r[:i, i] @ x[:i]) / r[i, i]
    return x


def orthonormal(b: Array) -> Array:
    """Return columns that span those of b, nearly orthonormal already, orthonormal to the last bit (Newton-Schulz)."""
    b = long(b)
    for _ in range(3):
        b = b @ (1.5 * np.eye(b.shape[1], dtype=LONG) - 0.5 * (b.T @ b))
    return b


def minimum_norm(a: Array, b: Array, cutoff: float) -> tuple[Array, Array, Array]:
    """Return the shortest least-squares solution of a x = b, the orthonormal kernel of a, and the residual b - a x."""
    m, n = a.shape
    q, r, p = qr(a.T)
    k = rank_of(r, cutoff)
    # a[p] = R' Q': the first k rows decide; the others follow from them, or contradict.
    z = solve_upper_transposed(r[:k, :k], b[p[:k]])
    if k < m:  # contradicting rows share the error
        z = _least_squares(r[:k].T, b[p])
    x = q[:, :k] @ z
    return x, q[:, k:], b - a @ x


def _least_squares(a: Array, b: Array) -> Array:
    """Return argmin |a x - b| for a of full column rank."""
    q, r, p = qr(a)
    n = a.shape[1]
    x = np.zeros(n, dtype=LONG)
    x[p] = solve_upper(r[:n, :n], q.T[:n] @ b)
    return x
