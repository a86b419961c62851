"""The sets of a problem seen by rows in units of their own, v / unit."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from .blocks import Blocks
from .bounds import Bounds
from .feasible import FeasibleSet


@dataclass(frozen=True, eq=False)
class SetsInUnits(FeasibleSet):
    """All sets of a problem for v / unit: {v / unit : v in the sets}.

    Attributes:
        unit: in part order, `(N,)`, equal within the group of a set that is not separable.
    """

    unit: Tensor

    def prox(self, x: Tensor, gamma: Tensor | float = 1.0) -> Tensor:
        """Return the projection of x, or the proximal map, `(..., N)`; gamma is in units too."""
        return super().prox(x * self.unit, gamma * self.unit.square()) / self.unit

    def jacobians(self, x: Tensor, gamma: Tensor | float) -> Blocks:
        """Return D1 at x; within a group the unit is one number, so it is the same in all units."""
        return super().jacobians(x * self.unit, gamma * self.unit.square())

    def weak(self, x: Tensor, small: Tensor) -> Tensor:
        """Return the rows whose multiplier is none; see :meth:`FeasibleSet.weak`."""
        return super().weak(x * self.unit, small)

    def slacks(self, v: Tensor) -> list[Tensor]:
        """Return the distance of v to the bounds of each part, in units."""
        units = [self._group(self.unit, at, shape) for _, at, shape in self._slices]
        slacks = super().slacks(v * self.unit)
        return [slack / unit[..., : slack.shape[-1]] for slack, unit in zip(slacks, units, strict=True)]

    def supports(self, d: Tensor) -> Tensor:
        """Return the supremum of <d, v> over each group's set; it may be infinite."""
        return super().supports(d / self.unit)


def in_units(sets: Bounds | FeasibleSet, unit: Tensor) -> Bounds | SetsInUnits:
    """Return the sets for v / unit, the unit `(N,)` in the order of v."""
    if isinstance(sets, Bounds):
        return Bounds(sets.lower / unit, sets.upper / unit)
    return SetsInUnits(sets.parts, sets.names, unit[sets.order.to(unit.device)])
