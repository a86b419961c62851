"""Products of sets over channels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from ..checks import as_index
from .base import ConvexSet, Part


class Product(ConvexSet):
    """The product of sets over groups of channels.

    Args:
        factors: pairs of a set and its channels, a number or a list of them; every channel once.

    Example:
        >>> from torch_dpc import Ball, NonNegative
        >>> Product([(Ball(1.0), [0, 1]), (NonNegative(), 2)]).project(torch.tensor([3.0, 4.0, -1.0]))
        tensor([0.6000, 0.8000, 0.0000])
    """

    def __init__(self, factors: Sequence[tuple[ConvexSet, int | Sequence[int]]]):
        pairs = _pairs_of(factors)
        named = [channel for _, channels in pairs for channel in channels]
        if sorted(named) != list(range(len(named))) or not named:
            raise ValueError(f"`factors` must name every channel from 0 on once, got {sorted(named)}.")
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

    def extra_repr(self) -> str:
        """Show the factors and their channels."""
        return ", ".join(f"{owner} on {own}" for owner, own in zip(self.factors, self.channels, strict=True))


def _pairs_of(factors: Any) -> list[tuple[ConvexSet, list[int]]]:
    """Return the factors as pairs of a set and the list of its channels."""
    rule = "`factors` must be pairs of a ConvexSet and its channels, a number or a list of them"
    try:
        given = [(owner, channels) for owner, channels in factors]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{rule}, got {factors!r}.") from error
    pairs = []
    for owner, channels in given:
        if not isinstance(owner, ConvexSet):
            raise ValueError(f"{rule}, got {type(owner).__name__} for a set.")
        several = isinstance(channels, Iterable) and getattr(channels, "ndim", 1) > 0
        each = [as_index(f"{rule}; a channel is an integer", c) for c in (channels if several else [channels])]
        pairs.append((owner, each))
    return pairs
