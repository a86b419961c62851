"""The numbers and tensors that a set is made of."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..autodiff import is_mapped
from ..shapes import broadcast_shapes


def as_bound(name: str, value: Any) -> Tensor | float:
    """Keep a floating tensor as it is; anything else becomes a float or a float64 tensor."""
    if isinstance(value, Tensor):
        if not value.numel():
            raise ValueError(f"`{name}` must be a number or an array of numbers, got shape {tuple(value.shape)}.")
        if not value.is_floating_point():
            raise ValueError(f"`{name}` must hold floating-point numbers, got {value.dtype}.")
        return value
    try:
        tensor = torch.as_tensor(value, dtype=torch.float64)
        is_bool = torch.as_tensor(value).dtype == torch.bool
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`{name}` must be a number or an array of numbers, got {value!r}.") from error
    if is_bool or not tensor.numel():
        raise ValueError(f"`{name}` must be a number or an array of numbers, got {value!r}.")
    return tensor.item() if tensor.ndim == 0 else tensor


def as_tensor(bound: Tensor | float) -> Tensor:
    """Return a number or tensor as a tensor, with its graph."""
    return bound if isinstance(bound, Tensor) else torch.tensor(bound, dtype=torch.float64)


def check_order(lower: Tensor, upper: Tensor) -> None:
    """Raise ValueError unless lower <= upper and a finite point lies between; bounds under `vmap` are not checked."""
    try:
        broadcast_shapes(lower.shape, upper.shape)
    except ValueError as error:
        came = f"{tuple(lower.shape)} and {tuple(upper.shape)}"
        raise ValueError(f"`lower` and `upper` must have shapes that broadcast, got {came}.") from error
    if is_mapped(lower) or is_mapped(upper):
        return
    lower, upper = (bound.detach().double().cpu() for bound in (lower, upper))
    if not bool((lower <= upper).all()):
        raise ValueError("`lower` must be at most `upper` in every component, got crossed or NaN bounds.")
    if bool((lower == math.inf).any()) or bool((upper == -math.inf).any()):
        raise ValueError("`lower` must be below +infinity and `upper` above -infinity.")
