"""What the optimality conditions say of multipliers, for any sets, and Newton's step towards them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..batching import flatten_batch
from ..errors import Status
from ..problem.reduction import Reduction
from ..sets.bounds import Bounds
from ..sets.feasible import FeasibleSet
from ..sets.values import values_of
from . import kernels
from .active_set import solve_active
from .certificate import is_infeasible
from .engines import Engines, Sets
from .optimality import BATCHED, Optimality
from .outcome import ACCEPTANCE, JudgedSets, Solved
from .projected_system import newton_step
from .weakness import WEAKLY_ACTIVE, is_without_multiplier

#: Eigenvalues of D below this hold their direction: it counts as active.
HELD = 1e-9


@dataclass(frozen=True, eq=False)
class Judge:
    """The judge of one reduced problem in units.

    Attributes:
        reduction: the reduced problem, without a graph.
        engines: of the problem, for the order of its parts and the scale of its multipliers.
    """

    reduction: Reduction
    engines: Engines

    @cached_property
    def optimality(self) -> Optimality:
        """The optimality conditions, for batches."""
        return Optimality(self.reduction, BATCHED)

    def step(self, raw: Tensor, lam: Tensor, sets: Sets, held: Tensor) -> Tensor:
        """Return Newton's step on the multipliers; for boxes on those of the rows that are held."""
        if isinstance(sets, Bounds):
            on = torch.where(lam > 0, sets.upper, sets.lower)
            missed = torch.where(held & on.isfinite(), raw - on, 0.0)
            return solve_active(self.reduction.G, self.reduction.Ct, held, missed)[0]
        order, inverse, gamma = self.engines.order, self.engines.inverse, self.engines.gamma
        pushed = raw[..., order] + gamma * lam[..., order]
        missed = raw[..., order] - sets.prox(pushed, gamma)
        return newton_step(self.engines.G_in_parts, sets, sets.jacobians(pushed, gamma), missed, gamma)[..., inverse]

    def judged(self, raw: Tensor, lam: Tensor, sets: Sets, error: Tensor, iterations: Tensor) -> Solved:
        """Judge multipliers, given V theta - G lam and its error."""
        judge = self._of_box if isinstance(sets, Bounds) else self._of_sets
        v, residual, active, weak, counts = judge(raw, lam, sets, error)  # type: ignore[arg-type]
        failed = ~(residual <= ACCEPTANCE.residual)
        info = torch.stack([x.double() for x in (failed * Status.FAILED, iterations, residual, *counts)], dim=-1)
        return Solved(v, lam, active, info, weak)

    def _of_box(self, raw: Tensor, lam: Tensor, sets: Bounds, error: Tensor) -> JudgedSets:
        v, residual, active, n_active, n_weakly_active = self.optimality.judge(raw, lam, *sets.tensors, error)
        return JudgedSets(v, residual, active, None, (n_active, n_weakly_active))

    def _of_sets(self, raw: Tensor, lam: Tensor, sets: FeasibleSet, error: Tensor) -> JudgedSets:
        """Judge with the projection onto the sets; count the directions that D holds, block by block."""
        batch, G = raw.shape[:-1], self.reduction.G
        values = values_of(sets, batch, raw.device)
        if values is not None and kernels.has_kernel_for(raw, values):
            _, (G,), (flat, multipliers) = flatten_batch((G,), (raw, lam))
            verdict = kernels.judge_sets(G, flat, multipliers, values)
            v, missed, weak, active, of_each = (x.reshape(*batch, x.shape[-1]) for x in verdict)
            residual = self.optimality.residual(lam, missed, error)
            return JudgedSets(v, residual, active, weak, (of_each[..., 0], of_each[..., 1]))
        order, inverse, gamma = self.engines.order, self.engines.inverse, self.engines.gamma
        raw = raw[..., order]
        lam_in_parts, diagonal = lam[..., order], self.engines.G_in_parts.diagonal(dim1=-2, dim2=-1)
        # No multiplier moves a row that the equalities decide, and no price does.
        step = torch.where(sets.largest_of_group(diagonal) > 0, gamma, 0.0)
        v = sets.prox(raw + step * lam_in_parts, step)
        missed = (raw - v).abs() / (1 + sets.largest_of_coupled(v.abs()))
        residual = self.optimality.residual(lam, missed, error)
        weak = sets.weak(v, is_without_multiplier(v, lam_in_parts, diagonal)).expand_as(v)
        d, _ = sets.spectral(sets.freed(sets.jacobians(v + gamma * lam_in_parts, gamma), weak))
        active = (d < HELD).expand_as(v)
        counts = active.sum(-1), sets.touching(v, weak, WEAKLY_ACTIVE).expand(v.shape[:-1])
        return JudgedSets(v[..., inverse], residual, active[..., inverse], weak[..., inverse], counts)

    def infeasible(self, failed: Tensor, v0: Tensor, gap: Tensor | None, sets: Sets) -> Tensor:
        """Return which failed samples are proven to have no solution, `(*batch,)`; the gap is that of the engine."""
        Ct = self.reduction.Ct
        if isinstance(sets, Bounds):
            rest, proven = failed.nonzero()[:, 0], torch.zeros_like(failed)
            proven[rest] = is_infeasible(Ct if Ct.ndim == 2 else Ct[rest], v0[rest], sets.of_samples(rest), None)
            return proven
        order = self.engines.order
        return is_infeasible(Ct[..., order, :], v0[..., order], sets, None if gap is None else gap[..., order])
