"""Many data sets at once: one problem each, factored and solved as a batch."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from .hankel import HankelData


class HankelBatch:
    """Data sets of one size, for a layer that plans from all of them in one call.

    The batch dimension stands last among those of a call, as that of a batch of weights does: measurements
    `(*batch, t_ini, n)` broadcast against it.

    Args:
        members: the data sets; alike in `t_ini`, `horizon`, `n_u` and `n_y`, not necessarily in their windows.

    Raises:
        ValueError: no data, or sizes that differ.

    Example:
        >>> def recording(seed):
        ...     source = torch.Generator().manual_seed(seed)
        ...     u = torch.rand(60, 1, dtype=torch.float64, generator=source) - 0.5
        ...     return HankelData.from_trajectories(u, u.cumsum(0) - u, t_ini=2, horizon=5)
        >>> from torch_dpc import DPCLayer
        >>> layer = DPCLayer(HankelBatch([recording(0), recording(1)]), Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e3)
        >>> layer(torch.zeros(2, 1), torch.zeros(2, 1), y_ref=torch.ones(1)).u.shape
        torch.Size([2, 5, 1])
    """

    def __init__(self, members: Iterable[HankelData]):
        if not isinstance(members, Iterable):
            raise ValueError(f"`members` must be a list of one HankelData or more, got {type(members).__name__}.")
        self.members = tuple(members)
        if not self.members or not all(isinstance(data, HankelData) for data in self.members):
            came = ", ".join(type(data).__name__ for data in self.members) or "none"
            raise ValueError(f"`members` must be a list of one HankelData or more, got {came}.")
        sizes = {(data.t_ini, data.horizon, data.n_u, data.n_y) for data in self.members}
        if len(sizes) > 1:
            raise ValueError(f"the data sets must be alike in (t_ini, horizon, n_u, n_y), got {sorted(sizes)}.")
        ((self.t_ini, self.horizon, self.n_u, self.n_y),) = sizes

    def to(self, *args: Any, **options: Any) -> HankelBatch:
        """Return every data set on another device or in another precision; see :meth:`torch_dpc.HankelData.to`."""
        return HankelBatch([data.to(*args, **options) for data in self.members])

    @property
    def device(self) -> torch.device:
        """Where the data are."""
        return self.members[0].device

    @property
    def matrices(self) -> tuple[Tensor, ...]:
        """The matrices of every data set."""
        return tuple(matrix for data in self.members for matrix in data.matrices)

    @cached_property
    def with_ones(self) -> HankelBatch:
        """The same data sets, each with a row of ones; see :attr:`HankelData.with_ones`."""
        return HankelBatch(data.with_ones for data in self.members)

    @property
    def has_ones(self) -> bool:
        """Whether Up has a row of ones before its own rows."""
        return any(data.has_ones for data in self.members)

    @property
    def n_g(self) -> int:
        """The columns of the matrices.

        Raises:
            ValueError: they differ.
        """
        columns = {data.n_g for data in self.members}
        if len(columns) > 1:
            raise ValueError(f"the data sets have different numbers of windows, {sorted(columns)}: there is no one g.")
        return columns.pop()

    @property
    def rank(self) -> Tensor:
        """The numerical rank of each data set."""
        return torch.tensor([data.rank for data in self.members])

    @property
    def spans_all(self) -> Tensor:
        """Of each data set, whether its rows span all of its g, boolean `(members,)`."""
        return torch.stack([data.spans_all for data in self.members])

    @property
    def stacked(self) -> Tensor:
        """The matrices [Up; Yp; Uf; Yf], `(members, rows, n_g)`, float64; a graph is kept.

        Raises:
            ValueError: they have different numbers of columns.
        """
        self.n_g  # noqa: B018  # it says so
        return torch.stack([data.stacked for data in self.members])

    @property
    def basis(self) -> Tensor:
        """B of g = B a for each data set, padded with zero columns: `(members, n_g, r)`.

        Raises:
            ValueError: they have different numbers of columns.
        """
        self.n_g  # noqa: B018  # it says so
        most = int(self.rank.max())
        return torch.stack([torch.nn.functional.pad(data.basis, (0, most - data.rank)) for data in self.members])

    def require_windows(self) -> None:
        """Raise ValueError where one of the data sets is compact."""
        for data in self.members:
            data.require_windows()

    def __repr__(self) -> str:
        first = self.members[0]
        return (
            f"HankelBatch({len(self.members)} data sets, n_u={self.n_u}, n_y={self.n_y}, t_ini={first.t_ini}, "
            f"horizon={first.horizon})"
        )
