"""The triangle of a least-squares cost whose rows differ by many orders of magnitude.

    min 1/2 |E x - f|^2

The rows of E carry the weights: lambda_s = 1e8 stands beside Q = 1e-2, and a channel recorded in micrometres beside
one in kilometres. Householder's QR with rows sorted by size and columns pivoted is backward stable row by row (Powell
and Reid 1969; Cox and Higham, BIT 38, 1998): a light row is as accurate relative to itself as a heavy one. For the same
reason the kernel of E is that of its rows at unit length, which does not depend on how heavy a positive weight is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

#: A row is zero where what is left of it is at most this fraction of what it was made of: n_x roundings, with a margin.
ROUNDING = 1e-13
#: Directions that the rows of E, at unit length, see by at most this fraction of the largest make the optimum a set.
KERNEL_TOLERANCE = 1e-12
#: Pivots of E that stay above this multiple of the tolerance show that E has no kernel, without a look at unit rows.
CLEAR_PIVOT = 1e4
#: Weight on a direction of the kernel, relative to the smallest pivot that is not of the kernel.
TIE_BREAK = 1e-4


@dataclass(frozen=True, eq=False)
class CostFactor:
    """E = Q T, columns of E permuted; leading dimensions, if any, are one problem each.

    Attributes:
        T: upper triangle, `(..., n_x, n_x)`; in the directions of the kernel it holds their charge.
        Q: orthonormal columns cut to the rows of E, `(..., k, n_x)`.
        order: the columns of E in the order of T, `(..., n_x)`.
        kernel: orthonormal basis of the kernel of E, in the order of T, `(..., n_x, n_k)`; padded with zero columns.
        charge: weight of the kernel in T, `(..., 1, 1)`.
    """

    T: Tensor
    Q: Tensor
    order: Tensor
    kernel: Tensor
    charge: Tensor


def factor_cost(E: Tensor) -> CostFactor:
    """Factor E `(..., k, n_x)`, and charge its kernel by so little that the charge breaks ties alone."""
    k, n = E.shape[-2:]
    Q, T, order = _row_stable_qr(E)
    K = _kernel_of(E, T)
    if K.shape[-1] == 0:
        return CostFactor(T, Q, order, K, E.new_ones(*E.shape[:-2], 1, 1))
    count = (K != 0).any(-2).sum(-1)
    pivots = T.diagonal(dim1=-2, dim2=-1).abs()
    last = (n - 1 - count).clamp_min(0)[..., None]
    smallest = torch.where(count < n, pivots.gather(-1, last.clamp_max(pivots.shape[-1] - 1))[..., 0], 1.0)
    charge = TIE_BREAK * smallest[..., None, None]
    Q, T, order = _row_stable_qr(torch.cat([E - (E @ K) @ K.mT, charge * K.mT], dim=-2))
    return CostFactor(T, Q[..., :k, :], order, K.gather(-2, order[..., None].expand_as(K)), charge)


def _row_stable_qr(E: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Q, T and the order of the columns of a pivoted QR of E, its rows sorted by size."""
    batch, (k, n) = E.shape[:-2], E.shape[-2:]
    short = min(k, n)  # 0 if the equalities decide everything
    Q, T = np.zeros((batch.numel(), k, short)), np.zeros((batch.numel(), short, n))
    order = np.zeros((batch.numel(), n), dtype=np.int64)
    for i, matrix in enumerate(E.detach().cpu().reshape(batch.numel(), k, n).numpy()):
        if short:
            rows = np.argsort(-np.abs(matrix).max(axis=1), kind="stable")
            factors = scipy.linalg.qr(matrix[rows], mode="economic", pivoting=True, check_finite=False)
            Q[i, rows], T[i], order[i] = factors
    parts = ((Q, (k, short)), (T, (short, n)), (order, (n,)))
    return tuple(torch.from_numpy(part).reshape(*batch, *own).to(E.device) for part, own in parts)  # type: ignore[return-value]


def _kernel_of(E: Tensor, T: Tensor) -> Tensor:
    """Return an orthonormal basis of the kernel of E, `(..., n_x, n_k)`, padded with zero columns to the largest."""
    k, n = E.shape[-2:]
    pivots = T.diagonal(dim1=-2, dim2=-1).abs()
    if n == 0 or (k >= n and bool((pivots.amin(-1) > CLEAR_PIVOT * KERNEL_TOLERANCE * pivots.amax(-1)).all())):
        return E.new_zeros(*E.shape[:-2], n, 0)
    length = torch.linalg.vector_norm(E, dim=-1, keepdim=True)
    _, singular, right_h = torch.linalg.svd(E / torch.where(length > 0, length, 1.0), full_matrices=True)
    singular = torch.nn.functional.pad(singular, (0, n - singular.shape[-1]))
    in_kernel = singular <= KERNEL_TOLERANCE * singular.amax(-1, keepdim=True)  # the last ones: they are sorted
    most = int(in_kernel.sum(-1).max())
    return (right_h.mT * in_kernel[..., None, :].to(E))[..., n - most :]
