"""What a call of the layer returns."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils._pytree import register_pytree_node

from . import plot
from .autodiff import is_plain
from .solve.info import Constant, SolveInfo, told
from .solve.recovery import NAMES, Later, Recovery, Thunks

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class DPCSolution:
    """The planned trajectory.

    A plan is a pytree of tensors, so that `torch.vmap` may return it; it pickles, without its graph; `plan[3]` is one
    sample of a batch, `plan[:2]` or `plan[mask]` some.

    Attributes:
        u: planned inputs, `(*batch, horizon, n_u)`, in the units of the data.
        y: predicted outputs, `(*batch, horizon, n_y)`, in the units of the data.
        info: how the solve went.
        lam: multipliers of the sets, of u then y, `(*batch, horizon (n_u + n_y))`, float64.
    """

    u: Tensor
    y: Tensor
    info: SolveInfo
    lam: Tensor
    _later: Later

    @cached_property
    def g(self) -> Tensor:
        """The combination of the recorded windows, `(*batch, n_g)`; computed when first asked for."""
        return self._later.make("g")

    @cached_property
    def value(self) -> Tensor:
        """The optimal cost, `(*batch,)`, the price of soft bounds included; NaN without a solution.

        Its derivative is that of the envelope theorem. Computed when first asked for.
        """
        return self._later.make("value")

    @cached_property
    def slack(self) -> Tensor:
        """The mismatch of the initial output, Yp g - y_ini, `(*batch, t_ini, n_y)`; computed when first asked for."""
        return self._later.make("slack")

    def plot(self, axes: Any = None, **options: Any) -> Figure:
        """Draw the plan, with its past and the truth where they are given: :func:`torch_dpc.plot.plan`."""
        return plot.plan(self, axes, **options)

    def __getitem__(self, index: Any) -> DPCSolution:
        """Return some samples of a batch: `index` is what indexes the batch dimensions of a tensor.

        Raises:
            IndexError: the plan has no batch dimension, or no such sample.
        """
        if self.info.table.ndim == 1:
            raise IndexError("the plan is of one sample without a batch dimension: there is nothing to index.")
        if index is Ellipsis or isinstance(index, tuple) and any(part is Ellipsis for part in index):
            raise IndexError("`...` would index the steps of the plan: index the batch dimensions alone.")
        return self._changed(lambda x: x[index])

    def __len__(self) -> int:
        """Return the length of the first batch dimension."""
        if self.info.table.ndim == 1:
            raise TypeError("the plan is of one sample without a batch dimension: it has no length.")
        return len(self.info.table)

    def __iter__(self) -> Iterator[DPCSolution]:
        """Return the plans of the first batch dimension, one by one."""
        return (self[i] for i in range(len(self)))

    def sample(self, i: int) -> DPCSolution:
        """Return one sample of a batch."""
        return self[i]

    def detach(self) -> DPCSolution:
        """Return the same numbers without their graph."""
        return self._changed(Tensor.detach)

    def to(self, *args: Any, **options: Any) -> DPCSolution:
        """Return the plan on another device or in another dtype, as `torch.Tensor.to`.

        Multipliers and `info` keep their dtypes.
        """
        device = self.u.to(*args, **options).device
        return self._changed(lambda x: x.to(*args, **options), lambda x: x.to(device))

    def _changed(
        self, change: Callable[[Tensor], Tensor], change_own: Callable[[Tensor], Tensor] | None = None
    ) -> DPCSolution:
        """Return the plan with every tensor changed, multipliers and `info` by `change_own` if that is given.

        What is computed when asked for is changed then.
        """
        own = change if change_own is None else change_own
        info = self.info
        return DPCSolution(
            change(self.u),
            change(self.y),
            SolveInfo(own(info.table), info.is_selection, lambda: own(info.nonsingular)),
            own(self.lam),
            Thunks({name: _Changed(self, name, change) for name in NAMES}),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the numbers, those computed when asked for included, without a graph."""
        told = {}
        for name in NAMES:
            with contextlib.suppress(ValueError, NotImplementedError):  # g of compact data, for instance
                told[name] = getattr(self, name).detach()
        return _restored, (self.u.detach(), self.y.detach(), self.info, self.lam.detach(), told)

    def __repr__(self) -> str:
        return f"DPCSolution(u={_range(self.u)},\n    y={_range(self.y)},\n    {told(self.info)})"


@dataclass(frozen=True)
class _Changed:
    """A result of another plan, changed."""

    plan: DPCSolution
    name: str
    change: Callable[[Tensor], Tensor]

    def __call__(self) -> Tensor:
        return self.change(getattr(self.plan, self.name))


def solution_of(recovery: Recovery) -> DPCSolution:
    """Return what a call of the layer returns."""
    planned, dtype = recovery.planned, recovery.dtype
    is_double = dtype == torch.float64
    return DPCSolution(
        planned.u if is_double else planned.u.to(dtype),
        planned.y if is_double else planned.y.to(dtype),
        SolveInfo(planned.info, recovery.reduction.is_selection, lambda: recovery.make("nonsingular")),
        planned.lam,
        recovery,
    )


# --- pickles, pytrees and words ---------------------------------------------------------------------------------------


def _restored(u: Tensor, y: Tensor, info: SolveInfo, lam: Tensor, told: dict[str, Tensor]) -> DPCSolution:
    why = "it was not available when the plan was pickled"
    return DPCSolution(u, y, info, lam, Thunks({name: Constant(value) for name, value in told.items()}, why))


def _flatten(plan: DPCSolution) -> tuple[list[Any], tuple[bool | None, Later]]:
    children = [plan.u, plan.y, plan.info.table, plan.lam, *plan._later.tensors]
    return children, (plan.info.is_selection, plan._later)


def _unflatten(children: Iterable[Any], context: tuple[bool | None, Later]) -> DPCSolution:
    u, y, table, lam, *own = children
    later = context[1].with_tensors(own)
    return DPCSolution(u, y, SolveInfo(table, context[0], lambda: later.make("nonsingular")), lam, later)


# The output of an exported program loses what is computed when asked for.
register_pytree_node(
    DPCSolution,
    _flatten,
    _unflatten,
    serialized_type_name="torch_dpc.DPCSolution",
    to_dumpable_context=lambda context: context[0],
    from_dumpable_context=lambda is_selection: (is_selection, Thunks({}, "it is of an exported program")),
)


def _range(x: Tensor) -> str:
    """Return shape and range of a tensor, in words."""
    shape = f"{tuple(x.shape)} {str(x.dtype).removeprefix('torch.')}"
    if not is_plain(x) or not isinstance(x, Tensor) or x.numel() == 0:
        return shape
    finite = x.detach()[x.detach().isfinite()]
    if finite.numel() == 0:
        return f"{shape}, all NaN"
    return f"{shape} in [{float(finite.min()):.4g}, {float(finite.max()):.4g}]"
