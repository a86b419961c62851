"""What a plan tells when asked: g, the optimal cost, the mismatch of y_ini, and whether J is nonsingular."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from ..autodiff import carries_derivative, is_plain
from ..batching import times
from ..data.hankel import HankelData
from ..data.hankel_batch import HankelBatch
from ..errors import Status
from ..problem.cost import mismatch, optimal_cost
from ..problem.reduction import Reduction
from .consistency import coefficients, excess_cost, inconsistency
from .engines import Sets
from .outcome import Planned, joined
from .solver import Solver

#: The results that a plan computes when asked.
NAMES = ("g", "value", "slack")
#: Coefficients that are off by more, in cost or in a row, relative, are computed anew in extended precision.
ACCURATE = 1e-10


class Later(Protocol):
    """Computes results of a plan when they are asked for."""

    @property
    def tensors(self) -> Sequence[Tensor]:
        """The tensors of the samples that the results are computed from."""

    def with_tensors(self, tensors: Sequence[Tensor]) -> Later:
        """Return the same with these in place of `tensors`."""

    def make(self, name: str) -> Tensor:
        """Return a result: one of :data:`NAMES`, or "nonsingular"."""


@dataclass(frozen=True)
class Thunks:
    """Results by functions of no argument.

    Attributes:
        by_name: the functions.
        why_not: what the error says if a result is asked for that has no function.
    """

    by_name: Mapping[str, Callable[[], Tensor]]
    why_not: str = "it was not computed by a layer of this process"

    @property
    def tensors(self) -> Sequence[Tensor]:
        """None: the functions hold their own."""
        return ()

    def with_tensors(self, tensors: Sequence[Tensor]) -> Thunks:
        """Return itself."""
        return self

    def make(self, name: str) -> Tensor:
        """Return a result.

        Raises:
            NotImplementedError: there is no function for it.
        """
        if name not in self.by_name:
            raise NotImplementedError(f"this plan does not tell its `{name}`: {self.why_not}.")
        return self.by_name[name]()


@dataclass(frozen=True, eq=False)
class Recovery:
    """Results recovered from the multipliers of a solve.

    Attributes:
        data: the recorded trajectories.
        reduction: with its graph.
        solver: of the reduction.
        sets: with the parameters of the solve and their graph.
        dtype: of the caller.
        theta: (u_ini, y_ini, u_ref, y_ref), `(*batch, n_theta)`.
        planned: the solution.
    """

    data: HankelData | HankelBatch
    reduction: Reduction
    solver: Solver
    sets: Sets
    dtype: torch.dtype
    theta: Tensor
    planned: Planned

    @property
    def tensors(self) -> Sequence[Tensor]:
        """Theta and the solution."""
        return self.theta, *(x for x in self.planned if x is not None)

    def with_tensors(self, tensors: Sequence[Tensor]) -> Recovery:
        """Return the same with these in place of `tensors`."""
        theta, *planned = tensors
        return replace(self, theta=theta, planned=Planned(*planned))

    def make(self, name: str) -> Tensor:
        """Return a result.

        Raises:
            ValueError: g of compact data, which have no windows.
            NotImplementedError: the cost of a penalty of one's own without a `conjugate`.
        """
        if name == "nonsingular":
            return self._nonsingular()
        made = {"g": self._g, "value": self._value, "slack": self._slack}[name]()
        solved = self.planned.info[..., 0] == Status.SOLVED
        solved = solved.reshape((*solved.shape, *(1,) * (made.ndim - solved.ndim)))
        return torch.where(solved, made, torch.nan).to(self.dtype)

    def _g(self) -> Tensor:
        self.data.require_windows()
        reduction = self.reduction
        a = times(reduction.A_theta, self.theta) - times(reduction.A_lam, self.planned.lam)
        with torch.no_grad():
            accurate = self._accurate(reduction.detach())
        a = accurate + (a - a.detach())  # the difference is zero, and carries the graph
        a = a[..., self.solver.sizes.slack :]
        is_spc = a.shape[-1] < self.data.basis.shape[-1]
        basis = self.data.basis.to(a.device)[..., : a.shape[-1]]
        if not carries_derivative((reduction.rows.C,)):
            return times(basis, a)
        # g = D^+ (D g), so that the data behind D are differentiated too; D in units, which g does not see.
        D = self.data.stacked.to(a.device) / reduction.rows.theta_scale[..., None]
        if is_spc:
            D = D[..., : D.shape[-2] - self.data.horizon * self.data.n_y, :]  # g is in the row space of W
        return times(torch.linalg.pinv(D, rtol=reduction.rows.tolerance), times(D @ basis, a))

    def _accurate(self, reduction: Reduction) -> Tensor:
        """Return the coefficients of the plan: those of samples that double precision does not do, in extended one."""
        theta, planned = self.theta.detach(), self.planned
        lam, uy = planned.lam.detach(), [x.detach().flatten(-2) for x in (planned.u, planned.y)]
        uy_flat = torch.cat(uy, dim=-1)
        a = coefficients(reduction, theta, lam, uy_flat)
        if not all(map(is_plain, (theta, lam, *uy))):
            return a
        excess = excess_cost(reduction, theta, a, lam, uy_flat)
        off = torch.maximum(excess, inconsistency(reduction, a, uy_flat))
        doubtful = (planned.info[..., 0] == Status.SOLVED) & ~(off <= ACCURATE)
        if not bool(doubtful.any()):
            return a
        v = joined(self.solver.sizes, planned.u, planned.y, planned.du, lam).detach()
        if planned.du is None:
            v[..., self.solver.sizes.u + self.solver.sizes.y :] = torch.nan  # boxes leave the changes to u
        return self.solver.accurate_coefficients(theta, v, lam, a, doubtful)

    def _value(self) -> Tensor:
        planned = self.planned
        v = joined(self.solver.sizes, planned.u, planned.y, planned.du, planned.lam)
        solved = planned.info[..., :1] == Status.SOLVED
        return optimal_cost(self.reduction, self.theta, planned.lam, torch.where(solved, v, 0.0), self.sets)

    def _slack(self) -> Tensor:
        data = self.data
        flat = mismatch(self.reduction, self.theta, self.planned.lam)
        return flat.reshape(*flat.shape[:-1], data.t_ini, data.n_y)

    def _nonsingular(self) -> Tensor:
        with torch.no_grad():
            reduction = self.solver.reduction
            # The part of g that the data do not see is fixed by lambda_g alone.
            fixed = (reduction.weights.lambda_g > 0) | self.data.spans_all.to(self.theta.device)
            decided = reduction.rows.Eq_range is None and not self.reduction.is_selection
            return self.solver.independent(self.planned, self.sets) & fixed & decided
