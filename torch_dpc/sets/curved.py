"""The Euclidean ball and the second-order cone."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..autodiff import is_mapped
from ..reprs import shown
from .base import ConvexSet
from .parameters import as_bound, as_tensor


class Ball(ConvexSet):
    """The Euclidean ball |x - center| <= radius.

    Args:
        radius: not negative: a number, `(horizon,)` for each step, or `(*batch, horizon)`.
        center: a number, `(n,)` or `(horizon, n)`; zero by default.
        per: whether each step or the whole trajectory lies in the ball.

    Example:
        >>> Ball(1.0).project(torch.tensor([3.0, 4.0]))
        tensor([0.6000, 0.8000])
    """

    def __init__(self, radius: Any, center: Any = 0.0, *, per: str = "step"):
        super().__init__(per)
        self.radius = as_bound("radius", radius)
        self.center = as_bound("center", center)
        self.check_values()

    def check_values(self) -> None:
        if is_mapped(self.radius) or is_mapped(self.center):
            return
        value = as_tensor(self.radius).detach()
        if not bool((value >= 0).all()) or not bool(torch.isfinite(value).all()):
            raise ValueError("`radius` must be finite and not negative.")
        if not bool(torch.isfinite(as_tensor(self.center).detach()).all()):
            raise ValueError("`center` must be finite in every channel.")

    def _polar(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return center, direction, distance and radius; the direction is 0 at the center."""
        center = as_tensor(self.center).to(x)
        if self.per == "trajectory":
            center = center.flatten(-2) if center.ndim > 1 else center
            if center.ndim == 1 and x.shape[-1] % len(center) == 0:
                center = center.repeat(x.shape[-1] // len(center))  # one step's, for all
        away = x - center
        # Twice `where`: at the center the norm has no derivative, and NaN must not leak into that of the others.
        at_center = (away == 0).all(-1, keepdim=True)
        distance = torch.linalg.vector_norm(torch.where(at_center, 1.0, away), dim=-1, keepdim=True)
        direction = torch.where(at_center, 0.0, away / distance)
        return center, direction, torch.where(at_center, 0.0, distance), as_tensor(self.radius).to(x)[..., None]

    def center_and_radius(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return both for groups of rows shaped like `(groups, size)`: `(*batch, groups, size)`, `(*batch, groups)`."""
        center, _, _, radius = (part.detach() for part in self._polar(like))
        batch = radius.shape[:-2] if radius.ndim > 2 else ()
        center = center.expand(*(center.shape[:-2] if center.ndim > 2 else ()), *like.shape)
        return center, radius[..., 0].expand(*batch, len(like))

    def project(self, x: Tensor) -> Tensor:
        center, direction, distance, radius = self._polar(x)
        return torch.where(distance > radius, center + radius * direction, x)

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        _, direction, distance, radius = self._polar(x)
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        outside = ((distance > radius) | (radius == 0))[..., None]
        shrink = (radius / torch.where(distance > radius, distance, 1.0))[..., None]
        return torch.where(outside, shrink * (eye - direction[..., :, None] * direction[..., None, :]), eye)

    def minimize_linear(self, c: Tensor) -> Tensor:
        center, _, _, radius = self._polar(c)
        norm = torch.linalg.vector_norm(c, dim=-1, keepdim=True)
        return center - radius * torch.where(norm > 0, c / torch.where(norm > 0, norm, 1.0), 0.0)

    def slack(self, x: Tensor) -> Tensor:
        _, _, distance, radius = self._polar(x)
        return radius - distance

    def conjugate(self, lam: Tensor, v: Tensor) -> Tensor:
        center, _, _, radius = self._polar(v)
        free = (lam == 0).all(-1, keepdim=True)  # the norm has no derivative there
        norm = torch.linalg.vector_norm(torch.where(free, 1.0, lam), dim=-1, keepdim=True)
        return (lam * center).sum(-1) + (radius * torch.where(free, 0.0, norm))[..., 0]

    def is_point(self, x: Tensor) -> Tensor:
        radius = self._polar(x)[-1]
        return (radius == 0).expand_as(x[..., :1])

    def config(self) -> dict[str, Any]:
        return {"radius": self.radius, "center": self.center, "per": self.per}

    def extra_repr(self) -> str:
        """Show the ball."""
        return f"radius={shown(self.radius)}, center={shown(self.center)}, per={self.per!r}"


class SecondOrderCone(ConvexSet):
    """The cone |(x_1, ..., x_(n-1))| <= x_0: the first channel bounds the others.

    Args:
        per: whether each step or the whole trajectory lies in the cone.

    Example:
        >>> SecondOrderCone().project(torch.tensor([0.0, 3.0, 4.0]))
        tensor([2.5000, 1.5000, 2.0000])
    """

    def __init__(self, *, per: str = "step"):
        super().__init__(per)

    def _polar(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return x_0, the norm of the rest and its direction, which is 0 where the rest is."""
        head, rest = x[..., :1], x[..., 1:]
        at_axis = (rest == 0).all(-1, keepdim=True)
        norm = torch.linalg.vector_norm(torch.where(at_axis, 1.0, rest), dim=-1, keepdim=True)
        return head, torch.where(at_axis, 0.0, norm), torch.where(at_axis, 0.0, rest / norm)

    def project(self, x: Tensor) -> Tensor:
        head, norm, direction = self._polar(x)
        half = (head + norm) / 2
        between = torch.cat([half, half * direction], dim=-1)
        return torch.where(norm <= head, x, torch.where(norm <= -head, torch.zeros_like(x), between))

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        head, norm, direction = (part[..., None] for part in self._polar(x))
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        ratio = head / torch.where(norm > 0, norm, 1.0)
        rest = (1 + ratio) * eye[1:, 1:] - ratio * (direction @ direction.mT)
        top = torch.cat([torch.ones_like(head), direction.mT], dim=-1)
        between = torch.cat([top, torch.cat([direction, rest], dim=-1)], dim=-2) / 2
        return torch.where(norm <= head, eye, torch.where(norm <= -head, torch.zeros_like(eye), between))

    def minimize_linear(self, c: Tensor) -> Tensor:
        head, norm, direction = self._polar(c)
        ray = torch.cat([torch.ones_like(head), -direction], dim=-1)
        far = torch.where(ray == 0, 0.0, ray * math.inf)
        return torch.where(norm <= head, torch.zeros_like(c), far)

    def support(self, d: Tensor) -> Tensor:
        head, norm, _ = self._polar(d)
        return torch.where(norm <= -head, torch.zeros_like(norm), math.inf)[..., 0]

    def bounded_direction(self, d: Tensor) -> Tensor:
        return -self.project(-d)  # the polar cone

    def slack(self, x: Tensor) -> Tensor:
        head, norm, _ = self._polar(x)
        return head - norm

    def config(self) -> dict[str, Any]:
        return {"per": self.per}
