"""Hankel matrices from one or many recorded trajectories.

A window of the data, `t_ini` past and `horizon` future steps, is one column; by Willems' fundamental lemma
(Willems, Rapisarda, Markovsky, De Moor 2005) the columns span every trajectory of a linear system, if the
recorded input is exciting enough. Several recordings are put side by side (the mosaic-Hankel matrix of
van Waarde, De Persis, Camlibel, Tesi 2020), so that no window runs across a seam.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from .checks import as_data, check_count
from .errors import ExcitationWarning
from .rowspace import RowSpace, relative_tolerance


def hankel(w: Tensor, depth: int) -> Tensor:
    """Return the Hankel matrix of one signal.

    Args:
        w: the samples, shape `(T, n)`.
        depth: how many steps one column holds; at most T.

    Returns:
        Shape `(depth n, T - depth + 1)`; column j stacks w[j], ..., w[j + depth - 1], time-major.

    Example:
        >>> hankel(torch.arange(4.0).reshape(4, 1), depth=2)
        tensor([[0., 1., 2.],
                [1., 2., 3.]])
    """
    windows = w.unfold(0, depth, 1)  # (T - depth + 1, n, depth)
    return windows.permute(2, 1, 0).reshape(depth * w.shape[1], -1)


@dataclass(frozen=True, eq=False)
class HankelData:
    """The recorded data of a system, cut into past and future.

    Attributes:
        Up, Uf: past and future inputs, `(t_ini n_u, n_g)` and `(horizon n_u, n_g)`.
        Yp, Yf: past and future outputs, `(t_ini n_y, n_g)` and `(horizon n_y, n_g)`.
        t_ini, horizon: past and future steps of a window.
        n_u, n_y: inputs and outputs of the system.

    The rows are time-major and each column is one window. The matrices are constants of the problem: replace
    the object rather than edit them. A graph behind the trajectories is kept, so the data can be differentiated.

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

    @classmethod
    def from_trajectories(cls, u: Any, y: Any, *, t_ini: int, horizon: int) -> HankelData:
        """Build the matrices from one recording, or from a list of recordings.

        Args:
            u: inputs, `(T, n_u)`, or a list of such; u[k] was applied at y[k].
            y: outputs, `(T, n_y)`, or a list of such, as long as their inputs.
            t_ini: steps that fix the initial condition (the paper's sigma).
            horizon: steps that are planned.

        Raises:
            ValueError: shapes that do not fit, samples that are not finite, or a recording shorter than one window.

        Warns:
            ExcitationWarning: the input is not persistently exciting of order t_ini + horizon.
        """
        check_count("t_ini", t_ini)
        check_count("horizon", horizon)
        u_list, y_list = _recordings(u, y)
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
        _check_excitation([recording.detach() for recording in u_list], U.detach(), depth)
        cut_u, cut_y = t_ini * n_u, t_ini * n_y
        return cls(U[:cut_u], U[cut_u:], Y[:cut_y], Y[cut_y:], t_ini, horizon, n_u, n_y)

    @property
    def n_g(self) -> int:
        """The number of windows: columns of the matrices."""
        return self.Up.shape[-1]

    @property
    def matrices(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Up, Yp, Uf, Yf: W = [Up; Yp; Uf] comes first, as the reduction reads it."""
        return self.Up, self.Yp, self.Uf, self.Yf

    @cached_property
    def row_space(self) -> RowSpace:
        """The factorisation of the stacked data, made once; see :class:`torch_dpc.rowspace.RowSpace`."""
        with torch.inference_mode(False), torch.no_grad():
            return RowSpace.of(self)

    @property
    def rank(self) -> int:
        """The numerical rank of [Up; Yp; Uf; Yf], channels brought to one scale."""
        return self.row_space.rank

    def __repr__(self) -> str:
        space = self.row_space
        return (
            f"HankelData(n_u={self.n_u}, n_y={self.n_y}, t_ini={self.t_ini}, horizon={self.horizon}, n_g={self.n_g}, "
            f"rank={space.rank} of {space.n_rows} rows, singular values {space.last_kept:.1e} kept / "
            f"{space.first_dropped:.1e} dropped, relative to the largest)"
        )


def _recordings(u: Any, y: Any) -> tuple[list[Tensor], list[Tensor]]:
    """Return the recordings as two lists of matching tensors `(T, n)`."""

    def listed(name: str, value: Any) -> list[Tensor]:
        many = isinstance(value, Sequence) and len(value) > 0 and all(getattr(v, "ndim", 0) == 2 for v in value)
        if isinstance(value, Sequence) and not many and _depth(value) == 3:
            many = True
        items = [as_data(f"{name}[{i}]", v) for i, v in enumerate(value)] if many else [as_data(name, value)]
        for item in items:
            if item.ndim != 2 or item.shape[1] == 0:
                raise ValueError(
                    f"`{name}` must have shape (T, n), time first, or be a list of such, got {tuple(item.shape)}."
                )
        return items

    u_list, y_list = listed("u", u), listed("y", y)
    if len(u_list) != len(y_list):
        raise ValueError(f"`u` and `y` must hold as many recordings, got {len(u_list)} and {len(y_list)}.")
    for i, (a, b) in enumerate(zip(u_list, y_list, strict=True)):
        if a.shape[0] != b.shape[0]:
            raise ValueError(f"recording {i}: `u` and `y` must be as long, got {a.shape[0]} and {b.shape[0]} samples.")
        if a.shape[1] != u_list[0].shape[1] or b.shape[1] != y_list[0].shape[1]:
            raise ValueError(f"recording {i} has other channels than recording 0: {a.shape[1]} and {b.shape[1]}.")
    common = torch.promote_types(u_list[0].dtype, y_list[0].dtype)
    return [a.to(common) for a in u_list], [b.to(common) for b in y_list]


def _depth(value: Any) -> int:
    """Return how deep a nested list is."""
    return 1 + _depth(value[0]) if isinstance(value, Sequence) and len(value) > 0 else 0


def excitation_order(recordings: list[Tensor]) -> int:
    """Return the largest depth whose (mosaic-)Hankel matrix of the inputs has full row rank.

    Args:
        recordings: inputs, each `(T, n_u)`.

    Example:
        >>> u = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0], dtype=torch.float64).reshape(5, 1)
        >>> excitation_order([u]), excitation_order([torch.ones(9, 1)])
        (3, 1)
    """
    low, high = 0, max(recording.shape[0] for recording in recordings)
    while low < high:  # full row rank at depth L implies it at every smaller depth: bisect
        middle = (low + high + 1) // 2
        blocks = [hankel(w, middle) for w in recordings if w.shape[0] >= middle]
        low, high = (middle, high) if _has_full_row_rank(torch.cat(blocks, dim=1)) else (low, middle - 1)
    return low


def _has_full_row_rank(matrix: Tensor) -> bool:
    if matrix.shape[0] > matrix.shape[1]:
        return False
    R = torch.linalg.qr(matrix.double().T, mode="r").R
    singular = torch.linalg.svdvals(R)
    return bool(singular[-1] > relative_tolerance(matrix.dtype) * singular[0])


def _check_excitation(recordings: list[Tensor], U: Tensor, depth: int) -> None:
    if _has_full_row_rank(U):
        return
    n_u, windows = recordings[0].shape[1], U.shape[1]
    warnings.warn(
        f"the input is persistently exciting of order {excitation_order(recordings)}, {depth} (t_ini + horizon) is "
        f"needed, and {depth} plus the order of the system for a guarantee: the data do not hold every trajectory "
        f"of the system. There are {windows} windows for {depth * n_u} input rows; record longer, or vary each "
        f"input more.",
        ExcitationWarning,
        stacklevel=3,
    )
