"""The problem on the row space of its data, channels scaled, in long double: an SVD, a null space, a QR.

In the end it is   minimise 1/2 |xi - xi0|^2 + rest   over (xi, eta),  v = C (xi, eta) + c  in the sets,
with eta the directions that cost nothing.
"""

from dataclasses import dataclass

import numpy as np

from .extended import LONG, Array, long, minimum_norm, orthonormal, qr, rank_of, solve_upper
from .problem import Problem, Sample, root

RANK = 1e-10  # singular values below this share of the largest are rounding of the recording
AMBIGUOUS = (1e-13, 1e-8)  # between these a rank is a matter of opinion
KERNEL = 1e-15  # pivots of E below this share of the largest are zero (it is long double throughout)
STILL = 1e-12  # an entry of v that a direction without cost moves by less than this share of its row stays
DEPENDENT = 1e-9  # rows of Up g = u_ini below this share follow from the others


@dataclass(frozen=True)
class Rows:
    """The rows of the data on an orthonormal basis of their row space, channels scaled; and what decided its rank."""

    Up: Array
    Uf: Array
    Yp: Array
    Yf: Array
    basis: Array  # (n_g, r), the first r1 columns span [Up; Yp; Uf]
    r1: int
    ambiguous: bool


def rows_of(p: Problem) -> Rows:
    parts = [long(m) / np.tile(s, len(m) // len(s))[:, None]
             for m, s in ((p.Up, p.scale_u), (p.Yp, p.scale_y), (p.Uf, p.scale_u), (p.Yf, p.scale_y))]  # fmt: skip
    W = np.concatenate(parts[:3])
    left, size, _ = np.linalg.svd(np.asarray(W, float), full_matrices=False)
    largest = size[0] if size.size and size[0] > 0 else 1.0
    kept = size > RANK * largest
    # Sums of rows in long double lie in their span; singular vectors are off by rounding over their singular value.
    B1 = qr(W.T @ (left[:, kept] / size[kept]))[0][:, : kept.sum()]
    rest = parts[3] - (parts[3] @ B1) @ B1.T
    rest = rest - (rest @ B1) @ B1.T
    largest = max(largest, np.linalg.norm(np.asarray(parts[3], float), 2))
    _, size2, vectors2 = np.linalg.svd(np.asarray(rest, float), full_matrices=False)
    B2 = vectors2[size2 > RANK * largest].T
    basis = orthonormal(np.concatenate([B1, B2 - B1 @ (B1.T @ B2)], axis=1))
    both = np.concatenate([size, size2]) / largest
    ambiguous = bool(((both > AMBIGUOUS[0]) & (both < AMBIGUOUS[1])).any())
    Up, Yp, Uf, Yf = (m @ basis for m in parts)
    r1 = B1.shape[1]
    for m in (Up, Yp, Uf):  # by the decision on the rank, not by rounding
        m[:, r1:] = 0
    return Rows(Up, Uf, Yp, Yf, basis, r1, ambiguous)


@dataclass(frozen=True)
class Reduced:
    """Cost 1/2 |xi - xi0|^2 + rest on x = (xi, eta); v / scale = C x + c; a = a0 + A x on the basis."""

    xi0: Array
    rest: LONG
    C: Array
    c: Array
    A: Array
    a0: Array
    contradiction: float  # what Up g = u_ini and the terminal rows leave, relative to each channel
    ambiguous: bool
    natural: Array  # v / scale on an orthonormal basis of what the equalities leave, for questions of feasibility

    @property
    def n_xi(self) -> int:
        return len(self.xi0)


def reduce(p: Problem, rows: Rows, s: Sample) -> Reduced:
    su, sy = p.scale_u, p.scale_y
    u_ini, y_ini = (long(s.u_ini) / su).ravel(), (long(s.y_ini) / sy).ravel()
    u_ref, y_ref = (long(s.u_ref) / su).ravel(), (long(s.y_ref) / sy).ravel()
    size_u, size_y = np.tile(su, p.horizon), np.tile(sy, p.horizon)

    equal, target = [], []
    if p.lambda_u is None:
        equal, target = [rows.Up], [u_ini]
    if p.terminal_steps:
        last = slice(-p.terminal_steps * p.n_y, None)
        equal, target = [*equal, rows.Yf[last]], [*target, y_ref[last]]
    r = rows.basis.shape[1]
    equalities = np.concatenate(equal) if equal else np.zeros((0, r), LONG)
    targets = np.concatenate(target) if target else np.zeros(0, LONG)
    a0, Z, left = np.zeros(r, LONG), np.eye(r, dtype=LONG), targets
    if equal:
        a0, Z, left = minimum_norm(equalities, targets, DEPENDENT)
    contradiction = float(np.abs(left).max() / max(1.0, np.abs(targets).max())) if left.size else 0.0

    change, first = _differences(p, s, su)
    blocks = [
        (root(p.R) * size_u, rows.Uf, u_ref),
        (root(p.Q) * size_y, rows.Yf, y_ref),
        (np.sqrt(2 * LONG(p.lambda_s)) * np.diag(np.tile(long(sy), p.t_ini)), rows.Yp, y_ini),
    ]
    regular = np.eye(r, dtype=LONG)
    if p.regularizer == "projection":
        regular = regular[rows.r1 :]
    size_g = np.sqrt(2 * LONG(p.lambda_g)) * np.eye(len(regular), dtype=LONG)
    blocks.append((size_g, regular, np.zeros(len(regular), LONG)))
    if p.lambda_u is not None:
        weight = np.sqrt(2 * LONG(p.lambda_u)) * np.diag(np.tile(long(su), p.t_ini))
        blocks.append((weight, rows.Up, u_ini))
    if p.R_du is not None:
        blocks.append((root(p.R_du) * size_u, change @ rows.Uf, first))
    E = np.concatenate([w @ m @ Z for w, m, _ in blocks])
    e = np.concatenate([w @ (t - m @ a0) for w, m, t in blocks])

    q, T, order = qr(E)
    k = rank_of(T, KERNEL)
    rotated = q.T @ e
    n = Z.shape[1]
    # x = order of (T1^-1 (xi - T2 eta), eta)
    X = np.zeros((n, n), LONG)
    X[order[:k], :k] = solve_upper(T[:k, :k], np.eye(k, dtype=LONG))
    X[order[:k], k:] = -solve_upper(T[:k, :k], T[:k, k:n])
    X[order[k:], k:] = np.eye(n - k, dtype=LONG)
    A = Z @ X
    C = np.concatenate([rows.Uf, rows.Yf, change @ rows.Uf])
    CA = C @ A
    # What a direction without cost moves by rounding alone it does not move: 1e17 times that would be a plan.
    still = np.abs(CA[:, k:]) <= STILL * np.sqrt((C**2).sum(1))[:, None] * np.sqrt((A[:, k:] ** 2).sum(0))
    CA[:, k:][still] = 0
    c = C @ a0 + np.concatenate([np.zeros(C.shape[0] - len(first), LONG), -first])
    rest = LONG(0.5) * (rotated[k:] ** 2).sum()
    return Reduced(rotated[:k], rest, CA, c, A, a0, contradiction, rows.ambiguous, C @ Z)


def _differences(p: Problem, s: Sample, su: Array) -> tuple[Array, Array]:
    """Return (Delta, first) with du / scale = Delta u / scale - first."""
    n = p.horizon * p.n_u
    change = np.eye(n, dtype=LONG) - np.eye(n, k=-p.n_u, dtype=LONG)
    first = np.zeros(n, LONG)
    first[: p.n_u] = long(s.u_ini)[-1] / su
    return change, first
