"""What the regulariser charges: blocks of g, in the coordinates a of g = B a.

With Z = [Up; Yp] and W = [Z; Uf], the row space of the data is a sum of three orthogonal parts, the blocks of its LQ
factor: what the past explains, what the future input adds, and what the future output alone has,

    a = (gamma_1, gamma_2, gamma_3),     |M g| = |gamma_3|,  M = I - W^+ W.

    "projection"   lambda_g |gamma_3|^2, the paper's
    "identity"     lambda_g |g|^2
    "spc"          gamma_3 = 0: the coordinates end with those of W
    "gamma"        beta_2 |gamma_2|^2 + lambda_g |gamma_3|^2

The blocks move with the data. To first order, and so far only, their derivatives are those of the orthogonal projectors
onto row spaces: d(W^+ W) = W^+ dW M + M dW' W^+'.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..autodiff import carries_derivative
from .terms import REGULARIZERS


def charged_by(regularizer: str, rank: int, rank_W: int, device: torch.device) -> Tensor:
    """Return which entries of a lambda_g charges, ones and zeros, `(rank,)`, or `(rank_W,)` for "spc"."""
    assert regularizer in REGULARIZERS
    if regularizer == "spc":
        return torch.zeros(rank_W, dtype=torch.float64, device=device)
    first = 0 if regularizer == "identity" else rank_W
    return (torch.arange(rank, device=device) >= first).double()


def in_row_space_of_W(rows: Tensor, W: Tensor, rank_W: int, tolerance: float) -> Tensor:
    """Return the rows of the data in the coordinates of the row space of W alone, `(k, rank_W)`: gamma_3 = 0.

    Args:
        rows: in the coordinates of the row space of the data, `(k, r)`, those of W first.
        W: its rows, in units.
        rank_W: the rank of W.
        tolerance: singular values at or below this fraction of the largest count as zero.
    """
    kept = rows[:, :rank_W]
    if not carries_derivative((rows,)):
        return kept
    W_pinv, change = _pinv(W, tolerance), W - W.detach()
    # The basis of the row space of W turns by M dW' W^+', which is zero at the point itself.
    return kept + rows[:, rank_W:] @ (change[:, rank_W:].mT @ W_pinv[:rank_W].mT)


def second_block(W: Tensor, n_past: int, rank_W: int, cutoff: Tensor, tolerance: float) -> Tensor:
    """Return N with |N a| = |gamma_2|, `(rows of Uf, r)`; rows beyond the rank of the block are zero.

    Args:
        W: its rows in the coordinates of the row space of the data, in units, `(k, r)`.
        n_past: how many of them are those of Z.
        rank_W: the rank of W.
        cutoff: singular values of Z at or below it count as zero.
        tolerance: of the pseudo-inverse of W, relative to its largest singular value.
    """
    Z = W[:n_past]
    with torch.no_grad():
        _, singular, right_h = torch.linalg.svd(Z.detach()[:, :rank_W], full_matrices=True)
        beyond = right_h[int((singular > cutoff).sum()) :]
        N = torch.nn.functional.pad(beyond, (0, W.shape[1] - rank_W, 0, len(W) - n_past - len(beyond)))
    if not carries_derivative((W,)):
        return N
    # N P with P = W^+ W - Z^+ Z the projector onto the block: N dP = N W^+ dW M - N dZ' Z^+'.
    change = W - W.detach()
    of_W = torch.nn.functional.pad((N @ _pinv(W, tolerance) @ change)[:, rank_W:], (rank_W, 0))
    largest = torch.linalg.matrix_norm(Z.detach(), ord=2).clamp_min(torch.finfo(N.dtype).tiny)
    return N + of_W - N @ change[:n_past].mT @ _pinv(Z, float(cutoff / largest)).mT


def _pinv(matrix: Tensor, tolerance: float) -> Tensor:
    with torch.no_grad():
        inverse: Tensor = torch.linalg.pinv(matrix.detach(), rtol=tolerance)
        return inverse
