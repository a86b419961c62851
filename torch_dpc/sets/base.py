"""What a convex set offers: the projection, its Jacobian, and linear minimisation.

A set constrains the channels of every step of the plan (`per="step"`) or the whole horizon as one vector
(`per="trajectory"`). Its methods work on the last dimension of what they are given.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

#: A part of a plan that one set constrains: the set, and which entries of the plan, `(groups, size)`: one group a step,
#: or one for the whole trajectory.
Part = tuple["ConvexSet", Tensor]


#: Methods that have a default derived from the projection.
_FOLLOWING = (
    "separable",
    "jacobian",
    "jacobian_diagonal",
    "jacobian_product",
    "minimize_linear",
    "support",
    "conjugate",
    "bounded_direction",
    "slack",
    "is_point",
)


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

    def __init_subclass__(cls, **options: Any) -> None:
        """Reset the derived methods to their defaults if the subclass defines a projection of its own."""
        super().__init_subclass__(**options)
        if "project" in vars(cls) or "prox" in vars(cls):
            for name in _FOLLOWING:
                if name not in vars(cls):
                    setattr(cls, name, vars(ConvexSet)[name])

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

        gamma is a number, or a tensor `(..., 1)`; for a separable set one number each entry, `(..., n)`.
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

    def conjugate(self, lam: Tensor, v: Tensor) -> Tensor:
        """Return h*(lam), the supremum of <lam, v> over the set, at an optimal pair, `(...)`.

        For a penalty in place of a set h*(lam) is the supremum of <lam, v> minus the penalty.

        Args:
            lam: multipliers, `(..., n)`.
            v: the point of the set that they belong to, `(..., n)`.
        """
        if type(self).prox is not ConvexSet.prox:
            raise NotImplementedError(f"{type(self).__name__} defines `prox`, but not `conjugate`: no optimal cost.")
        return (lam * v).sum(-1)

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
        fits = f"`{name}` does not fit {channels} channels over {steps} steps"
        try:
            parts = self.parts(steps, channels)
        except ValueError as error:
            raise ValueError(f"{fits}: {error}") from error
        for owner, places in parts:
            x = torch.zeros(places.shape, dtype=torch.float64)
            try:
                shapes = [owner.project(x).shape, owner.prox(x, x.new_ones(*x.shape[:-1], 1)).shape]
            except (RuntimeError, ValueError, TypeError, IndexError) as error:
                raise ValueError(f"{fits}: {error}") from error
            for shape in shapes:
                if shape[-2:] != x.shape:
                    raise ValueError(f"{fits}: it projects {tuple(x.shape)} to {tuple(shape)}.")

    def check_values(self) -> None:
        """Raise ValueError where the parameters, as they are now, do not describe a set."""

    def is_point(self, x: Tensor) -> Tensor:
        """Return whether the set leaves x no choice, which is shaped as `slack(x)`: nothing then moves it."""
        return torch.zeros_like(x[..., :1], dtype=torch.bool)

    def config(self) -> dict[str, Any]:
        """Return the arguments that make this set again; tensors are given as they are."""
        raise NotImplementedError(f"{type(self).__name__} does not define `config`, so it cannot be saved.")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"
