"""The package's own sets as plain numbers, the form in which a compiled engine reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..shapes import broadcast_shapes
from .base import ConvexSet
from .bounds import Bounds
from .box import Box, SoftBox
from .curved import Ball, SecondOrderCone
from .feasible import FeasibleSet
from .units import SetsInUnits

#: The kinds of blocks.
BALL, CONE = 1, 2


@dataclass(frozen=True, eq=False)
class SetValues:
    """An interval for every row of v = (u, y, du), and blocks of rows that a ball or a cone holds; float64.

    Attributes:
        lower, upper: of each row, `(N,)` or one a sample, `(B, N)`; infinite on the rows of a block.
        price: the cap of |lam| on each row, like `lower`, infinite where the interval is hard; None if all are hard.
        kind: of each block, `(n_blocks,)`, int64: `BALL` or `CONE`.
        start: where the rows of each block begin in `rows`, and their end, `(n_blocks + 1,)`, int64.
        rows: the rows of each block, block after block, int64; a cone's bounding row is its first.
        center: of the balls, `(len(rows),)` or one a sample; zero for cones.
        radius: of the balls, `(n_blocks,)` or one a sample; zero for cones.
    """

    lower: Tensor
    upper: Tensor
    price: Tensor | None
    kind: Tensor
    start: Tensor
    rows: Tensor
    center: Tensor
    radius: Tensor


def values_of(sets: Bounds | FeasibleSet, batch: torch.Size, device: torch.device) -> SetValues | None:
    """Return the numbers of the sets as their parameters are now; None if a set is not one of the package.

    Args:
        sets: of one problem.
        batch: of the samples; parameters with a batch dimension are expanded to it and flattened, `(B, ...)`.
        device: of the numbers.
    """
    if isinstance(sets, Bounds):
        none = torch.zeros(0, dtype=torch.int64, device=device)
        nothing = torch.zeros(0, dtype=torch.float64, device=device)
        lower, upper = sets.tensors
        return SetValues(
            lower, upper, None, none, torch.zeros(1, dtype=torch.int64, device=device), none, *[nothing] * 2
        )
    if not all(_is_known(owner) for owner, _ in sets.parts):
        return None
    n_rows = len(sets.order)
    lower = torch.full((n_rows,), -torch.inf, dtype=torch.float64, device=device)
    upper, price = -lower, -lower
    kind: list[Tensor] = []
    rows: list[Tensor] = []
    sizes: list[int] = []
    centers: list[Tensor] = []
    radii: list[Tensor] = []
    for owner, here in sets.parts:
        places = here.to(device)
        if isinstance(owner, (Box, SoftBox)):
            bounds, weight = owner.interval(places, torch.float64)
            lower = _put(lower, places, bounds[0])
            upper = _put(upper, places, bounds[1])
            price = price if weight is None else _put(price, places, weight)
            continue
        like = torch.zeros(places.shape, dtype=torch.float64, device=device)
        center, radius = owner.center_and_radius(like) if isinstance(owner, Ball) else (like, like[:, 0])
        kind.append(torch.full((len(places),), BALL if isinstance(owner, Ball) else CONE, device=device))
        rows.append(places.reshape(-1))
        sizes += [places.shape[1]] * len(places)
        centers.append(center.reshape(*center.shape[:-2], -1))
        radii.append(radius)
    start = torch.tensor([0, *sizes], device=device).cumsum(0)
    none = torch.zeros(0, dtype=torch.int64, device=device)
    values = SetValues(
        _flat(lower, batch),
        _flat(upper, batch),
        None if bool(price.isinf().all()) else _flat(price, batch),
        torch.cat(kind) if kind else none,
        start,
        torch.cat(rows) if rows else none,
        _flat(_joined(centers, device), batch),
        _flat(_joined(radii, device), batch),
    )
    return _in_units(values, sets.unit[sets.inverse.to(device)]) if isinstance(sets, SetsInUnits) else values


def _in_units(values: SetValues, unit: Tensor) -> SetValues:
    """Return the sets for v / unit and lam unit; the unit `(N,)` in the order of v, one number within each block."""
    of_rows = unit[values.rows]
    return replace(
        values,
        lower=values.lower / unit,
        upper=values.upper / unit,
        price=None if values.price is None else values.price * unit,
        center=values.center / of_rows,
        radius=values.radius / of_rows[values.start[:-1]],
    )


def _is_known(owner: ConvexSet) -> bool:
    """Return whether the parameters of a set are all of it: a set whose projection no subclass replaces."""
    for cls in (Box, SoftBox, Ball, SecondOrderCone):
        if isinstance(owner, cls):
            return type(owner).project is cls.project and type(owner).prox is cls.prox
    return False


def _put(x: Tensor, places: Tensor, values: Tensor) -> Tensor:
    """Return x `(..., N)` with values `(*batch, groups, size)` at the places `(groups, size)`."""
    batch = broadcast_shapes(x.shape[:-1], values.shape[:-2])
    x = x.expand(*batch, x.shape[-1]).clone()
    x[..., places] = values
    return x


def _flat(x: Tensor, batch: torch.Size) -> Tensor:
    """Return x `(k,)` as it is and x `(*own batch, k)` as `(B, k)`."""
    return x if x.ndim == 1 else x.expand(*batch, x.shape[-1]).reshape(-1, x.shape[-1])


def _joined(parts: list[Tensor], device: torch.device) -> Tensor:
    if not parts:
        return torch.zeros(0, dtype=torch.float64, device=device)
    batch = broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*batch, -1) for part in parts], dim=-1)
