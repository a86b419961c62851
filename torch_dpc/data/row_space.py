"""The row space of the data: where the number of recorded windows leaves the problem.

The cost and the constraints see g only through the rows of [Up; Yp; Uf; Yf] and through |M g|. With an orthonormal
basis B of their row space, g = B a loses nothing: a part of g orthogonal to every row would only be charged
lambda_g. B is built so that its first columns span the rows of W = [Up; Yp; Uf]; then |M g|^2 is the sum of the
squares of the other entries of a.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

LOGGER = logging.getLogger(__name__)
#: Rows of W whose singular values spread by more than this need extended precision for the basis of their space.
THIN = 1e-4


@dataclass(frozen=True, eq=False)
class RowSpace:
    """An orthonormal basis of the row space of [Up; Yp; Uf; Yf], W = [Up; Yp; Uf] first.

    Attributes:
        basis: B, `(n_g, rank)`, float64, orthonormal columns; the first `rank_W` span the rows of W.
        units: the unit of each row's channel, `(n_rows,)`, float64: a power of two near its root mean square.
        rank: the numerical rank of the stacked matrix.
        rank_W: the numerical rank of W.
        n_rows: the rows of the stacked matrix, (t_ini + horizon)(n_u + n_y).
        last_kept, first_dropped: the singular values on either side of the decision, relative to the largest.
        clear: whether the decision leaves a gap of at least `CLEAR_GAP` on both sides of the tolerance.
    """

    basis: Tensor
    units: Tensor
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
    def of(matrices: Sequence[Tensor], n_u: int, n_y: int, *, n_windows: int, tolerance: float) -> RowSpace:
        """Factor the data once: QR of the columns, then two small SVDs that decide the ranks.

        Every channel is brought to its own unit first, so that the rank does not depend on the units; both ranks are
        judged against the largest singular value of the whole stacked matrix, the remainder of Yf included.

        Args:
            matrices: Up, Yp, Uf, Yf, each `(rows, n_g)`.
            n_u, n_y: inputs and outputs of the system.
            n_windows: the recorded windows behind the columns.
            tolerance: singular values at or below this fraction of the largest count as zero.
        """
        units = row_units(matrices, n_u, n_y, n_windows)
        stacked = torch.cat([m.detach().double() for m in matrices]) / units[:, None]
        columns, R = torch.linalg.qr(stacked.T)  # n_g enters here and nowhere else
        rows = R.T
        n_W = rows.shape[0] - matrices[-1].shape[0]
        largest = torch.linalg.matrix_norm(rows, ord=2).clamp_min(torch.finfo(torch.float64).tiny)
        in_W, kept_W, dropped_W = _right_range(rows[:n_W], tolerance * largest)
        remainder = rows[n_W:] - (rows[n_W:] @ in_W) @ in_W.T
        in_rest, kept_rest, dropped_rest = _right_range(remainder, tolerance * largest)
        # Orthogonal once more: the remainder of Yf is small on low-noise data and would keep a trace of W.
        in_rest = torch.linalg.qr(in_rest - in_W @ (in_W.T @ in_rest)).Q
        basis = columns @ torch.cat([in_W, in_rest], dim=1)
        if len(kept_W) and bool(kept_W[-1] < THIN * kept_W[0]):
            basis = _turned_onto(stacked[:n_W], basis, in_W.shape[1])
        kept = torch.cat([kept_W, kept_rest]) / largest
        dropped = torch.cat([dropped_W, dropped_rest]) / largest
        space = RowSpace(
            basis=basis,
            units=units,
            rank=basis.shape[1],
            rank_W=in_W.shape[1],
            n_rows=rows.shape[0],
            last_kept=float(kept.min()) if kept.numel() else 0.0,
            first_dropped=float(dropped.max()) if dropped.numel() else 0.0,
        )
        LOGGER.log(
            logging.INFO if space.clear else logging.WARNING,
            "rank %d of %d rows (%d of the past and the future inputs), singular values %.1e kept, %.1e dropped%s",
            *(space.rank, space.n_rows, space.rank_W, space.last_kept, space.first_dropped),
            "" if space.clear else ": no clear gap",
        )
        return space


def row_units(matrices: Sequence[Tensor], n_u: int, n_y: int, n_windows: int) -> Tensor:
    """Return the unit of each row of [Up; Yp; Uf; Yf], `(n_rows,)`, float64; arguments as of :meth:`RowSpace.of`."""
    Up, Yp, Uf, Yf = (m.detach().double() for m in matrices)
    unit_u = _channel_units(torch.cat([Up[-(len(Yp) // n_y) * n_u :], Uf]), n_u, n_windows)  # without a row of ones
    unit_y = _channel_units(torch.cat([Yp, Yf]), n_y, n_windows)
    past, future = len(Yp) // n_y, len(Uf) // n_u
    ones = unit_u.new_ones(len(Up) - past * n_u)
    return torch.cat([ones, unit_u.repeat(past), unit_y.repeat(past), unit_u.repeat(future), unit_y.repeat(future)])


def _channel_units(rows: Tensor, channels: int, n_windows: int) -> Tensor:
    """Return the unit of each channel, `(channels,)`: the power of two nearest to its root mean square, 1 if idle.

    Multiplication by a power of two is exact, so that scaling by a unit and back loses nothing.
    """
    largest = rows.abs().amax(dim=1).reshape(-1, channels).amax(dim=0)  # first, so that no square under- or overflows
    scaled = rows.reshape(-1, channels, rows.shape[1]) / torch.where(largest > 0, largest, 1.0)[:, None]
    mean_square = scaled.square().sum(dim=(0, 2)) / (scaled.shape[0] * n_windows)
    size = torch.where(largest > 0, largest * mean_square.sqrt(), 1.0)
    return torch.exp2(size.log2().round())


def _turned_onto(W: Tensor, basis: Tensor, rank: int) -> Tensor:
    """Return the basis with its first `rank` columns on the row space of W to full precision, the others across it.

    A singular vector is off by rounding relative to its singular value, and |M g|^2 charges what lies beside the rows
    of W. Sums of rows of W in extended precision lie beside nothing.
    """
    long = W.cpu().numpy().astype(np.longdouble)
    first, others = basis[:, :rank].cpu().numpy(), basis[:, rank:].cpu().numpy().astype(np.longdouble)
    image = (W.cpu().numpy() @ first).astype(float)  # U S of the singular value decomposition
    size = np.linalg.norm(image, axis=0)
    turned = _orthonormal(long.T @ (image / size**2))
    others = others - turned @ (turned.T @ others)
    return torch.from_numpy(np.concatenate([turned, _orthonormal(others)], axis=1).astype(float)).to(basis.device)


def _orthonormal(columns: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
    """Return orthonormal columns that span those given, by Gram-Schmidt, each column done twice."""
    Q = columns.copy()
    for j in range(Q.shape[1]):
        for _ in range(2):
            Q[:, j] -= Q[:, :j] @ (Q[:, :j].T @ Q[:, j])
            Q[:, j] /= np.sqrt(Q[:, j] @ Q[:, j])
    return Q


def _right_range(matrix: Tensor, cutoff: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return a basis of the row space `(columns, r)`, the singular values kept, and those dropped."""
    _, singular, Vh = torch.linalg.svd(matrix, full_matrices=False)
    rank = int((singular > cutoff).sum())
    return Vh[:rank].T, singular[:rank], singular[rank:]
