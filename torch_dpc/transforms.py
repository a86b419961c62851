"""Is a derivative asked for, and is a function transform at work?"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

# Not public, but stable since torch 2.0; without it every tensor is taken to be wrapped, which is slower and right.
_is_wrapped = getattr(getattr(torch._C, "_functorch", None), "is_functorch_wrapped_tensor", lambda tensor: True)


def is_plain(tensor: Tensor) -> bool:
    """Return whether a tensor holds its own numbers: no `vmap` or `torch.func` transform has wrapped it."""
    return type(tensor) is Tensor and not _is_wrapped(tensor)


def carries_derivative(values: tuple[Any, ...]) -> bool:
    """Return whether a derivative, backward or forward, may be asked of one of the tensors among values."""
    tensors = [value for value in values if isinstance(value, Tensor)]
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return True
    return any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)
