"""Solve, judge and differentiate problems whose sets are not all boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ..autodiff import refuse_forward_twice, untransformed
from ..batching import lead_all, times
from ..errors import Status
from ..problem.reduction import Reduction
from ..problem.terms import Sizes
from ..sets.feasible import FeasibleSet
from .infeasibility import separates_from_set
from .optimality import BATCHED, WEAKLY_ACTIVE, Optimality
from .projected_system import Implicit, solve_system
from .solver import ACCEPTED, Planned, check_finite, report_failures
from .splitting import resolvent_of, scale_of, solve_convex

#: Eigenvalues of D1 below this hold their direction.
HELD = 1e-9
#: Samples at once: the rotated systems of a batch take (N^2) numbers a sample.
CHUNK = 256


@dataclass(frozen=True, eq=False)
class ConvexSolver:
    """Everything a solve needs besides its tensors.

    Attributes:
        reduction: the reduced problem, without a graph.
        sizes: the parts of theta and of v.
        sets: all sets of the problem.
        on_failure: "raise" or "nan".
    """

    reduction: Reduction
    sizes: Sizes
    sets: FeasibleSet
    on_failure: str

    @cached_property
    def gamma(self) -> Tensor:
        """The scale of the multipliers, `(N,)`."""
        with untransformed():  # the first call may be within a transform, the next one outside of it
            return scale_of(self._G, self.sets)

    @cached_property
    def _G(self) -> Tensor:
        order = self.sets.order.to(self.reduction.G.device)
        return self.reduction.G[..., order[:, None], order]

    @cached_property
    def _Ct(self) -> Tensor:
        return self.reduction.Ct[..., self.sets.order.to(self.reduction.Ct.device), :]

    @cached_property
    def _resolvent(self) -> Tensor:
        return resolvent_of(self._G, self.gamma)

    @cached_property
    def _optimality(self) -> Optimality:
        return Optimality(self.reduction, BATCHED)

    def with_failures(self, on_failure: str) -> ConvexSolver:
        """Return the same solver with another `on_failure`."""
        return replace(self, on_failure=on_failure)

    def plan(self, theta: Tensor, reduction: Reduction) -> Planned:
        """Solve for every theta `(*batch, n_theta)`; differentiable in theta, the reduction and the sets' parameters.

        Raises:
            ValueError: values that are not finite.
            InfeasibleError, SolveError: with `on_failure="raise"`, if a sample has no accepted solution.
        """
        self.sets.check_values()
        if not self.sets.is_piecewise_affine:
            refuse_forward_twice()
        # As they are now: the backward must not see what the sets become later.
        sets, gamma = self.sets.snapshot(), self.gamma
        order, inverse = sets.order.to(theta.device), sets.inverse.to(theta.device)
        # Detached again: under torch.func the sets' own parameters are seen through the solve.
        v, lam, weak, active, info = (found.detach() for found in _Find.apply(theta.detach(), self))
        solved = info[..., :1] == float(Status.SOLVED)
        # The solution is known: what follows attaches its derivative.
        v0 = times(reduction.rows.C, times(reduction.A_theta, theta))[..., order]
        G = reduction.G[..., order[:, None], order]
        v, lam = Implicit.apply(v0, G, v, lam, solved, weak, sets, gamma, *sets.tensors)
        v, lam, active = (x[..., inverse] for x in (v, lam, active))
        return Planned(*self.sizes.split(v), lam, active, info)

    def find(self, theta: Tensor) -> tuple[Tensor, ...]:
        """Return v, lam, weak and active rows in part order, `(*batch, N)`, and info `(*batch, 5)`."""
        check_finite(theta, self.sizes)
        shape = self.sets.batch_shape
        batch = torch.broadcast_shapes(theta.shape[:-1], shape, self.reduction.V.shape[:-2])
        theta = theta.expand(*batch, theta.shape[-1])
        if shape:
            found = list(self._solve(theta))
        else:
            shared = self._G.ndim == 2
            solver = self if shared else replace(self, reduction=self.reduction.of_batch(batch))
            flat = theta.reshape(-1, theta.shape[-1])
            chunks = [solver._solve(part) for part in (flat.split(CHUNK) if shared else [flat])]
            found = [torch.cat(parts).reshape(*batch, parts[0].shape[-1]) for parts in zip(*chunks, strict=True)]
        report_failures(found[-1].reshape(-1, found[-1].shape[-1]), batch, self.on_failure)
        return tuple(found)

    def _solve(self, theta: Tensor) -> tuple[Tensor, ...]:
        sets, gamma = self.sets, self.gamma
        order, inverse = sets.order.to(theta.device), sets.inverse.to(theta.device)
        a0, v0 = self._optimality.unconstrained(theta)
        found = solve_convex(self._G, self._Ct, self._resolvent, v0[..., order], sets, gamma)
        lam = found.lam
        a = a0 - times(self.reduction.A_lam, lam[..., inverse])
        raw = times(self.reduction.rows.C, a)
        v = sets.prox(raw[..., order] + lam)
        residual = self._optimality.residual(theta, a, a0, raw, v[..., inverse], v0, lam[..., inverse])
        weak = self._weak(v, lam)
        d, _ = sets.spectral(sets.freed(sets.jacobians(v + gamma * lam, gamma), weak))
        active = (d < HELD).expand_as(v)
        failed = ~(residual <= ACCEPTED) | self.reduction.rows.unreachable(theta)
        status = torch.where(failed, int(Status.FAILED), int(Status.SOLVED))
        info = [status, found.iterations, residual, active.sum(-1), sets.touching(v, weak, WEAKLY_ACTIVE)]
        out = [v, lam, weak.expand_as(v), active, torch.stack([i.double().expand(status.shape) for i in info], dim=-1)]
        if bool(failed.any()):
            self._mark_failures(theta, v0[..., order], found.gap, failed, out)
        return tuple(out)

    def _weak(self, v: Tensor, lam: Tensor) -> Tensor:
        """Return the rows whose multiplier moves nothing: they count as inactive, as at a box; in part order."""
        moved = (lam * self._G.diagonal(dim1=-2, dim2=-1)).abs()
        return self.sets.weak(v, moved <= WEAKLY_ACTIVE * (1 + v.abs()))

    def independent(self, theta: Tensor, planned: Planned) -> Tensor:
        """Return whether the directions that the sets hold are independent, `(*batch,)`."""
        sets, order = self.sets, self.sets.order.to(theta.device)
        lam = planned.lam[..., order]
        v = self._optimality.unconstrained(theta)[1][..., order] - times(self._G, lam)
        blocks = sets.freed(sets.jacobians(v + self.gamma * lam, self.gamma), self._weak(v, lam))
        return solve_system(self._G, sets, blocks, torch.zeros_like(lam), self.gamma)[1]

    def _mark_failures(self, theta: Tensor, v0: Tensor, gap: Tensor, failed: Tensor, out: list[Tensor]) -> None:
        """Look for certificates; leave nothing of a sample without a solution."""
        v, lam, weak, active, info = out
        unreachable = self.reduction.rows.unreachable(theta)
        proven = separates_from_set(self._Ct, v0, self.sets, gap)
        info[..., 0] = torch.where(failed & (proven | unreachable), float(Status.INFEASIBLE), info[..., 0])
        for emptied in (v, lam, active, info[..., 3:]):
            emptied[failed] = 0
        weak[failed] = True


class _Find(torch.autograd.Function):
    """(theta, solver) -> v, lam, weak, active, info: constants of every derivative."""

    @staticmethod
    def forward(theta: Tensor, solver: ConvexSolver) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return solver.find(theta)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: Any, *_: Any) -> tuple[None, None]:
        return None, None

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, ...]:
        return (None,) * 5

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        (theta,) = lead_all((args[0],), (in_dims[0],), (1,), info.batch_size)
        outputs = _Find.apply(theta, args[1])
        return outputs, (0,) * len(outputs)
