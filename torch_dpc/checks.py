"""The checks at the door: what came, what was asked for, in words."""

from __future__ import annotations

import math
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
    # A sum takes a tenth of the time; where it is finite, so is every value.
    return math.isfinite(float(tensor.detach().sum())) or bool(torch.isfinite(tensor.detach()).all())


def check_count(name: str, value: Any) -> None:
    """Raise ValueError unless the value is a positive integer."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"`{name}` must be a positive integer, got {value!r}.")


def window(name: str, value: Any, steps: int, channels: int, symbol: str) -> Tensor:
    """Return a past window as a tensor `(*batch, steps, channels)`; `symbol` is what messages call the channels."""
    tensor = as_data(name, value, finite=False)  # values are looked at inside the Function: here it would break vmap
    if tensor.shape[-2:] != (steps, channels):
        raise ValueError(
            f"`{name}` must have shape (*batch, t_ini, {symbol}) = (*, {steps}, {channels}), "
            f"got {tuple(tensor.shape)}."
        )
    return tensor


def reference(name: str, value: Any, steps: int, channels: int, symbol: str, like: Tensor) -> Tensor:
    """Return a reference as a tensor `(*batch, steps, channels)`, on the device of `like`; zero for None."""
    if value is None:
        return like.new_zeros(()).expand(steps, channels)
    tensor = as_data(name, value, finite=False).to(like.device)
    try:
        return tensor.expand(*tensor.shape[:-2], steps, channels)
    except RuntimeError as error:
        raise ValueError(
            f"`{name}` must broadcast to (*batch, horizon, {symbol}) = (*, {steps}, {channels}), "
            f"got {tuple(tensor.shape)}."
        ) from error


def with_one_batch(parts: list[Tensor]) -> list[Tensor]:
    """Return u_ini, y_ini, u_ref and y_ref, `(*batch, steps, n)`, with one batch shape."""
    shapes = [part.shape[:-2] for part in parts]
    if all(shape == shapes[0] for shape in shapes):
        return parts
    try:
        batch = torch.broadcast_shapes(*shapes)
    except RuntimeError as error:
        names = ("u_ini", "y_ini", "u_ref", "y_ref")
        came = ", ".join(f"{name} {tuple(shape)}" for name, shape in zip(names, shapes, strict=True))
        raise ValueError(f"the batch shapes must broadcast, got {came}.") from error
    return [part.expand(*batch, *part.shape[-2:]) for part in parts]
