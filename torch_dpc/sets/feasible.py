"""All sets of a problem as one: a product over parts of the constrained rows v."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from ..autodiff import is_mapped, is_plain
from ..checks import one_batch
from .base import ConvexSet, Part
from .blocks import Blocks, BlockStructure, flat, joined
from .bounds import Bounds
from .box import Box, NonNegative, Reals, SoftBox
from .curved import Ball, SecondOrderCone
from .product import Product


@dataclass(frozen=True, eq=False)
class FeasibleSet(BlockStructure):
    """The product of the sets of a problem.

    Methods other than `bounds` work in *part order*, v[..., order]: the entries of one part side by side.
    """

    @staticmethod
    def of(sets: Iterable[tuple[str, ConvexSet, int, int]]) -> FeasibleSet:
        """Put sets side by side, each (name, set, steps, channels).

        Raises:
            ValueError: a set does not fit.
        """
        parts: list[Part] = []
        names: list[str] = []
        start = 0
        for name, owner, steps, channels in sets:
            owner.check(name, steps, channels)
            parts += [(leaf, start + places) for leaf, places in owner.parts(steps, channels)]
            names += [name] * (len(parts) - len(names))
            start += steps * channels
        return FeasibleSet(parts, names)

    def versions(self) -> list[int]:
        """Return torch's count of the changes in place of every parameter of the sets."""
        return [x._version for x in self.tensors if is_plain(x.data if isinstance(x, nn.Parameter) else x)]

    @property
    def tensors(self) -> list[Tensor]:
        """The tensors that the sets hold."""
        return [holder[name] for owner, _ in self.parts for holder, name in places_of(owner)]

    def with_tensors(self, tensors: Iterable[Tensor]) -> FeasibleSet:
        """Return a snapshot with these in place of `tensors`; itself if they are the same."""
        tensors = list(tensors)
        if all(new is own for new, own in zip(tensors, self.tensors, strict=True)):
            return self
        copy = self.snapshot()
        places = [place for owner, _ in copy.parts for place in places_of(owner)]
        for (holder, name), tensor in zip(places, tensors, strict=True):
            holder[name] = tensor
        return copy

    def snapshot(self) -> FeasibleSet:
        """Return the same sets with the parameters that they have now."""
        return FeasibleSet([(cast(ConvexSet, snapshot_of(owner)), places) for owner, places in self.parts], self.names)

    @property
    def batch_shape(self) -> torch.Size:
        """The batch dimensions that the sets' own parameters have."""
        return self.prox(torch.zeros(len(self.order), dtype=torch.float64)).shape[:-1]

    def batches(self, device: torch.device) -> list[tuple[str, torch.Size]]:
        """Return the batch dimensions that the parameters of each part have, by name.

        Raises:
            ValueError: a parameter of another shape was assigned since the sets were checked.
        """
        found = []
        for (owner, places), name in zip(self.parts, self.names, strict=True):
            try:
                moved = owner.prox(torch.zeros(places.shape, dtype=torch.float64, device=device), 1.0)
            except RuntimeError:
                owner.check(name, *places.shape)
                raise
            found.append((name, moved.shape[:-2]))
        return found

    @property
    def is_box(self) -> bool:
        """Whether all sets together are a box."""
        return all(_is_box(owner) for owner, _ in self.parts)

    @property
    def structure_key(self) -> FeasibleSet | None:
        """What the factors of a problem depend on: nothing for a box, whose bounds are read at every call."""
        return None if self.is_box else self

    @property
    def is_of_the_package(self) -> bool:
        """Whether no set is the user's own."""
        return all(type(owner) in (Box, Reals, NonNegative, SoftBox, Ball, SecondOrderCone) for owner, _ in self.parts)

    @property
    def sources(self) -> tuple[Any, ...] | None:
        """What the sets are made of, to compare by value; None if that is not known, of a set of the user's own."""
        if self.is_box:
            return tuple(bound for owner, _ in self.parts for bound in (owner.lower, owner.upper))
        if not self.is_of_the_package:
            return None
        return tuple(argument for owner, _ in self.parts for argument in owner.config().values())

    def check_engine(self, solver: str) -> None:
        """Raise ValueError if the forward engine of that name cannot solve for these sets."""
        if solver == "daqp" and not self.is_box:
            raise ValueError('`solver="daqp"` is for sets that are boxes; use "newton" or "auto".')

    def for_solve(self, device: torch.device) -> Bounds | FeasibleSet:
        """Return the sets as a solve takes them: the bounds of a box, or a snapshot with the present parameters.

        Raises:
            ValueError: parameters, as they are now, that do not describe a set.
        """
        if self.is_box:
            return Bounds(*self.bounds(device))
        self.check_values()
        return self.snapshot()

    @property
    def is_piecewise_affine(self) -> bool:
        """Whether the projection certainly is: its Jacobian then has no derivative."""
        return all(_is_box(owner) or type(owner) is SoftBox for owner, _ in self.parts)

    def bounds(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return lower and upper of v, `(..., N)` each, float64, with their graph.

        Raises:
            ValueError: a set is no box.
        """
        if not self.is_box:
            raise ValueError("the sets of this layer are not all boxes: they have no bounds.")
        like = torch.empty(0, dtype=torch.float64, device=device)
        sides: tuple[list[Tensor], list[Tensor]] = ([], [])
        shapes: list[tuple[str, torch.Size]] = []
        for (owner, places), name in zip(self.parts, self.names, strict=True):
            assert isinstance(owner, Box)
            owner.check_values()
            for side, value in zip(sides, owner.bounds(like), strict=True):
                try:
                    full = torch.broadcast_to(value, (*value.shape[:-2], *places.shape))
                except RuntimeError:  # a bound of another shape, assigned since the set was checked
                    owner.check(name, *places.shape)
                    raise
                shapes.append((name, value.shape[:-2]))
                side.append(flat(full))
        one_batch(shapes)
        inverse = self.inverse.to(device)
        return joined(sides[0])[..., inverse], joined(sides[1])[..., inverse]

    def prox(self, x: Tensor, gamma: Tensor | float = 1.0) -> Tensor:
        """Return the projection of x, `(..., N)`; the proximal map where a penalty stands in place of a set.

        gamma is one number, or `(..., N)`, equal within every group of a set that is not separable.
        """
        return joined(
            [
                flat(owner.prox(self._group(x, at, shape), self._scale(gamma, owner, at, shape)))
                for owner, at, shape in self._slices
            ]
        )

    def jacobians(self, x: Tensor, gamma: Tensor | float) -> Blocks:
        """Return D1 at x."""
        return [
            (owner.jacobian_diagonal if owner.separable else owner.jacobian)(
                self._group(x, at, shape), self._scale(gamma, owner, at, shape)
            )
            for owner, at, shape in self._slices
        ]

    def largest_of_coupled(self, x: Tensor) -> Tensor:
        """Return x, `(..., N)`, with the largest of the entries that its set couples it with in place of each."""
        parts = []
        for owner, at, shape in self._slices:
            group = self._group(x, at, shape)
            parts.append(flat(group if owner.separable else group.amax(-1, keepdim=True).expand_as(group)))
        return joined(parts)

    def check_values(self) -> None:
        """Raise ValueError where the parameters of a set, as they are now, do not describe one.

        Raises:
            NotImplementedError: `vmap` maps one of them.
        """
        if any(map(is_mapped, self.tensors)):
            raise NotImplementedError(
                "vmap over the parameters of a set is for layers whose sets are all boxes: give the parameters (a "
                "radius, a bound, ...) a leading batch dimension, which is solved as one batch."
            )
        for owner, _ in self.parts:
            owner.check_values()

    def weak(self, x: Tensor, small: Tensor) -> Tensor:
        """Return the rows whose multiplier is none: where `small` says so, whole groups unless the set is separable.

        Where the set is a point its projection is constant, whatever the multiplier.
        """
        out = []
        for owner, at, shape in self._slices:
            group = self._group(small, at, shape)
            group = group if owner.separable else group.all(-1, keepdim=True).expand_as(group)
            out.append(flat(group & ~owner.is_point(self._group(x, at, shape))))
        return joined(out)

    def touching(self, v: Tensor, weak: Tensor, reach: float) -> Tensor:
        """Return how many bounds v touches where `weak` says that no multiplier holds it there, `(...)`."""
        count = torch.zeros(v.shape[:-1], dtype=torch.int64, device=v.device)
        size = self.largest_of_coupled(v.abs())
        for (_, at, shape), slack in zip(self._slices, self.slacks(v), strict=True):
            near = slack.abs() <= reach * (1 + self._group(size, at, shape)[..., : slack.shape[-1]])
            free = self._group(weak, at, shape)
            count = count + (near & (free if slack.shape == free.shape else free[..., :1])).sum((-2, -1))
        return count

    def slacks(self, v: Tensor) -> list[Tensor]:
        """Return the distance of v to the bounds of each part, `(..., groups, k)`."""
        return [owner.slack(self._group(v, at, shape)) for owner, at, shape in self._slices]

    def supports(self, d: Tensor) -> Tensor:
        """Return the supremum of <d, v> over each group's set, `(..., groups of all parts)`; it may be infinite."""
        return joined([owner.support(self._group(d, at, shape)) for owner, at, shape in self._slices])

    def conjugate(self, lam: Tensor, v: Tensor) -> Tensor:
        """Return the sum of the sets' conjugates at optimal multipliers, `(...)`; lam and v in the order of v."""
        lam, v = lam[..., self.order.to(lam.device)], v[..., self.order.to(lam.device)]
        each = (
            owner.conjugate(self._group(lam, at, shape), self._group(v, at, shape)) for owner, at, shape in self._slices
        )
        return joined(list(each)).sum(-1)

    def bounded_direction(self, d: Tensor) -> Tensor:
        """Return a direction near d in which the sets are bounded."""
        return joined(
            [owner.bounded_direction(self._group(d, at, shape)).flatten(-2) for owner, at, shape in self._slices]
        )


def identity_key(owner: ConvexSet) -> tuple[Any, ...]:
    """Return what the parts of a set depend on, to compare by `==`: the sets within, their `per` and channels."""
    held = owner.__dict__
    if not held["_modules"]:
        return owner, held.get("per")
    channels = [list(own) for own in owner.channels] if isinstance(owner, Product) else None
    return owner, held.get("per"), channels, [identity_key(cast(ConvexSet, inner)) for inner in owner.children()]


def _is_box(owner: ConvexSet) -> bool:
    """Return whether the bounds of a set are all of it: a Box whose projection no subclass replaces."""
    cls = type(owner)
    return isinstance(owner, Box) and cls.project is Box.project and cls.prox is Box.prox


def snapshot_of(module: nn.Module) -> nn.Module:
    """Return a copy that shares the tensors of a module, but not the places that hold them."""
    copy = object.__new__(type(module))
    copy.__dict__.update(module.__dict__)
    copy.__dict__["_parameters"] = dict(module._parameters)
    copy.__dict__["_buffers"] = dict(module._buffers)
    copy.__dict__["_modules"] = {k: None if m is None else snapshot_of(m) for k, m in module._modules.items()}
    return copy


def places_of(module: nn.Module) -> list[tuple[dict[str, Any], str]]:
    """Return where a module and its children hold tensors, as parameters, buffers or attributes."""
    holders = (holder for part in module.modules() for holder in (part._parameters, part._buffers, part.__dict__))
    return [(holder, name) for holder in holders for name, value in holder.items() if isinstance(value, Tensor)]
