"""Small symmetric systems on the active rows, one set of rows a sample.

A sample with active rows A needs  lam_A = G[A, A]^-1 rhs_A,  lam = 0 elsewhere: Newton's step in the forward solve,
the adjoint in the backward one. The rows of a group of samples are packed to the longest list and the missing ones
read an identity, so that one batched Cholesky serves; samples whose active rows are (nearly) dependent go through a
QR of the rows of Ct, because G = Ct Ct' squares their condition.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg.lapack import dposv
from torch import Tensor

from .linear import times

#: A Cholesky factor of G[A, A] is trusted where every row of Ct stands out of the span of those before it by this
#: fraction of its length; G cannot tell less.
STANDING_OUT = 1e-5
#: Rows of Ct that stand out of the span of the others by less than this fraction of their length are dependent.
DEPENDENT_ROW = 1e-9
#: Samples of like size that share one padded factorisation on the CPU.
GROUP = 128
#: Up to this many samples NumPy, one after the other, beats the packing.
FEW = 4


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
    on_cpu = rhs.device.type == "cpu"
    lam, trusted = (_one_by_one if on_cpu and len(rhs) <= FEW else _packed)(G, active, rhs)
    for i in _where_not(trusted):
        chosen = active[i].nonzero()[:, 0]
        rows, R = _independent_rows(Ct if Ct.ndim == 2 else Ct[i], chosen)
        lam[i] = 0.0
        lam[i, rows] = torch.cholesky_solve(rhs[i, rows, None], R, upper=True)[:, 0]
        trusted[i] = len(rows) == len(chosen)
    return lam, trusted


def adjoint(G: Tensor, Ct: Tensor, active: Tensor, v_bar: Tensor, lam_bar: Tensor | None) -> Tensor:
    """Return v0_bar = v_bar + s, s_A = G_AA^-1 (lam_bar - G v_bar)_A; the arguments are those of `solve_active`."""
    if v_bar.device.type == "cpu" and len(v_bar) <= FEW and G.ndim == 2:
        out = v_bar.clone()
        few = _adjoint_few(G.numpy(), active.numpy(), out.numpy(), None if lam_bar is None else lam_bar.numpy())
        if few:
            return out
    rhs = -times(G, v_bar)
    return v_bar + solve_active(G, Ct, active, rhs if lam_bar is None else rhs + lam_bar)[0]


def adjoint_dense(G: Tensor, active: Tensor, v_bar: Tensor, lam_bar: Tensor | None) -> Tensor:
    """Return what `adjoint` does in plain operations on all rows, slower; the active rows must be independent."""
    held = active.to(G.dtype)
    matrix = held[..., :, None] * G * held[..., None, :] + torch.diag_embed(1 - held)
    rhs = -times(G, v_bar)
    rhs = held * (rhs if lam_bar is None else rhs + lam_bar)
    # Not `linalg.solve`: torch's batched LU is unsound on several threads (its issue 141358), Cholesky is not.
    return v_bar + torch.cholesky_solve(rhs[..., None], torch.linalg.cholesky(matrix))[..., 0]


def _adjoint_few(G: np.ndarray, active: np.ndarray, bar: np.ndarray, lam_bar: np.ndarray | None) -> bool:
    """Turn v_bar into v0_bar in place; False where a system cannot be trusted."""
    for i, v_bar in enumerate(bar):
        rows = active[i].nonzero()[0]
        rhs = -(G[rows] @ v_bar)
        s = solve_rows(G, rows, rhs if lam_bar is None else rhs + lam_bar[i, rows])
        if s is None:
            return False
        v_bar[rows] += s
    return True


def _where_not(flags: Tensor) -> list[int]:
    return [] if bool(flags.all()) else (~flags).nonzero()[:, 0].tolist()


def _one_by_one(G: Tensor, active: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    lam, trusted = torch.zeros_like(rhs), torch.ones(len(rhs), dtype=torch.bool)
    matrices, rows_of, right, out = G.numpy(), active.numpy(), rhs.numpy(), lam.numpy()
    for i in range(len(rhs)):
        rows = rows_of[i].nonzero()[0]
        solved = solve_rows(matrices if G.ndim == 2 else matrices[i], rows, right[i, rows])
        if solved is None:
            trusted[i] = False
        else:
            out[i, rows] = solved
    return lam, trusted


def solve_rows(G: np.ndarray, rows: np.ndarray, rhs: np.ndarray) -> np.ndarray | None:
    """Return G[rows, rows]^-1 rhs, or None where Cholesky says that G cannot be trusted with it."""
    if len(rows) == 0:
        return rhs
    # LAPACK itself: the wrappers of NumPy and torch cost several times a system of this size.
    block = G[rows[:, None], rows]
    factor, solution, failed = dposv(block, rhs)
    if failed or not (factor.diagonal() > STANDING_OUT * block.diagonal() ** 0.5).all():
        return None
    return solution


def _packed(G: Tensor, active: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    count = active.sum(dim=1)
    table = _identity_padded(G)
    if rhs.device.type != "cpu" or len(rhs) <= GROUP:
        samples = torch.arange(len(rhs), device=rhs.device) if G.ndim == 3 else None
        return _packed_group(table, active, rhs, count, samples)
    # Samples of like size together: padding all to the largest would cost several times the flops.
    lam, trusted = torch.zeros_like(rhs), torch.ones(len(rhs), dtype=torch.bool)
    for part in count.argsort().split(GROUP):
        lam[part], trusted[part] = _packed_group(table, active[part], rhs[part], count[part], part)
    return lam, trusted


def _packed_group(
    table: Tensor, active: Tensor, rhs: Tensor, count: Tensor, samples: Tensor | None
) -> tuple[Tensor, Tensor]:
    n = rhs.shape[1]
    index = _pack(active, count)
    block = _blocks(table, index, samples)
    L, info = torch.linalg.cholesky_ex(block)
    x = torch.cholesky_solve(rhs.gather(1, index.clamp_max(n - 1))[..., None], L)[..., 0]
    lam = x.new_zeros(len(rhs), 2 * n).scatter_(1, index, x)[:, :n]
    if L.shape[-1] == 0:
        return lam, info == 0
    # What of a row stands out of the span of those before it, as a fraction of its length: free of units.
    standing = L.diagonal(dim1=-2, dim2=-1) / block.diagonal(dim1=-2, dim2=-1).sqrt()
    return lam, (info == 0) & (standing.amin(-1) > STANDING_OUT)


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


def _blocks(table: Tensor, index: Tensor, samples: Tensor | None) -> Tensor:
    """Return G[A, A] of each sample, `(b, k, k)`."""
    width = table.shape[-1]
    flat = index[:, :, None] * width + index[:, None, :]
    if table.ndim == 3 and samples is not None:
        flat = flat + samples[:, None, None] * width * width
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
