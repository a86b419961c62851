"""What an attacker may add to the measured window: the admissible sets of p.

Every budget works on windows `(*batch, t_ini, n_y)` and takes the window itself as the second argument, because some
are relative to it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class Budget:
    """An admissible set of perturbations p, convex and containing zero."""

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        """Return argmin over the set of <c, p>, and 0 where c = 0; all `(*batch, t_ini, n_y)`."""
        raise NotImplementedError

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        """Return the nearest admissible perturbation."""
        raise NotImplementedError

    def random(self, y_ini: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return a random perturbation that spends the whole budget."""
        v = torch.randn(y_ini.shape, dtype=y_ini.dtype, device=y_ini.device, generator=generator)
        return self.minimize_linear(-v, y_ini)

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        """Return how far p is outside the set, relative to its size, `(*batch,)`; zero or less when admissible."""
        outside = _norm(p - self.project(p, y_ini)).flatten(-2)[..., 0]
        return outside / _norm(p).flatten(-2)[..., 0].clamp_min(torch.finfo(p.dtype).tiny)


class Ball(Budget):
    """|p| <= radius, Euclidean over the whole window, in the units of the outputs.

    Example:
        >>> Ball(2.0).minimize_linear(torch.tensor([[3.0], [4.0]]), torch.zeros(2, 1))
        tensor([[-1.2000], [-1.6000]])
    """

    def __init__(self, radius: Any):
        self.radius = _nonnegative("radius", radius)

    def _radius(self, y_ini: Tensor) -> Tensor:
        return self.radius.to(y_ini).reshape(*self.radius.shape, 1, 1)

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return -self._radius(y_ini) * _direction(c)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        size = _norm(p)
        return p * torch.where(size > 0, self._radius(y_ini) / size, 1.0).clamp_max(1.0)


class RelativeBall(Ball):
    """|p| <= rho |y_ini|, the paper's budget. At y_ini = 0 it is {0}."""

    def __init__(self, rho: Any):
        self.rho = _nonnegative("rho", rho)
        super().__init__(self.rho)

    def _radius(self, y_ini: Tensor) -> Tensor:
        return super()._radius(y_ini) * _norm(y_ini)


class Box(Budget):
    """|p_ti| <= radius for every entry: a number, or `(n_y,)`, or `(t_ini, n_y)`, in the units of the outputs."""

    def __init__(self, radius: Any):
        self.radius = _nonnegative("radius", radius)

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return -self.radius.to(y_ini) * c.sign()

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(p, -self.radius.to(p)), self.radius.to(p))


class Ellipsoid(Budget):
    """sum (p_ti / scale_ti)^2 <= 1: the scale is the reach along each axis, `(n_y,)` or `(t_ini, n_y)`.

    A channel with scale 0 cannot be touched.
    """

    def __init__(self, scale: Any):
        self.scale = _nonnegative("scale", scale)

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        scale = self.scale.to(y_ini)
        return -scale * _direction(scale * c)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        # p_i scale_i^2 / (scale_i^2 + mu), mu >= 0 the root of a decreasing function of one variable
        square = self.scale.to(p).square().expand_as(p)
        low = torch.zeros_like(_norm(p))
        reached = torch.where(square > 0, p, 0.0)
        high = _norm(p) * square.amax() ** 0.5 + square.amax()
        for _ in range(200):  # bisection to the last bit
            middle = (low + high) / 2
            inside = _norm(reached * square.sqrt() / (square + middle)) <= 1
            low, high = torch.where(inside, low, middle), torch.where(inside, middle, high)
        outside = _norm(torch.where(square > 0, reached / square.sqrt(), 0.0)) > 1
        return torch.where(outside, reached * square / (square + high), reached)


def _norm(p: Tensor) -> Tensor:
    """Euclidean norm of each window, `(*batch, 1, 1)`."""
    return torch.linalg.vector_norm(p, dim=(-2, -1), keepdim=True)


def _direction(c: Tensor) -> Tensor:
    """Return c / |c|, and 0 where c = 0."""
    size = _norm(c)
    return torch.where(size > 0, c / torch.where(size > 0, size, 1.0), 0.0)


def _nonnegative(name: str, value: Any) -> Tensor:
    tensor = torch.as_tensor(value, dtype=torch.float64) if not isinstance(value, Tensor) else value.double()
    if not bool((tensor >= 0).all()) or not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"`{name}` must be finite and not negative, got {value!r}.")
    return tensor
