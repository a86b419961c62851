"""The row space of the data: where the number of recorded windows leaves the problem.

The cost and the constraints see g only through the rows of [Up; Yp; Uf; Yf] and through |M g|. With an orthonormal
basis B of their row space, g = B a loses nothing: a part of g orthogonal to every row would only be charged
lambda_g. B is built so that its first columns span the rows of W = [Up; Yp; Uf]; then |M g|^2 is the sum of the
squares of the other entries of a.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from .hankel import HankelData

#: Singular values at or below this fraction of the largest count as zero. Double-precision recordings of a
#: noise-free system leave about 1e-15; single-precision ones carry rounding of 6e-8 a sample.
RANK_TOLERANCE = {torch.float64: 1e-10, torch.float32: 1e-5}


def relative_tolerance(dtype: torch.dtype) -> float:
    """Return the documented rank tolerance for data of a precision."""
    return RANK_TOLERANCE.get(dtype, 1e-2)


@dataclass(frozen=True, eq=False)
class RowSpace:
    """An orthonormal basis of the row space of [Up; Yp; Uf; Yf], W = [Up; Yp; Uf] first.

    Attributes:
        basis: B, `(n_g, rank)`, float64, orthonormal columns; the first `rank_W` span the rows of W.
        rank: the numerical rank of the stacked matrix.
        rank_W: the numerical rank of W.
        n_rows: the rows of the stacked matrix, (t_ini + horizon)(n_u + n_y).
        last_kept, first_dropped: the singular values on either side of the decision, relative to the largest.
        clear: whether the decision leaves a gap of at least `CLEAR_GAP` on both sides of the tolerance.
    """

    basis: Tensor
    rank: int
    rank_W: int
    n_rows: int
    last_kept: float
    first_dropped: float

    #: A rank is clear when the kept values are this factor above the dropped ones.
    CLEAR_GAP = 1e2

    @property
    def clear(self) -> bool:
        """Whether kept and dropped singular values are far apart, so that the rank is constant nearby."""
        return self.last_kept > self.CLEAR_GAP * self.first_dropped

    def of_its_coordinates(self) -> RowSpace:
        """Return the row space of the data written in this basis, with the same decision: the basis is the identity."""
        return replace(self, basis=torch.eye(self.rank, dtype=self.basis.dtype, device=self.basis.device))

    @staticmethod
    def of(data: HankelData) -> RowSpace:
        """Factor the data once: QR of the columns, then two small SVDs that decide the ranks.

        Every channel is brought to one scale first, so that the rank does not depend on the units; both ranks are
        judged against the largest singular value of the whole stacked matrix, the remainder of Yf included.
        """
        stacked = torch.cat([_to_unit_channels(m.detach().double(), n) for m, n in _with_channels(data)])
        tolerance = data.rank_tolerance
        columns, R = torch.linalg.qr(stacked.T)  # n_g enters here and nowhere else
        rows = R.T
        n_W = rows.shape[0] - data.Yf.shape[0]
        largest = torch.linalg.matrix_norm(rows, ord=2).clamp_min(torch.finfo(torch.float64).tiny)
        in_W, kept_W, dropped_W = _right_range(rows[:n_W], tolerance * largest)
        remainder = rows[n_W:] - (rows[n_W:] @ in_W) @ in_W.T
        in_rest, kept_rest, dropped_rest = _right_range(remainder, tolerance * largest)
        # Orthogonal once more: the remainder of Yf is small on low-noise data and would keep a trace of W.
        in_rest = torch.linalg.qr(in_rest - in_W @ (in_W.T @ in_rest)).Q
        basis = columns @ torch.cat([in_W, in_rest], dim=1)
        kept = torch.cat([kept_W, kept_rest]) / largest
        dropped = torch.cat([dropped_W, dropped_rest]) / largest
        return RowSpace(
            basis=basis,
            rank=basis.shape[1],
            rank_W=in_W.shape[1],
            n_rows=rows.shape[0],
            last_kept=float(kept.min()) if kept.numel() else 0.0,
            first_dropped=float(dropped.max()) if dropped.numel() else 0.0,
        )


def _with_channels(data: HankelData) -> list[tuple[Tensor, int]]:
    Up, Yp, Uf, Yf = data.matrices
    return [(Up, data.n_u), (Yp, data.n_y), (Uf, data.n_u), (Yf, data.n_y)]


def _to_unit_channels(matrix: Tensor, channels: int) -> Tensor:
    """Divide every channel's rows by their root mean square (an idle channel stays zero)."""
    blocks = matrix.reshape(-1, channels, matrix.shape[1])
    scale = blocks.square().mean(dim=(0, 2), keepdim=True).sqrt()
    return (blocks / torch.where(scale > 0, scale, 1.0)).reshape(matrix.shape)


def _right_range(matrix: Tensor, cutoff: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return a basis of the row space `(columns, r)`, the singular values kept, and those dropped."""
    _, singular, Vh = torch.linalg.svd(matrix, full_matrices=False)
    rank = int((singular > cutoff).sum())
    return Vh[:rank].T, singular[:rank], singular[rank:]
