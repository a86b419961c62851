"""The checks at the door: what came, what was asked for, in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor


def as_data(name: str, value: Any, *, finite: bool = True) -> Tensor:
    """Return floating data as a tensor; a tensor passes as it is, with its graph.

    Args:
        name: what the caller calls it; the error says so.
        value: a floating tensor, a NumPy float array, or a nested list of floats.
        finite: refuse NaN and infinity.

    Raises:
        ValueError: integer, boolean or complex values, ragged lists, or values that are not finite.
    """
    if isinstance(value, Tensor):
        tensor = value
    else:
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise ValueError(f"`{name}` must be a rectangular array of floats: {error}") from error
        if not np.issubdtype(array.dtype, np.floating):
            raise ValueError(f"`{name}` must hold floating-point numbers, got {array.dtype}.")
        tensor = torch.as_tensor(array)
    if not tensor.is_floating_point():
        raise ValueError(f"`{name}` must hold floating-point numbers, got {tensor.dtype}.")
    if finite and not is_finite(tensor):
        bad = int((~torch.isfinite(tensor.detach())).sum())
        raise ValueError(f"`{name}` must be finite, got {bad} NaN or infinite of {tensor.numel()} values.")
    return tensor


def is_finite(tensor: Tensor) -> bool:
    """Return whether every value is finite."""
    return bool(torch.isfinite(tensor.detach()).all())


def check_count(name: str, value: Any) -> None:
    """Raise ValueError unless the value is a positive integer."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"`{name}` must be a positive integer, got {value!r}.")
