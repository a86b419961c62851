"""Budgets with a size of their own for every channel or entry: the box and the ellipsoid."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...checks import check_flag
from .base import Budget, NormBound, direction, euclidean, nonnegative, norm_bound, ratio


class BoxBudget(Budget):
    """|p_ti| <= radius for every entry: the maximum norm.

    Args:
        radius: a number, or one a channel, `(n_y,)`, or one an entry, `(t_ini, n_y)`, in the units of the outputs.
        relative: |p_ti| <= radius max |y_ini| instead, the maximum over the entries that share the radius: all of them,
            or those of the channel, or the entry itself.
    """

    def __init__(self, radius: Any, *, relative: bool = False):
        self.radius = _sizes("radius", radius)
        self.relative = check_flag("relative", relative)

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return -self._reach(y_ini) * c.sign()

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        reach = self._reach(y_ini)
        return torch.minimum(torch.maximum(p, -reach), reach)

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return ratio(p.abs(), self._reach(y_ini)).amax((-2, -1)) - 1

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        reach = self._reach(y_ini.double()).expand(y_ini.shape).flatten().tolist()
        rows = np.eye(len(reach))
        return [NormBound(rows[i : i + 1], np.zeros(1), radius) for i, radius in enumerate(reach)]

    def _reach(self, y_ini: Tensor) -> Tensor:
        radius = _fitting("radius", self.radius, y_ini)
        if not self.relative:
            return radius
        dims = _shared(radius)
        return radius * (y_ini.abs().amax(dims, keepdim=True) if dims else y_ini.abs())


class EllipsoidBudget(Budget):
    """sum (p_ti / scale_ti)^2 <= 1: the scale is the reach along each axis; an axis with scale 0 cannot be touched.

    Args:
        scale: a number, or one a channel, `(n_y,)`, or one an entry, `(t_ini, n_y)`, in the units of the outputs.
        relative: scale |y_ini| in place of scale, the Euclidean norm over the entries that share the scale: all of
            them, or those of the channel, or the entry itself.
    """

    def __init__(self, scale: Any, *, relative: bool = False):
        self.scale = _sizes("scale", scale)
        self.relative = check_flag("relative", relative)

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        scale = self._reach(y_ini)
        return -scale * direction(scale * c)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        # p_i scale_i^2 / (scale_i^2 + mu), mu >= 0 the root of a decreasing function of one variable
        square = self._reach(y_ini).square().expand_as(p)
        low = torch.zeros_like(euclidean(p))
        reached = torch.where(square > 0, p, 0.0)
        largest = square.amax((-2, -1), keepdim=True)
        high = euclidean(p) * largest.sqrt() + largest
        for _ in range(200):  # bisection to the last bit
            middle = (low + high) / 2
            inside = euclidean(reached * square.sqrt() / (square + middle).clamp_min(torch.finfo(p.dtype).tiny)) <= 1
            low, high = torch.where(inside, low, middle), torch.where(inside, middle, high)
        outside = euclidean(torch.where(square > 0, reached / square.sqrt(), 0.0)) > 1
        return torch.where(outside, reached * square / (square + high), reached)

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return euclidean(ratio(p.abs(), self._reach(y_ini)))[..., 0, 0] - 1

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        return norm_bound(self._reach(y_ini.double()).expand(y_ini.shape))

    def _reach(self, y_ini: Tensor) -> Tensor:
        scale = _fitting("scale", self.scale, y_ini)
        if not self.relative:
            return scale
        dims = _shared(scale)
        return scale * (torch.linalg.vector_norm(y_ini, dim=dims, keepdim=True) if dims else y_ini.abs())


def _shared(size: Tensor) -> tuple[int, ...]:
    """Return the dimensions of a window whose entries share one size."""
    return ((-2, -1), (-2,), ())[size.ndim]


def _fitting(name: str, size: Tensor, y_ini: Tensor) -> Tensor:
    """Return sizes in the precision of a window, whose steps and channels they must fit."""
    wanted = y_ini.shape[y_ini.ndim - size.ndim :]
    if any(n not in (1, m) for n, m in zip(size.shape, wanted, strict=True)):
        came = f"{tuple(size.shape)} for windows of {tuple(y_ini.shape[-2:])}"
        raise ValueError(f"`{name}` must broadcast to (t_ini, n_y), got {came}.")
    return size.to(y_ini)


def _sizes(name: str, value: Any) -> Tensor:
    sizes = nonnegative(name, value)
    if sizes.ndim > 2:
        raise ValueError(f"`{name}` must be a number or have shape (n_y,) or (t_ini, n_y), got {tuple(sizes.shape)}.")
    return sizes
