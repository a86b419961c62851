"""Validation of recordings: u and y as lists of matching tensors, and their windows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, check_count


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
    depth = check_count("depth", depth)
    w = as_data("w", w, finite=False)
    if w.ndim != 2 or depth > len(w):
        raise ValueError(f"`w` must have shape (T, n) with T at least depth = {depth}, got {tuple(w.shape)}.")
    windows = w.unfold(0, depth, 1)  # (T - depth + 1, n, depth)
    return windows.permute(2, 1, 0).reshape(depth * w.shape[1], -1)


def as_recordings(u: Any, y: Any) -> tuple[list[Tensor], list[Tensor]]:
    """Return one recording, or a list of them, as two lists of matching tensors `(T, n)` of one dtype.

    Raises:
        ValueError: shapes that do not fit, or samples that are not finite.
    """
    u_list, y_list = _listed("u", u), _listed("y", y)
    if len(u_list) != len(y_list):
        raise ValueError(f"`u` and `y` must hold as many recordings, got {len(u_list)} and {len(y_list)}.")
    for i, (a, b) in enumerate(zip(u_list, y_list, strict=True)):
        if a.shape[0] != b.shape[0]:
            raise ValueError(f"recording {i}: `u` and `y` must be as long, got {a.shape[0]} and {b.shape[0]} samples.")
        if a.shape[1] != u_list[0].shape[1] or b.shape[1] != y_list[0].shape[1]:
            raise ValueError(
                f"recording {i} has other channels than recording 0: `u` and `y` must have the same in each, got "
                f"{a.shape[1]} and {b.shape[1]} after {u_list[0].shape[1]} and {y_list[0].shape[1]}."
            )
    common = torch.promote_types(u_list[0].dtype, y_list[0].dtype)
    return [a.to(common) for a in u_list], [b.to(common) for b in y_list]


def _listed(name: str, value: Any) -> list[Tensor]:
    if isinstance(value, (str, bytes)):
        raise ValueError(f"`{name}` must have shape (T, n), time first, or be a list of such, got {value!r}.")
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


def _depth(value: Any) -> int:
    """Return how deep a nested list is."""
    return 1 + _depth(value[0]) if isinstance(value, Sequence) and len(value) > 0 else 0
