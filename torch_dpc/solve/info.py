"""How the solve of each sample went."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor
from torch.utils._pytree import register_pytree_node

from ..autodiff import is_plain
from ..errors import Status


class SolveInfo:
    """How the solve of each sample went; every tensor has the batch's shape.

    Attributes:
        is_selection: the cost does not fix g; u, y and g are those of the minimum-norm g. None in a compiled model,
            which does not tell.
    """

    def __init__(self, table: Tensor, is_selection: bool | None, make_nonsingular: Callable[[], Tensor]):
        self.table = table
        self.is_selection = is_selection
        self._make_nonsingular = make_nonsingular

    @property
    def status(self) -> Tensor:
        """A :class:`torch_dpc.Status`, int64."""
        return self.table[..., 0].long()

    @property
    def iterations(self) -> Tensor:
        """Steps of the engine that found the solution, int64."""
        return self.table[..., 1].long()

    @property
    def residual(self) -> Tensor:
        """The paper's F at the solution, relative to its terms, Up g = u_ini included; float64."""
        return self.table[..., 2]

    @property
    def n_active(self) -> Tensor:
        """Rows of (u, y) held at a bound, int64."""
        return self.table[..., 3].long()

    @property
    def n_weakly_active(self) -> Tensor:
        """Rows that touch their bound without a multiplier, int64; derivatives treat them as free."""
        return self.table[..., 4].long()

    @cached_property
    def nonsingular(self) -> Tensor:
        """Whether the paper's J is nonsingular at the solution, boolean: Proposition 1 holds as it stands.

        Where it is not, some multipliers or g are one choice of many, and derivatives are those of minimum norm.
        Computed when first asked for.
        """
        return self._make_nonsingular() & (self.status == Status.SOLVED)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the numbers, `nonsingular` included, without a graph."""
        table = self.table.detach()
        try:
            return SolveInfo, (table, self.is_selection, Constant(self.nonsingular.detach()))
        except NotImplementedError:
            return SolveInfo, (table, self.is_selection, lost)

    def __copy__(self) -> SolveInfo:
        """Return a copy that shares everything."""
        copied = SolveInfo(self.table, self.is_selection, self._make_nonsingular)
        copied.__dict__.update(self.__dict__)
        return copied

    def __repr__(self) -> str:
        return f"SolveInfo({told(self)})"


@dataclass(frozen=True, eq=False)
class Constant:
    """A function of no argument."""

    value: Tensor

    def __call__(self) -> Tensor:
        """Return the value."""
        return self.value


def lost() -> Tensor:
    """Raise NotImplementedError: `nonsingular` of an info that was taken apart before it was asked for."""
    raise NotImplementedError("`nonsingular` was not computed before the plan was taken apart: ask for it earlier.")


def _flatten_info(info: SolveInfo) -> tuple[list[Any], bool | None]:
    return [info.table], info.is_selection


def _unflatten_info(children: Iterable[Any], is_selection: bool | None) -> SolveInfo:
    (table,) = children
    return SolveInfo(table, is_selection, lost)


def told(info: SolveInfo) -> str:
    """Return how the solve went: status by name, and the ranges of the counts."""
    if not is_plain(info.table) or info.table.numel() == 0:
        return f"status={tuple(info.table.shape[:-1])}"
    table = info.table.detach().reshape(-1, info.table.shape[-1])
    statuses = [Status(int(s)).name for s in table[:, 0]]
    counted = {name: statuses.count(name) for name in (status.name for status in Status) if name in statuses}
    alone = info.table.ndim == 1
    status = statuses[0] if alone else ", ".join(f"{count} {name}" for name, count in counted.items())
    low, high = table[:, 3].min(), table[:, 3].max()
    active = f"{int(low)}" if low == high else f"{int(low)} to {int(high)}"
    weak = int(table[:, 4].max())
    return (
        f"status={status}, residual={'' if alone else 'at most '}{float(table[:, 2].max()):.1e}, "
        f"n_active={active}, n_weakly_active={'' if alone or not weak else 'up to '}{weak}"
    )


register_pytree_node(SolveInfo, _flatten_info, _unflatten_info, serialized_type_name="torch_dpc.SolveInfo")
