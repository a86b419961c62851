"""The rank of recorded data: its tolerance, and persistency of excitation, a rank of the recorded input."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from ..checks import as_data
from ..errors import ExcitationWarning
from .recordings import hankel

#: Singular values at or below this fraction of the largest count as zero. Double-precision recordings of a
#: noise-free system leave about 1e-15; single-precision ones carry rounding of 6e-8 a sample.
RANK_TOLERANCE = {torch.float64: 1e-10, torch.float32: 1e-5}
_TINY = torch.finfo(torch.float64).tiny
#: The same for recordings of half precision.
HALF_PRECISION_TOLERANCE = 1e-2


def relative_tolerance(dtype: torch.dtype) -> float:
    """Return the documented rank tolerance for data of a precision."""
    return RANK_TOLERANCE.get(dtype, HALF_PRECISION_TOLERANCE)


def excitation_order(recordings: list[Tensor]) -> int:
    """Return the largest depth whose (mosaic-)Hankel matrix of the inputs has full row rank.

    Args:
        recordings: inputs, each `(T, n_u)`.

    Example:
        >>> u = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0], dtype=torch.float64).reshape(5, 1)
        >>> excitation_order([u]), excitation_order([torch.ones(9, 1)])
        (3, 1)
    """
    if isinstance(recordings, str) or not isinstance(recordings, Sequence) or not recordings:
        raise ValueError(f"`recordings` must be a list of tensors (T, n_u), got {recordings!r}.")
    recordings = [as_data(f"recordings[{i}]", w) for i, w in enumerate(recordings)]
    if any(w.ndim != 2 for w in recordings):
        raise ValueError(f"`recordings` must have shape (T, n_u), got {[tuple(w.shape) for w in recordings]}.")
    low, high = 0, max(recording.shape[0] for recording in recordings)
    while low < high:  # full row rank at depth L implies it at every smaller depth: bisect
        middle = (low + high + 1) // 2
        blocks = torch.cat([hankel(w, middle) for w in recordings if w.shape[0] >= middle], dim=1)
        full = has_full_row_rank(blocks, relative_tolerance(blocks.dtype))
        low, high = (middle, high) if full else (low, middle - 1)
    return low


def has_full_row_rank(matrix: Tensor, tolerance: float) -> bool:
    """Return whether the smallest singular value exceeds a fraction of the largest, the rows at unit length.

    Rows at unit length have no units: an input in micrometres beside one in kilometres excites as much.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return False
    rows = matrix.double()
    length = torch.linalg.vector_norm(rows / rows.abs().amax().clamp_min(_TINY), dim=1, keepdim=True)
    if not bool((length > 0).all()):
        return False
    R = torch.linalg.qr((rows / (length * rows.abs().amax())).T, mode="r").R
    singular = torch.linalg.svdvals(R)
    return bool(singular[-1] > tolerance * singular[0])


def warn_of_excitation(order: int, depth: int, windows: int, n_u: int, *, stacklevel: int) -> None:
    """Warn that the input is not persistently exciting of order t_ini + horizon = depth, with the numbers."""
    warnings.warn(
        f"the input is persistently exciting of order {order}, {depth} (t_ini + horizon) is "
        f"needed, and {depth} plus the order of the system for a guarantee: the data do not hold every trajectory "
        f"of the system. There are {windows} windows for {depth * n_u} input rows; record longer, or vary each "
        f"input more.",
        ExcitationWarning,
        stacklevel=stacklevel + 1,
    )
