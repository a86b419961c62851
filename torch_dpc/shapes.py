"""Broadcasting of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """Return the shape that all broadcast to.

    `torch.broadcast_shapes` does the same, but imports sympy at its first call, which takes about a second.

    Raises:
        ValueError: they do not broadcast.

    Example:
        >>> broadcast_shapes((3, 1), (4,), ())
        torch.Size([3, 4])
    """
    result = []
    for sizes in zip_longest(*(shape[::-1] for shape in shapes), fillvalue=1):
        different = {size for size in sizes if size != 1}
        if len(different) > 1:
            came = ", ".join(str(tuple(shape)) for shape in shapes)
            raise ValueError(f"the shapes must broadcast, got {came}.")
        result.append(different.pop() if different else 1)
    return torch.Size(result[::-1])
