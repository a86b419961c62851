"""The cost as weighted rows, and the part of g that lambda_g charges.

1/2 |E x - f|^2,   block rows  sqrt(R) Uf,  sqrt(Q) Yf,  sqrt(2 lambda_g) M,  sqrt(2 lambda_s) Yp,  ...
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..autodiff import carries_derivative
from ..shapes import broadcast_shapes
from .factorization import ROUNDING
from .rows import DataRows
from .weights import Weights, psd_root


def least_squares(rows: DataRows, weights: Weights) -> tuple[Tensor, Tensor]:
    """Return E `(..., k, n_x)` and the matrix of f = (matrix) theta, `(..., k, n_theta)`."""
    # Each block row of the cost, with the matrix that makes its target of a part of theta, and where that part begins.
    root_g = (2 * weights.lambda_g).sqrt()[..., None, None]
    blocks: list[tuple[Tensor, Tensor | None, int | None]] = [(root_g * _charged(rows), None, None)]
    for term in rows.tracking:
        if (weight := getattr(weights, term.weight)) is not None:
            root = psd_root(weight, term.channels)
            blocks.append((root @ rows.C[..., term.rows, :], root, term.reference))
    for fit in rows.fits:
        root = (2 * getattr(weights, fit.weight)).sqrt()[..., None, None]
        target = None if fit.measured is None else root * _eye(fit.rows.shape[-2], fit.rows)
        blocks.append((root * fit.rows, target, fit.measured))
    batch = broadcast_shapes(*(block.shape[:-2] for block, _, _ in blocks))
    E, f = [], []
    for block, matrix, start in blocks:
        E.append(without_rounding(block @ rows.Z, block).expand(*batch, -1, -1))
        of_theta = block.new_zeros(*batch, block.shape[-2], rows.n_theta)
        if matrix is not None and start is not None:
            of_theta[..., start : start + matrix.shape[-1]] = matrix
        of_theta[..., rows.Eq_theta] -= block @ rows.Eq_pinv
        f.append(of_theta)
    return torch.cat(E, dim=-2), torch.cat(f, dim=-2)


def without_rounding(product: Tensor, rows: Tensor) -> Tensor:
    """Return the rows times a matrix of orthonormal columns, zero where only rounding is left.

    A row of the problem that the equalities decide is such a row: its rounding would stand for a motion that does not
    exist.
    """
    norm = torch.linalg.vector_norm
    return torch.where((norm(product, dim=-1) <= ROUNDING * norm(rows, dim=-1))[..., None], 0.0, product)


def moved_by(kernel: Tensor, CZ: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Return C Z and how the kernel of the cost `(..., n_x, n_k)` moves v, zero on the rows that it hardly moves.

    A row that the cost charges is one: its rounding, over the small charge of the kernel, would stand for a motion.
    """
    norm, moved = torch.linalg.vector_norm, CZ @ kernel
    hardly = (norm(moved, dim=-1) <= tolerance * norm(CZ, dim=-1))[..., None]
    return CZ - torch.where(hardly, moved, 0.0) @ kernel.mT, torch.where(hardly, 0.0, moved)


def _charged(rows: DataRows) -> Tensor:
    """M in the coordinates a, the identity on the entries beyond the rank of W; or all of the identity."""
    if rows.charged.ndim == 1:
        return torch.diag(rows.charged)[rows.charged.bool()]
    return torch.diag_embed(rows.charged)


def gram_of_charged(rows: DataRows) -> Tensor:
    """M = I - W^+ W in the coordinates a (or I), with its derivative at constant rank of W where W has a graph."""
    N = _charged(rows)
    M = N.mT @ N
    W = torch.cat([rows.Up, rows.Yp, rows.Uf], dim=-2)
    if not carries_derivative((W,)) or rows.is_identity:
        return M
    W = W / rows.theta_scale[..., : W.shape[-2], None]  # M is the same in any units
    with torch.no_grad():
        W_pinv = torch.linalg.pinv(W, rtol=rows.tolerance)
    # M dW = 0 at the point itself, so the term below is 0 in value and -(W^+ dW M + M dW' W^+') in derivative.
    change = W_pinv @ (W - W.detach()) @ M
    return M - change - change.mT


def _eye(n: int, like: Tensor) -> Tensor:
    return torch.eye(n, dtype=like.dtype, device=like.device)
