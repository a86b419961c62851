"""Have the values changed that a result was computed from?

Objects are compared by identity and the numbers of tensors with a copy, byte by byte: version counters would miss edits
through `.data`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .solve.window_kernels import holds


class _Numbers(NamedTuple):
    """A tensor on the CPU and a copy of its numbers."""

    tensor: Tensor
    shape: torch.Size
    dtype: torch.dtype
    copy: Any

    def are_same(self) -> bool:
        """Return whether the tensor still has them."""
        tensor = self.tensor
        if tensor.shape != self.shape or tensor.dtype is not self.dtype or not tensor.is_contiguous():
            return False
        return holds(tensor.data_ptr(), self.copy)


class Watch:
    """What some attributes are, to compare with what they are later.

    Args:
        places: dictionaries of objects and the names in them.
        constants: tensors that never change but may carry a derivative.

    Raises:
        ValueError: a tensor is not a contiguous one on the CPU.
    """

    def __init__(self, places: Iterable[tuple[Mapping[str, Any], str]], constants: Iterable[Tensor] = ()):
        self._objects = [(holder, name, holder[name]) for holder, name in places]
        tensors = [value for _, _, value in self._objects if isinstance(value, Tensor)]
        if not all(x.device.type == "cpu" and x.is_contiguous() for x in tensors):
            raise ValueError("only contiguous tensors on the CPU can be watched.")
        self._numbers = [_Numbers(x, x.shape, x.dtype, x.detach().clone().numpy()) for x in tensors]
        self._tensors = [*tensors, *constants]

    def is_unchanged(self) -> bool:
        """Return whether every attribute is the same object with the same numbers."""
        for holder, name, value in self._objects:
            if holder.get(name, self) is not value:
                return False
        return all(numbers.are_same() for numbers in self._numbers)

    def requires_grad(self) -> bool:
        """Return whether autograd would record an operation on one of the tensors."""
        return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in self._tensors)
