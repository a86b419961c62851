"""Convex sets for inputs and outputs: the projection, its Jacobian, and linear minimisation.

A set constrains the channels of every step of the plan (`per="step"`) or the whole horizon as one vector
(`per="trajectory"`). Its methods work on the last dimension of what they are given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

#: A part of a plan that one set constrains: the set, and which entries of the plan, `(groups, size)`: one group a step,
#: or one for the whole trajectory.
Part = tuple["ConvexSet", Tensor]


class ConvexSet(nn.Module):
    """A closed convex set of the channels of one step, or of a whole trajectory.

    A set is a module, so that a bound given as `nn.Parameter` learns with the layer it constrains. Write your own by
    giving `project`, in torch operations; everything else has a definition that follows from it, or says what is
    missing.

    Args:
        per: "step", the set holds for the channels of every step, or "trajectory", for all steps as one vector,
            time-major.

    Example:
        >>> class Disc(ConvexSet):
        ...     def project(self, x):
        ...         return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp_min(1.0)
        >>> Disc().jacobian(torch.tensor([2.0, 0.0]))
        tensor([[0.0000, 0.0000],
                [0.0000, 0.5000]])
    """

    #: Whether the projection acts on every entry alone, so that its Jacobian is diagonal.
    separable = False

    def __init__(self, per: str = "step"):
        super().__init__()
        if per not in ("step", "trajectory"):
            raise ValueError(f'`per` must be "step" or "trajectory", got {per!r}.')
        self.per = per

    def project(self, x: Tensor) -> Tensor:
        """Return the Euclidean projection of x, `(..., n)`."""
        raise NotImplementedError(f"{type(self).__name__} must define `project`.")

    def prox(self, x: Tensor, gamma: Any) -> Tensor:
        """Return the proximal map of the set's indicator, its projection; a penalty in place of a set has another.

        gamma is a number, or a tensor `(..., 1)`.
        """
        return self.project(x)

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        """Return D1, the Jacobian of the projection (of `prox`) at x, `(..., n, n)`; it is symmetric."""
        value, product, *_ = torch.func.vjp(lambda x: self.prox(x, gamma), x)
        rows = []
        for i in range(x.shape[-1]):
            unit = torch.zeros_like(value)
            unit[..., i] = 1.0
            rows.append(product(unit)[0])
        D1 = torch.stack(rows, dim=-2)
        return (D1 + D1.mT) / 2

    def jacobian_diagonal(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        """Return the diagonal of D1, `(..., n)`, which is all of it where the set is `separable`."""
        return self.jacobian(x, gamma).diagonal(dim1=-2, dim2=-1)

    def jacobian_product(self, x: Tensor, v: Tensor) -> Tensor:
        """Return D1 v, D1 the Jacobian of the projection at x; both `(..., n)`."""
        return (self.jacobian(x) @ v[..., None])[..., 0]

    def minimize_linear(self, c: Tensor) -> Tensor:
        """Return argmin over the set of <c, x>, for c `(..., n)`; infinite entries where there is no minimum."""
        raise NotImplementedError(f"{type(self).__name__} does not define `minimize_linear`.")

    def support(self, d: Tensor) -> Tensor:
        """Return the supremum over the set of <d, x>, for d `(..., n)`; it may be infinite."""
        best = self.minimize_linear(-d)
        return torch.where(d == 0, 0.0, d * best).sum(-1)

    def bounded_direction(self, d: Tensor) -> Tensor:
        """Return a direction near d, `(..., n)`, in which the set is bounded; d itself where every direction is."""
        return d

    def slack(self, x: Tensor) -> Tensor:
        """Return how far x in the set is from each of its bounds, `(..., k)`; infinite where that is not known."""
        return torch.full_like(x[..., :1], math.inf)

    def parts(self, steps: int, channels: int) -> list[Part]:
        """Return the set with the entries of a plan `(steps, channels)`, flattened time-major, that it holds for."""
        places = torch.arange(steps * channels)
        return [(self, places.reshape((1, -1) if self.per == "trajectory" else (steps, channels)))]

    def check(self, name: str, steps: int, channels: int) -> None:
        """Raise ValueError where the set does not fit a plan `(steps, channels)`.

        Args:
            name: of the set, for messages.
            steps, channels: of the plan.
        """
        for owner, places in self.parts(steps, channels):
            x = torch.zeros(places.shape, dtype=torch.float64)
            try:
                shape = owner.project(x).shape
            except (RuntimeError, ValueError) as error:
                raise ValueError(f"`{name}` does not fit {channels} channels over {steps} steps: {error}") from error
            if shape[-2:] != x.shape:
                raise ValueError(
                    f"`{name}` does not fit {channels} channels over {steps} steps: it projects {tuple(x.shape)} to "
                    f"{tuple(shape)}."
                )

    def config(self) -> dict[str, Any]:
        """Return the arguments that make this set again; tensors are given as they are."""
        raise NotImplementedError(f"{type(self).__name__} does not define `config`, so it cannot be saved.")


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
        self.lower = _as_bound("lower", lower)
        self.upper = _as_bound("upper", upper)
        self.check_bounds()

    def bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return lower and upper as tensors of the dtype and on the device of another; graphs are kept."""
        lower, upper = (_as_tensor(bound).to(like) for bound in (self.lower, self.upper))
        if self.per == "trajectory":
            lower, upper = (bound.flatten(-2) if bound.ndim > 1 else bound for bound in (lower, upper))
        return lower, upper

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

    def check_bounds(self) -> None:
        """Raise ValueError unless lower <= upper and a finite point lies between."""
        lower, upper = (_as_tensor(bound).detach().double().cpu() for bound in (self.lower, self.upper))
        if not bool((lower <= upper).all()):
            raise ValueError("`lower` must be at most `upper` in every component, got crossed or NaN bounds.")
        if bool((lower == math.inf).any()) or bool((upper == -math.inf).any()):
            raise ValueError("`lower` must be below +infinity and `upper` above -infinity.")

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

    def slack(self, x: Tensor) -> Tensor:
        lower, upper = self.bounds(x)
        return torch.minimum(x - lower, upper - x)

    def config(self) -> dict[str, Any]:
        return {"lower": self.lower, "upper": self.upper, "per": self.per}

    def extra_repr(self) -> str:
        """Show the bounds."""
        return f"lower={_short(self.lower)}, upper={_short(self.upper)}"


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
        self.weight = _as_bound("weight", weight)
        if not bool((_as_tensor(self.weight).detach() > 0).all()):
            raise ValueError("`weight` must be positive: without a price there is no bound.")

    def project(self, x: Tensor) -> Tensor:
        return self.box.project(x)

    def prox(self, x: Tensor, gamma: Any) -> Tensor:
        pull = x - self.box.project(x)
        most = gamma * _as_tensor(self.weight).to(x)
        return x - torch.minimum(torch.maximum(pull, -most), most)

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        return torch.diag_embed(self.jacobian_diagonal(x, gamma))

    def jacobian_diagonal(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        pull = (x - self.box.project(x)).abs()
        held = (pull > 0) & (pull <= gamma * _as_tensor(self.weight).to(x))
        return (~held).to(x)

    def minimize_linear(self, c: Tensor) -> Tensor:
        return self.box.minimize_linear(c)

    def support(self, d: Tensor) -> Tensor:
        return torch.where(d == 0, torch.zeros_like(d), math.inf).sum(-1)  # no point is out of the question

    def bounded_direction(self, d: Tensor) -> Tensor:
        return torch.zeros_like(d)

    def slack(self, x: Tensor) -> Tensor:
        return self.box.slack(x).abs()

    def config(self) -> dict[str, Any]:
        return {"lower": self.box.lower, "upper": self.box.upper, "weight": self.weight}

    def extra_repr(self) -> str:
        """Show the price."""
        return f"weight={_short(self.weight)}"


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
        self.radius = _as_bound("radius", radius)
        self.center = _as_bound("center", center)
        value = _as_tensor(self.radius).detach()
        if not bool((value >= 0).all()) or not bool(torch.isfinite(value).all()):
            raise ValueError("`radius` must be finite and not negative.")
        if not bool(torch.isfinite(_as_tensor(self.center).detach()).all()):
            raise ValueError("`center` must be finite.")

    def _polar(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return center, direction, distance and radius; the direction is 0 at the center."""
        center = _as_tensor(self.center).to(x)
        if self.per == "trajectory":
            center = center.flatten(-2) if center.ndim > 1 else center
            if center.ndim == 1 and x.shape[-1] % len(center) == 0:
                center = center.repeat(x.shape[-1] // len(center))  # one step's, for all
        away = x - center
        # Twice `where`: at the center the norm has no derivative, and NaN must not leak into that of the others.
        at_center = (away == 0).all(-1, keepdim=True)
        distance = torch.linalg.vector_norm(torch.where(at_center, 1.0, away), dim=-1, keepdim=True)
        direction = torch.where(at_center, 0.0, away / distance)
        return center, direction, torch.where(at_center, 0.0, distance), _as_tensor(self.radius).to(x)[..., None]

    def project(self, x: Tensor) -> Tensor:
        center, direction, distance, radius = self._polar(x)
        return torch.where(distance > radius, center + radius * direction, x)

    def jacobian(self, x: Tensor, gamma: Any = 1.0) -> Tensor:
        _, direction, distance, radius = self._polar(x)
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        outside = (distance > radius)[..., None]
        shrink = (radius / torch.where(distance > radius, distance, 1.0))[..., None]
        return torch.where(outside, shrink * (eye - direction[..., :, None] * direction[..., None, :]), eye)

    def minimize_linear(self, c: Tensor) -> Tensor:
        center, _, _, radius = self._polar(c)
        norm = torch.linalg.vector_norm(c, dim=-1, keepdim=True)
        return center - radius * torch.where(norm > 0, c / torch.where(norm > 0, norm, 1.0), 0.0)

    def slack(self, x: Tensor) -> Tensor:
        _, _, distance, radius = self._polar(x)
        return radius - distance

    def config(self) -> dict[str, Any]:
        return {"radius": self.radius, "center": self.center, "per": self.per}

    def extra_repr(self) -> str:
        """Show the radius."""
        return f"radius={_short(self.radius)}, per={self.per!r}"


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


class Product(ConvexSet):
    """The product of sets over groups of channels.

    Args:
        factors: pairs of a set and its channels, a number or a list of them; every channel once.

    Example:
        >>> Product([(Ball(1.0), [0, 1]), (NonNegative(), 2)]).project(torch.tensor([3.0, 4.0, -1.0]))
        tensor([0.6000, 0.8000, 0.0000])
    """

    def __init__(self, factors: Sequence[tuple[ConvexSet, int | Sequence[int]]]):
        pairs = [(owner, [channels] if isinstance(channels, int) else list(channels)) for owner, channels in factors]
        named = [channel for _, channels in pairs for channel in channels]
        if sorted(named) != list(range(len(named))) or not named:
            raise ValueError(f"`factors` must name every channel from 0 on once, got {sorted(named)}.")
        if not all(isinstance(owner, ConvexSet) for owner, _ in pairs):
            raise ValueError("`factors` must be pairs of a ConvexSet and its channels.")
        whole = any(owner.per == "trajectory" for owner, _ in pairs)
        super().__init__("trajectory" if whole else "step")
        self.factors = nn.ModuleList(owner for owner, _ in pairs)
        self.channels = [channels for _, channels in pairs]
        self.n = len(named)

    def parts(self, steps: int, channels: int) -> list[Part]:
        if channels != self.n:
            raise ValueError(f"the product has {self.n} channels, the plan {channels}.")
        places = torch.arange(steps * channels).reshape(steps, channels)
        found: list[Part] = []
        for owner, own in self._pairs():
            of_own = places[:, own].reshape(-1)
            found += [(leaf, of_own[inner]) for leaf, inner in owner.parts(steps, len(own))]
        return found

    def _pairs(self) -> list[Part]:
        return [(cast(ConvexSet, s), torch.tensor(own)) for s, own in zip(self.factors, self.channels, strict=True)]

    def _each(self, method: str, *xs: Tensor) -> Tensor:
        """Apply a method of every factor to its entries of xs, and put the results together."""
        steps = xs[0].shape[-1] // self.n
        pairs = self._pairs() if self.per == "step" else self.parts(steps, self.n)
        out = torch.zeros_like(xs[0])
        for owner, places in pairs:
            out[..., places] = getattr(owner, method)(*(x[..., places] for x in xs))
        return out

    def project(self, x: Tensor) -> Tensor:
        return self._each("project", x)

    def jacobian_product(self, x: Tensor, v: Tensor) -> Tensor:
        return self._each("jacobian_product", x, v)

    def minimize_linear(self, c: Tensor) -> Tensor:
        return self._each("minimize_linear", c)

    def config(self) -> dict[str, Any]:
        return {"factors": list(zip(self.factors, self.channels, strict=True))}


def _as_bound(name: str, value: Any) -> Tensor | float:
    """Keep a floating tensor as it is; anything else becomes a float or a float64 tensor."""
    if isinstance(value, Tensor):
        if not value.is_floating_point():
            raise ValueError(f"`{name}` must hold floating-point numbers, got {value.dtype}.")
        return value
    try:
        tensor = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`{name}` must be a number or an array of numbers, got {value!r}.") from error
    return tensor.item() if tensor.ndim == 0 else tensor


def _as_tensor(bound: Tensor | float) -> Tensor:
    return bound if isinstance(bound, Tensor) else torch.tensor(bound, dtype=torch.float64)


def _short(bound: Tensor | float) -> str:
    return f"tensor{tuple(bound.shape)}" if isinstance(bound, Tensor) else f"{bound:g}"
