"""Boxes, hard and soft."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..autodiff import is_mapped
from ..reprs import shown
from .base import ConvexSet
from .parameters import as_bound, as_tensor, check_order


class Box(ConvexSet):
    """The box lower <= x <= upper.

    Args:
        lower, upper: numbers, or `(n,)` for each channel, or `(horizon, n)` for each step of the plan, or
            `(*batch, horizon, n)` for each sample of a call; infinite ends are allowed. A tensor keeps its graph, an
            `nn.Parameter` learns.
        per: a box is the same for a step and for a trajectory, but takes `(horizon n,)` bounds for the latter.

    Raises:
        ValueError: bounds that are NaN, crossed, or closed at an infinity.

    Example:
        >>> Box(-1.0, 1.0).project(torch.tensor([0.5, 3.0]))
        tensor([0.5000, 1.0000])
    """

    separable = True

    def __init__(self, lower: Any, upper: Any, *, per: str = "step"):
        super().__init__(per)
        self.lower = as_bound("lower", lower)
        self.upper = as_bound("upper", upper)
        self.check_values()

    def bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return lower and upper as tensors of the dtype and on the device of another; graphs are kept."""
        lower, upper = (as_tensor(bound).to(like) for bound in (self.lower, self.upper))
        if self.per == "trajectory":
            lower, upper = (bound.flatten(-2) if bound.ndim > 1 else bound for bound in (lower, upper))
        return lower, upper

    def interval(self, places: Tensor, dtype: torch.dtype) -> tuple[tuple[Tensor, Tensor], None]:
        """Return lower and upper of rows `(groups, size)`, `(*batch, groups, size)` each, without a graph; no price."""
        like = torch.empty(0, dtype=dtype, device=places.device)
        lower, upper = (
            bound.detach().expand(*bound.shape[:-2], *places.shape)
            if bound.ndim > 1
            else bound.detach().expand(places.shape)
            for bound in self.bounds(like)
        )
        return (lower, upper), None

    def check(self, name: str, steps: int, channels: int) -> None:
        places = self.parts(steps, channels)[0][1]
        for bound in (self.lower, self.upper):
            shape = bound.shape if isinstance(bound, Tensor) else ()
            if self.per == "trajectory" and len(shape) > 1:
                shape = (*shape[:-2], shape[-2] * shape[-1])
            own = places.shape[-len(shape) :] if len(shape) < 2 else places.shape
            if len(shape) and any(a not in (1, b) for a, b in zip(shape[-2:], own, strict=True)):
                raise ValueError(
                    f"the bounds of `{name}` must be numbers or have shape ({channels},), ({steps}, {channels}) or "
                    f"(*batch, {steps}, {channels}), got {tuple(bound.shape)}."  # type: ignore[union-attr]
                )

    def is_point(self, x: Tensor) -> Tensor:
        lower, upper = self.bounds(x)
        return (lower == upper).expand_as(x)

    def check_values(self) -> None:
        """Raise ValueError unless lower <= upper with a finite point between; the solve checks vmapped bounds."""
        check_order(as_tensor(self.lower), as_tensor(self.upper))

    def project(self, x: Tensor) -> Tensor:
        lower, upper = self.bounds(x)
        return torch.maximum(torch.minimum(x, upper), lower)

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        return torch.diag_embed(self.jacobian_diagonal(x, gamma))

    def jacobian_diagonal(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        lower, upper = self.bounds(x)
        return ((x >= lower) & (x <= upper) & (lower < upper)).to(x)

    def jacobian_product(self, x: Tensor, v: Tensor) -> Tensor:
        return self.jacobian_diagonal(x) * v

    def bounded_direction(self, d: Tensor) -> Tensor:
        lower, upper = self.bounds(d)
        return torch.where(torch.where(d > 0, upper, lower).isfinite(), d, 0.0)

    def minimize_linear(self, c: Tensor) -> Tensor:
        lower, upper = self.bounds(c)
        anywhere = torch.minimum(torch.maximum(torch.zeros_like(c), lower), upper)  # where c = 0 any point will do
        return torch.where(c > 0, lower.expand_as(c), torch.where(c < 0, upper.expand_as(c), anywhere))

    def conjugate(self, lam: Tensor, v: Tensor) -> Tensor:
        lower, upper = self.bounds(lam)
        return (lam * torch.where(lam < 0, lower, torch.where(lam > 0, upper, 0.0))).sum(-1)

    def slack(self, x: Tensor) -> Tensor:
        lower, upper = self.bounds(x)
        return torch.minimum(x - lower, upper - x)

    def config(self) -> dict[str, Any]:
        return {"lower": self.lower, "upper": self.upper, "per": self.per}

    def extra_repr(self) -> str:
        """Show the bounds."""
        return f"lower={shown(self.lower)}, upper={shown(self.upper)}"


class Reals(Box):
    """No constraint."""

    def __init__(self) -> None:
        super().__init__(-math.inf, math.inf)

    def config(self) -> dict[str, Any]:
        return {}

    def extra_repr(self) -> str:
        """Show nothing: there are no bounds."""
        return ""


class NonNegative(Box):
    """The non-negative orthant x >= 0.

    Example:
        >>> NonNegative().project(torch.tensor([-0.5, 3.0]))
        tensor([0., 3.])
    """

    def __init__(self) -> None:
        super().__init__(0.0, math.inf)

    def config(self) -> dict[str, Any]:
        return {}

    def extra_repr(self) -> str:
        """Show nothing: there are no bounds to choose."""
        return ""


class SoftBox(ConvexSet):
    """A box that may be left at a price: weight times the distance to it is charged, channel by channel.

    This is the exact penalty of the box: a plan whose multipliers stay below `weight` in the hard box is found without
    leaving it, and where the box excludes every plan there still is one.

    Args:
        lower, upper: as for :class:`Box`.
        weight: price of one unit beyond a bound, in units of the cost; a number, `(n,)` or `(horizon, n)`. A tensor
            keeps its graph, an `nn.Parameter` learns.

    Example:
        >>> soft = SoftBox(-1.0, 1.0, weight=2.0)
        >>> soft.prox(torch.tensor([0.5, 2.5, 4.0]), gamma=1.0)       # inside, held at the bound, beyond it
        tensor([0.5000, 1.0000, 2.0000])
    """

    separable = True

    def __init__(self, lower: Any, upper: Any, weight: Any):
        super().__init__()
        self.box = Box(lower, upper)
        self.weight = as_bound("weight", weight)
        self.check_values()

    def check_values(self) -> None:
        self.box.check_values()
        # NaN is not positive either.
        if is_mapped(self.weight):
            return
        weight = as_tensor(self.weight).detach()
        if not bool((weight > 0).all()):
            raise ValueError("`weight` must be positive: without a price there is no bound.")
        if not bool(torch.isfinite(weight).all()):
            raise ValueError("`weight` must be finite: an infinite price is that of a Box.")

    def project(self, x: Tensor) -> Tensor:
        return self.box.project(x)

    def prox(self, x: Tensor, gamma: Any) -> Tensor:
        pull = x - self.box.project(x)
        most = gamma * as_tensor(self.weight).to(x)
        return x - torch.minimum(torch.maximum(pull, -most), most)

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        return torch.diag_embed(self.jacobian_diagonal(x, gamma))

    def jacobian_diagonal(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        pull = (x - self.box.project(x)).abs()
        lower, upper = self.box.bounds(x)
        held = ((pull > 0) | (lower == upper)) & (pull <= gamma * as_tensor(self.weight).to(x))
        return (~held).to(x)

    def is_point(self, x: Tensor) -> Tensor:
        return self.box.is_point(x) & (self.box.project(x) == x)  # no small multiplier moves it from there

    def interval(self, places: Tensor, dtype: torch.dtype) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Return lower, upper and price of rows `(groups, size)`, `(*batch, groups, size)` each, without a graph."""
        weight = as_tensor(self.weight).detach().to(dtype=dtype, device=places.device)
        batch = weight.shape[:-2] if weight.ndim > 2 else ()
        return self.box.interval(places, dtype)[0], weight.expand(*batch, *places.shape)

    def minimize_linear(self, c: Tensor) -> Tensor:
        return self.box.minimize_linear(c)

    def support(self, d: Tensor) -> Tensor:
        return torch.where(d == 0, torch.zeros_like(d), math.inf).sum(-1)  # no point is out of the question

    def conjugate(self, lam: Tensor, v: Tensor) -> Tensor:
        # Beyond the bound lam is the price itself: the product of price and distance cancels in <lam, v> - penalty.
        return self.box.conjugate(lam, v)

    def bounded_direction(self, d: Tensor) -> Tensor:
        return torch.zeros_like(d)

    def slack(self, x: Tensor) -> Tensor:
        return self.box.slack(x).abs()

    def config(self) -> dict[str, Any]:
        return {"lower": self.box.lower, "upper": self.box.upper, "weight": self.weight}

    def extra_repr(self) -> str:
        """Show the bounds and the price."""
        return f"{self.box.extra_repr()}, weight={shown(self.weight)}"
