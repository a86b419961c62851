"""References of a run."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_data


def reference_trajectory(name: str, value: Any, steps: int, channels: int, horizon: int) -> Tensor:
    """Return a reference for a run of `steps` steps, each of which looks `horizon` steps ahead.

    Args:
        name: what the caller calls it; errors say so.
        value: a number for all channels, `(channels,)`, or a trajectory `(>= steps, channels)`, whose last row is held
            beyond its end; or one a run, `(*batch, >= steps, channels)`, or `(*batch, 1, channels)` for constants.
        steps, channels, horizon: sizes.

    Returns:
        `(*batch, >= steps + horizon, channels)`, float64.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    tensor = as_data(name, value, integers=True).double()
    if tensor.ndim == 0:
        tensor = tensor.expand(1, channels)
    elif tensor.ndim == 1:
        tensor = tensor[None]
    elif tensor.ndim >= 2 and tensor.shape[-2] < steps and not (tensor.ndim > 2 and tensor.shape[-2] == 1):
        raise ValueError(f"`{name}` must have at least `steps` = {steps} rows, got {tensor.shape[-2]}.")
    if tensor.ndim < 2 or tensor.shape[-1] != channels:
        shapes = f"({channels},) or (*batch, >= steps, {channels})"
        raise ValueError(f"`{name}` must have shape {shapes}, got {tuple(tensor.shape)}.")
    missing = max(steps + horizon - tensor.shape[-2], 0)
    return torch.cat([tensor, tensor[..., -1:, :].expand(*tensor.shape[:-2], missing, channels)], dim=-2)
