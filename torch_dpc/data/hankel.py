"""Hankel matrices from one or many recorded trajectories.

A window of the data, `t_ini` past and `horizon` future steps, is one column; by Willems' fundamental lemma
(Willems, Rapisarda, Markovsky, De Moor 2005) the columns span every trajectory of a linear system, if the
recorded input is exciting enough. Several recordings are put side by side (the mosaic-Hankel matrix of
van Waarde, De Persis, Camlibel, Tesi 2020), so that no window runs across a seam.

The file is long because the data have many ways in: trajectories, CSV files, streams, compact data.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .. import plot
from ..checks import as_data, as_index, check_count, check_type
from .csv import Source, read_csv
from .rank import excitation_order, has_full_row_rank, relative_tolerance, warn_of_excitation
from .recordings import as_recordings, hankel
from .ridge import ridge_deviation, with_ridge_columns
from .row_space import RowSpace
from .window_factor import WindowFactor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["HankelData", "excitation_order", "hankel"]


@dataclass(frozen=True, eq=False)
class HankelData:
    """The recorded data of a system, cut into past and future.

    Attributes:
        Up, Uf: past and future inputs, `(t_ini n_u, n_g)` and `(horizon n_u, n_g)`.
        Yp, Yf: past and future outputs, `(t_ini n_y, n_g)` and `(horizon n_y, n_g)`.
        t_ini, horizon: past and future steps of a window.
        n_u, n_y: inputs and outputs of the system.
        windows_seen: None where each column is a recorded window. Otherwise the data are compact, and this is how many
            windows went into them (:meth:`from_stream`, :meth:`compressed`).
        recorded_as: the precision of the recordings; None for that of the matrices. It sets the rank tolerance.
        n_ridge: how many of the last columns are a ridge and no windows (:meth:`with_ridge`).

    The rows are time-major and each column is one window. The matrices are constants of the problem: replace
    the object rather than edit them. A graph behind the trajectories is kept, so the data can be differentiated.

    Compact data hold the factor L of D = [Up; Yp; Uf; Yf] = L B' in place of D, with B (n_g, k) of orthonormal columns
    and k at most the number of rows. The problem depends on D through D D' = L L' alone, so that plans, multipliers and
    derivatives are those of the windows; only g is another, B'g.

    Example:
        >>> u, y = torch.rand(40, 1, dtype=torch.float64), torch.rand(40, 2, dtype=torch.float64)
        >>> data = HankelData.from_trajectories(u, y, t_ini=2, horizon=5)
        >>> data.Uf.shape, data.n_g
        (torch.Size([5, 34]), 34)
    """

    Up: Tensor
    Uf: Tensor
    Yp: Tensor
    Yf: Tensor
    t_ini: int
    horizon: int
    n_u: int
    n_y: int
    windows_seen: int | None = None
    recorded_as: torch.dtype | None = None
    n_ridge: int = 0

    def __post_init__(self) -> None:
        sizes = {name: check_count(name, getattr(self, name)) for name in ("t_ini", "horizon", "n_u", "n_y")}
        if self.windows_seen is not None and as_index("`windows_seen` must be a count or None", self.windows_seen) < 0:
            raise ValueError(f"`windows_seen` must be a count or None, got {self.windows_seen!r}.")
        columns = self.Up.shape[-1] if isinstance(self.Up, Tensor) and self.Up.ndim else None
        for name in ("Up", "Uf", "Yp", "Yf"):
            matrix = getattr(self, name)
            check_type(name, matrix, Tensor)
            as_data(name, matrix)
            steps, channels = ("t_ini" if name[1] == "p" else "horizon"), f"n_{name[0].lower()}"
            may_have_ones = name == "Up" and self.has_ones
            if may_have_ones and (self.windows_seen is not None or bool((matrix[0] == self._ones).all())):
                matrix = matrix[1:]  # the row of ones of `with_ones`
            if matrix.shape != (sizes[steps] * sizes[channels], columns):
                wanted = f"({steps} {channels}, n_g) = ({sizes[steps] * sizes[channels]}, {columns})"
                raise ValueError(f"`{name}` must have shape {wanted}, got {tuple(matrix.shape)}.")

    @classmethod
    def from_trajectories(cls, u: Any, y: Any, *, t_ini: int, horizon: int, ridge: Any = 0.0) -> HankelData:
        """Build the matrices from one recording, or from a list of recordings.

        Args:
            u: inputs, `(T, n_u)`, or a list of such; u[k] was applied at y[k].
            y: outputs, `(T, n_y)`, or a list of such, as long as their inputs.
            t_ini: steps that fix the initial condition (the paper's sigma).
            horizon: steps that are planned.
            ridge: as if the recorded outputs had noise of this size, relative to the standard deviation of each
                output: :meth:`with_ridge`; a number or `(n_y,)`.

        Raises:
            ValueError: shapes that do not fit, samples that are not finite, or a recording shorter than one window.

        Warns:
            ExcitationWarning: the input is not persistently exciting of order t_ini + horizon.
        """
        t_ini, horizon = check_count("t_ini", t_ini), check_count("horizon", horizon)
        u_list, y_list = as_recordings(u, y)
        depth = t_ini + horizon
        for i, recording in enumerate(u_list):
            if recording.shape[0] < depth:
                raise ValueError(
                    f"recording {i} must have at least t_ini + horizon = {depth} samples for one window, "
                    f"got {recording.shape[0]}."
                )
        n_u, n_y = u_list[0].shape[1], y_list[0].shape[1]
        U = torch.cat([hankel(recording, depth) for recording in u_list], dim=1)
        Y = torch.cat([hankel(recording, depth) for recording in y_list], dim=1)
        if not has_full_row_rank(U.detach(), relative_tolerance(U.dtype)):
            order = excitation_order([recording.detach() for recording in u_list])
            warn_of_excitation(order, depth, U.shape[1], n_u, stacklevel=2)
        cut_u, cut_y = t_ini * n_u, t_ini * n_y
        data = cls(U[:cut_u], U[cut_u:], Y[:cut_y], Y[cut_y:], t_ini, horizon, n_u, n_y)
        if isinstance(ridge, (int, float)) and ridge == 0:
            return data
        return data.with_ridge(ridge_deviation("ridge", ridge, n_y) * torch.cat(y_list).std(dim=0))

    @classmethod
    def from_csv(
        cls,
        path: Source | Sequence[Source],
        *,
        inputs: Sequence[str],
        outputs: Sequence[str],
        t_ini: int,
        horizon: int,
        delimiter: str = ",",
        ridge: Any = 0.0,
    ) -> HankelData:
        """Build the matrices from a CSV file, or from a list of files, each a recording of its own.

        Args:
            path: of a file whose first line names the columns, with one sample a line below, or a list of such.
            inputs, outputs: names of the columns of u and y, in the order of the channels.
            t_ini: steps that fix the initial condition.
            horizon: steps that are planned.
            delimiter: between columns.
            ridge: as for :meth:`from_trajectories`.

        Raises:
            ValueError: a missing column, a line of another length, an entry that is no finite number (each with the
                file and line), or a recording shorter than one window.
            OSError: a file cannot be read.

        Warns:
            ExcitationWarning: the input is not persistently exciting of order t_ini + horizon.
        """
        paths = [path] if isinstance(path, (str, os.PathLike)) else list(path)
        if not paths:
            raise ValueError("`path` must be a file or a list of one file or more, got an empty list.")
        recordings = [read_csv(one, inputs, outputs, delimiter=delimiter) for one in paths]
        u, y = map(list, zip(*recordings, strict=True))
        return cls.from_trajectories(u, y, t_ini=t_ini, horizon=horizon, ridge=ridge)

    @classmethod
    def from_stream(cls, chunks: Iterable[Any], *, t_ini: int, horizon: int) -> HankelData:
        """Build compact data from recordings of any length, piece by piece, in constant memory.

        Each window is folded into a triangular factor (:class:`torch_dpc.HankelStream`) and forgotten. Plans are those
        of :meth:`from_trajectories` on the same recordings; `sol.g` is not available, for the windows are gone. A graph
        behind the samples is not kept.

        Args:
            chunks: pairs (u, y), `(T_i, n_u)` and `(T_i, n_y)`, tensors or arrays. Each goes on where the one before
                ended; None between two of them starts a new recording, and no window runs across that seam.
            t_ini: steps that fix the initial condition.
            horizon: steps that are planned.

        Raises:
            ValueError: shapes that do not fit, samples that are not finite, or no recording as long as one window.

        Warns:
            ExcitationWarning: the input is not persistently exciting of order t_ini + horizon.

        Example:
            >>> def recorder():
            ...     for seed in range(3):
            ...         source = torch.Generator().manual_seed(seed)
            ...         yield torch.rand(50, 1, generator=source), torch.rand(50, 2, generator=source)
            >>> HankelData.from_stream(recorder(), t_ini=2, horizon=5).n_windows
            144
        """
        factor = WindowFactor(t_ini=t_ini, horizon=horizon)
        factor.extend(chunks)
        data = cls.from_factor(factor)
        if (order := factor.excitation_order) < t_ini + horizon:
            warn_of_excitation(order, t_ini + horizon, data.n_windows, data.n_u, stacklevel=2)
        return data

    @classmethod
    def from_factor(cls, factor: WindowFactor) -> HankelData:
        """Return the compact data of the windows in a triangular factor.

        Raises:
            ValueError: no window is complete yet.
        """
        Up, Yp, Uf, Yf = factor.factor()
        sizes = factor.t_ini, factor.horizon, factor.n_u, factor.n_y
        return cls(Up, Uf, Yp, Yf, *sizes, windows_seen=factor.n_windows, recorded_as=factor.recorded_as)

    @property
    def n_g(self) -> int:
        """The columns of the matrices: the windows and those of a ridge, unless the data are compact."""
        return self.Up.shape[-1]

    @property
    def spans_all(self) -> Tensor:
        """Whether the rows of the data span all of g, boolean: then no part of g is left to lambda_g alone."""
        return torch.tensor(self.rank == self.n_g)

    @property
    def has_windows(self) -> bool:
        """Whether each column is a recorded window; not so for compact data."""
        return self.windows_seen is None

    @property
    def n_windows(self) -> int:
        """The number of recorded windows that are in the data."""
        return self.n_g - self.n_ridge if self.windows_seen is None else self.windows_seen

    def require_windows(self) -> None:
        """Raise ValueError where the data are compact, for `g` weighs the recorded windows."""
        if not self.has_windows:
            raise ValueError(
                f"`g` weighs the recorded windows, and these data are compact: of {self.n_windows} windows only the "
                f"factor is kept. u, y and lam do not need them; for g build the layer on "
                f"HankelData.from_trajectories, or save it with `data=True`."
            )

    @property
    def rank_tolerance(self) -> float:
        """Singular values at or below this fraction of the largest count as zero."""
        return relative_tolerance(self.recorded_as or self.Up.dtype)

    @property
    def has_ones(self) -> bool:
        """Whether Up has a row of ones before its own rows; see :attr:`with_ones`."""
        return len(self.Up) > self.t_ini * self.n_u

    @cached_property
    def with_ones(self) -> HankelData:
        """The same data with a row of ones before the rows of Up, for 1'g = 1.

        Raises:
            ValueError: the data are compact, and their factor has no such row.
        """
        if self.has_ones:
            return self
        if not self.has_windows:
            raise ValueError(
                "`affine=True` needs the recorded windows, and these data are compact: build the layer on "
                "HankelData.from_trajectories."
            )
        return replace(self, Up=torch.cat([self._ones[None], self.Up]))

    @property
    def _ones(self) -> Tensor:
        """1 for every window and 0 for the columns of a ridge, which stands for noise of mean zero, `(n_g,)`."""
        return (torch.arange(self.n_g, device=self.Up.device) < self.n_g - self.n_ridge).to(self.Up.dtype)

    def with_ridge(self, deviation: Any) -> HankelData:
        """Return the data as if the recorded outputs had independent noise, on average, in the past of the windows.

        What noise of standard deviation s_i on output i adds on average to D D', n_windows s_i^2 on the diagonal, is
        added to the part of Yp exactly, by t_ini n_y columns that stand after the windows. A plan then trusts a
        direction of the measured past only as far as the recording shows it above that noise. `g` has entries for these
        columns.

        Args:
            deviation: s, in the units of the outputs, a number or `(n_y,)`; its graph is kept.

        Raises:
            ValueError: another shape, or an entry that is negative or not finite.

        Example:
            >>> u, y = torch.rand(40, 1, dtype=torch.float64), torch.rand(40, 2, dtype=torch.float64)
            >>> data = HankelData.from_trajectories(u, y, t_ini=2, horizon=5)
            >>> data.with_ridge(0.01).n_g, data.with_ridge(0.01).n_windows
            (38, 34)
        """
        Up, Uf, Yp, Yf = with_ridge_columns(self, ridge_deviation("deviation", deviation, self.n_y))
        return replace(self, Up=Up, Uf=Uf, Yp=Yp, Yf=Yf, n_ridge=self.n_ridge + self.t_ini * self.n_y)

    def compressed(self) -> HankelData:
        """Return the same data as `rank` columns, whatever the number of windows; plans are the same to the last bit.

        The matrices are those of the data in an orthonormal basis of their row space, float64, with the rank as it was
        decided here. A graph behind the matrices is kept, to first order.

        Example:
            >>> u, y = torch.rand(90, 1, dtype=torch.float64), torch.rand(90, 1, dtype=torch.float64)
            >>> data = HankelData.from_trajectories(u, y, t_ini=2, horizon=5)
            >>> data.n_g, data.compressed().n_g, data.compressed().n_windows
            (84, 14, 84)
        """
        rows = self.stacked @ self.basis
        Up, Yp, Uf, Yf = rows.split([len(m) for m in self.matrices])
        compact = replace(
            self, Up=Up, Uf=Uf, Yp=Yp, Yf=Yf, windows_seen=self.n_windows, n_ridge=0,
            recorded_as=self.recorded_as or self.Up.dtype,
        )  # fmt: skip
        compact.__dict__["row_space"] = self.row_space.of_its_coordinates()
        return compact

    def to(self, *args: Any, **options: Any) -> HankelData:
        """Return the data on another device or in another precision, as `torch.Tensor.to`.

        The rank tolerance stays that of the coarsest precision the data have had. A graph is kept.
        """
        data = replace(self, **{name: getattr(self, name).to(*args, **options) for name in ("Up", "Uf", "Yp", "Yf")})
        had, now = self.recorded_as or self.Up.dtype, data.Up.dtype
        coarsest = max((had, now), key=lambda dtype: torch.finfo(dtype).eps)
        data = replace(data, recorded_as=None if coarsest == now else coarsest)
        if "row_space" in self.__dict__ and (now == self.Up.dtype or not self.has_windows):
            data.__dict__["row_space"] = self.row_space
        return data

    @property
    def matrices(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Up, Yp, Uf, Yf: W = [Up; Yp; Uf] comes first, as the reduction reads it."""
        return self.Up, self.Yp, self.Uf, self.Yf

    @cached_property
    def row_space(self) -> RowSpace:
        """The factorisation of the stacked data, made once; see :class:`torch_dpc.data.row_space.RowSpace`."""
        with torch.inference_mode(False), torch.no_grad():
            return RowSpace.of(
                self.matrices, self.n_u, self.n_y, n_windows=self.n_windows, tolerance=self.rank_tolerance
            )

    @property
    def device(self) -> torch.device:
        """Where the data are."""
        return self.Up.device

    @property
    def stacked(self) -> Tensor:
        """The matrix [Up; Yp; Uf; Yf], float64; a graph is kept."""
        return torch.cat([m.double() for m in self.matrices])

    @property
    def basis(self) -> Tensor:
        """B of g = B a, `(n_g, rank)`."""
        return self.row_space.basis

    @property
    def rank(self) -> int:
        """The numerical rank of [Up; Yp; Uf; Yf], channels brought to one scale."""
        return self.row_space.rank

    def plot(self, axes: Any = None) -> Figure:
        """Draw the Hankel matrix, its singular values with the cut, and the excitation: :func:`torch_dpc.plot.data`."""
        return plot.data(self, axes)

    def __repr__(self) -> str:
        space = self.row_space
        compact = "" if self.has_windows else f" (compact, of {self.n_windows} windows)"
        compact += f" ({self.n_ridge} of a ridge)" if self.n_ridge else ""
        return (
            f"HankelData(n_u={self.n_u}, n_y={self.n_y}, t_ini={self.t_ini}, horizon={self.horizon}, n_g={self.n_g}"
            f"{compact},\n    rank={space.rank} of {space.n_rows} rows, singular values {space.last_kept:.1e} kept / "
            f"{space.first_dropped:.1e} dropped, relative to the largest)"
        )
