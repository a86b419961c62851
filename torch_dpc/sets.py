"""Convex sets for the inputs and outputs: the projection, its Jacobian, and linear minimisation."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn


class ConvexSet(nn.Module):
    """A closed convex set of the channels of one step.

    A set is a module, so that a bound given as `nn.Parameter` learns with the layer it constrains. Write your own by
    giving `project`; the other two have definitions that follow from it or say what is missing.
    """

    def project(self, x: Tensor) -> Tensor:
        """Return the Euclidean projection of x, `(..., n)`."""
        raise NotImplementedError(f"{type(self).__name__} must define `project`.")

    def jacobian_product(self, x: Tensor, v: Tensor) -> Tensor:
        """Return D1 v, D1 the (symmetric) Jacobian of the projection at x; both `(..., n)`."""
        return torch.func.jvp(self.project, (x,), (v,))[1]

    def minimize_linear(self, c: Tensor) -> Tensor:
        """Return argmin over the set of <c, x>, for c `(..., n)`."""
        raise NotImplementedError(f"{type(self).__name__} does not define `minimize_linear`.")


class Box(ConvexSet):
    """The box lower <= x <= upper.

    Args:
        lower, upper: numbers, or `(n,)` for each channel, or `(horizon, n)` for each step of the plan; infinite ends
            are allowed. A tensor keeps its graph, an `nn.Parameter` learns.

    Raises:
        ValueError: bounds that are NaN, crossed, or closed at an infinity.

    Example:
        >>> Box(-1.0, 1.0).project(torch.tensor([0.5, 3.0]))
        tensor([0.5000, 1.0000])
    """

    def __init__(self, lower: Any, upper: Any):
        super().__init__()
        self.lower = _as_bound("lower", lower)
        self.upper = _as_bound("upper", upper)
        self.check()

    def bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return lower and upper as tensors of the dtype and on the device of another; graphs are kept."""
        return _as_tensor(self.lower).to(like), _as_tensor(self.upper).to(like)

    def check(self) -> None:
        """Raise ValueError unless lower <= upper and a finite point lies between."""
        lower, upper = (_as_tensor(bound).detach().double().cpu() for bound in (self.lower, self.upper))
        if not bool((lower <= upper).all()):
            raise ValueError("`lower` must be at most `upper` in every component, got crossed or NaN bounds.")
        if bool((lower == math.inf).any()) or bool((upper == -math.inf).any()):
            raise ValueError("`lower` must be below +infinity and `upper` above -infinity.")

    def project(self, x: Tensor) -> Tensor:
        lower, upper = self.bounds(x)
        return torch.maximum(torch.minimum(x, upper), lower)

    def jacobian_product(self, x: Tensor, v: Tensor) -> Tensor:
        lower, upper = self.bounds(x)
        return torch.where((x >= lower) & (x <= upper), v, 0.0)

    def minimize_linear(self, c: Tensor) -> Tensor:
        lower, upper = self.bounds(c)
        anywhere = torch.minimum(torch.maximum(torch.zeros_like(c), lower), upper)  # where c = 0 any point will do
        return torch.where(c > 0, lower.expand_as(c), torch.where(c < 0, upper.expand_as(c), anywhere))

    def extra_repr(self) -> str:
        """Show the bounds."""
        return f"lower={_short(self.lower)}, upper={_short(self.upper)}"


class Reals(Box):
    """No constraint."""

    def __init__(self) -> None:
        super().__init__(-math.inf, math.inf)

    def extra_repr(self) -> str:
        """Show nothing: there are no bounds."""
        return ""


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
