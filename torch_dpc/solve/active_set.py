"""Small symmetric systems on the active rows, one set of rows a sample.

For the active rows A of a sample solve  lam_A = G[A, A]^-1 rhs_A,  lam = 0 elsewhere. This is Newton's step in the
forward solve and the adjoint in the backward one. On the CPU the compiled kernels do it. Elsewhere the samples'
systems are padded with an identity to the size of the largest one, for one batched Cholesky factorisation. If the
active rows of a sample are (nearly) linearly dependent, a QR of the rows of Ct takes its place, because G = Ct Ct'
squares their condition.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..batching import times
from . import kernels
from .kernels import INDEPENDENCE_TOLERANCE

#: A row of Ct whose part outside the span of the rows before it is below this fraction of its length is dependent.
DEPENDENT_ROW = 1e-9


def solve_active(G: Tensor, Ct: Tensor, active: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Solve G[A, A] lam_A = rhs_A for every sample.

    Args:
        G, Ct: `(N, N)` and `(N, n_x)` with G = Ct Ct', or one a sample, `(B, N, N)` and `(B, N, n_x)`.
        active: the rows A of each sample, `(B, N)`, boolean.
        rhs: `(B, N)`; entries outside A are ignored.

    Returns:
        lam `(B, N)`, zero outside A, and whether the rows A were independent, `(B,)`. Where they were not, dependent
        rows are left out (lam = 0).
    """
    lam, trusted = (kernels.solve_active if kernels.has_kernels(rhs) else _packed)(G, active, rhs)
    for i in [] if bool(trusted.all()) else (~trusted).nonzero()[:, 0].tolist():
        chosen = active[i].nonzero()[:, 0]
        rows, R = _independent_rows(Ct if Ct.ndim == 2 else Ct[i], chosen)
        lam[i] = 0.0
        lam[i, rows] = torch.cholesky_solve(rhs[i, rows, None], R, upper=True)[:, 0]
        trusted[i] = len(rows) == len(chosen)
    return lam, trusted


def adjoint(G: Tensor, Ct: Tensor, active: Tensor, v_bar: Tensor, lam_bar: Tensor | None) -> Tensor:
    """Return v0_bar = v_bar + s, s_A = G_AA^-1 (lam_bar - G v_bar)_A; the arguments are those of `solve_active`."""
    if kernels.has_kernels(v_bar):
        v0_bar, trusted = kernels.adjoint(G, active, v_bar, lam_bar)
        if bool(trusted.all()):
            return v0_bar
    rhs = -times(G, v_bar)
    return v_bar + solve_active(G, Ct, active, rhs if lam_bar is None else rhs + lam_bar)[0]


def _packed(G: Tensor, active: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Solve all samples by one batched Cholesky, padded to the longest list."""
    n = rhs.shape[1]
    index = _pack(active, active.sum(dim=1))
    block = _blocks(_identity_padded(G), index)
    L, info = torch.linalg.cholesky_ex(block)
    x = torch.cholesky_solve(rhs.gather(1, index.clamp_max(n - 1))[..., None], L)[..., 0]
    lam = torch.zeros_like(rhs).masked_scatter(active, x[index < n])
    if L.shape[-1] == 0:
        return lam, info == 0
    # The part of each row outside the span of the rows before it, as a fraction of its length.
    independence = L.diagonal(dim1=-2, dim2=-1) / block.diagonal(dim1=-2, dim2=-1).sqrt()
    return lam, (info == 0) & (independence.amin(-1) > INDEPENDENCE_TOLERANCE)


def _identity_padded(G: Tensor) -> Tensor:
    """Return [[G, 0], [0, I]]: positions N, N + 1, ... are rows of an identity, for lists that are too short."""
    n = G.shape[-1]
    table = G.new_zeros(*G.shape[:-2], 2 * n, 2 * n)
    table[..., :n, :n] = G
    table.diagonal(dim1=-2, dim2=-1)[..., n:] = 1.0
    return table


def _pack(active: Tensor, count: Tensor) -> Tensor:
    """Return the positions of the active rows, `(b, k)`, filled up with N, N + 1, ..."""
    n = active.shape[1]
    k = int(count.max()) if len(count) else 0
    sample, row = active.nonzero(as_tuple=True)
    index = torch.arange(n, n + k, device=active.device).repeat(len(active), 1)
    place = torch.arange(len(row), device=active.device) - (count.cumsum(0) - count)[sample]
    index[sample, place] = row
    return index


def _blocks(table: Tensor, index: Tensor) -> Tensor:
    """Return G[A, A] of each sample, `(b, k, k)`."""
    width = table.shape[-1]
    flat = index[:, :, None] * width + index[:, None, :]
    if table.ndim == 3:
        flat = flat + width * width * torch.arange(len(index), device=index.device)[:, None, None]
    return table.reshape(-1).index_select(0, flat.reshape(-1)).reshape(flat.shape)


def _independent_rows(Ct: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return a linearly independent subset of the rows, and R upper triangular with R'R = G[rows, rows]."""
    while True:
        R = torch.linalg.qr(Ct[rows].T, mode="r").R
        pivots = torch.zeros(len(rows), dtype=R.dtype, device=R.device)
        pivots[: R.shape[0]] = R.diagonal().abs()
        keep = pivots > DEPENDENT_ROW * torch.linalg.vector_norm(Ct[rows], dim=1)
        if bool(keep.all()):
            return rows, R
        rows = rows[keep]
