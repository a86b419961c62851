"""What a call of the layer returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from . import plot
from .autodiff import carries_derivative
from .batching import times
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .errors import Status
from .problem.reduction import Reduction
from .solve.engines import Sets
from .solve.outcome import Planned
from .solve.solver import Solver

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class SolveInfo:
    """How the solve of each sample went; every tensor has the batch's shape.

    Attributes:
        is_selection: the cost does not fix g; u, y and g are those of the minimum-norm g.
    """

    def __init__(self, table: Tensor, is_selection: bool, make_nonsingular: Callable[[], Tensor]):
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

    def __repr__(self) -> str:
        names = ("status", "iterations", "residual", "n_active", "n_weakly_active", "is_selection")
        return f"SolveInfo({', '.join(f'{name}={getattr(self, name)}' for name in names)})"


@dataclass(frozen=True, eq=False)
class DPCSolution:
    """The planned trajectory.

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
    _make_g: Callable[[], Tensor]

    @cached_property
    def g(self) -> Tensor:
        """The combination of the recorded windows, `(*batch, n_g)`; computed when first asked for."""
        return self._make_g()

    def plot(self, axes: Any = None, **options: Any) -> Figure:
        """Draw the plan, with its past and the truth where they are given: :func:`torch_dpc.plot.plan`."""
        return plot.plan(self, axes, **options)

    def sample(self, i: int) -> DPCSolution:
        """Return one sample of a batch."""
        info = SolveInfo(self.info.table[i], self.info.is_selection, lambda: self.info.nonsingular[i])
        return DPCSolution(self.u[i], self.y[i], info, self.lam[i], lambda: self.g[i])


def solution_of(
    planned: Planned,
    theta: Tensor,
    sets: Sets,
    data: HankelData | HankelBatch,
    reduction: Reduction,
    solver: Solver,
    dtype: torch.dtype,
) -> DPCSolution:
    """Return what a call of the layer returns; g is computed from these arguments when first asked for."""
    is_double = dtype == torch.float64
    return DPCSolution(
        u=planned.u if is_double else planned.u.to(dtype),
        y=planned.y if is_double else planned.y.to(dtype),
        info=SolveInfo(
            planned.info, reduction.is_selection, lambda: _nonsingular(data, reduction, solver, theta, planned, sets)
        ),
        lam=planned.lam,
        _make_g=lambda: _g(data, reduction, theta, planned.lam, planned.info).to(dtype),
    )


def _nonsingular(
    data: HankelData | HankelBatch, reduction: Reduction, solver: Solver, theta: Tensor, planned: Planned, sets: Sets
) -> Tensor:
    with torch.no_grad():
        # The part of g that the data do not see is fixed by lambda_g alone.
        fixed = (solver.reduction.weights.lambda_g > 0) | data.spans_all.to(theta.device)
        decided = solver.reduction.rows.Eq_range is None and not reduction.is_selection
        return solver.independent(planned, sets) & fixed & decided


def _g(data: HankelData | HankelBatch, reduction: Reduction, theta: Tensor, lam: Tensor, info: Tensor) -> Tensor:
    data.require_windows()
    a = times(reduction.A_theta, theta) - times(reduction.A_lam, lam)
    g = times(basis := data.basis.to(a.device), a)
    if carries_derivative((reduction.rows.C,)):  # g = D^+ (D g), so that the data behind D are differentiated too
        D = data.stacked.to(a.device)
        g = times(torch.linalg.pinv(D, rtol=1e-10), times(D @ basis, a))
    return torch.where(info[..., :1] == Status.SOLVED, g, torch.nan)
