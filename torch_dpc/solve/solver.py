"""The forward solve of any problem.

Choose an engine, judge every sample by the paper's F, try the second engine where the first one failed, and look for a
certificate of infeasibility where both did.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from ..batching import flatten_batch
from ..errors import Status
from ..problem.projected_kkt import FullSystem
from ..problem.reduction import Reduction
from ..problem.terms import Sizes
from ..sets.blocks import Blocks
from ..sets.bounds import Bounds
from ..sets.feasible import FeasibleSet
from ..sets.units import in_units
from ..sets.values import values_of
from ..shapes import broadcast_shapes
from . import kernels
from .active_set import solve_active
from .certificate import is_infeasible
from .compiled import CompiledPlanner
from .consistency import excess_cost, inconsistency
from .engines import Engines, Sets
from .kernels import PlannedArrays
from .optimality import BATCHED, Optimality
from .outcome import ACCEPTANCE, LOGGER, JudgedSets, Planned, Solved, check_finite, joined, report_failures
from .projected_system import newton_step
from .second_look import SecondLook
from .selection import uncharged
from .single import SingleSolver
from .weakness import WEAKLY_ACTIVE, is_without_multiplier

#: Eigenvalues of D below this hold their direction: it counts as active.
HELD = 1e-9


@dataclass(frozen=True, eq=False)
class Solver:
    """Everything a solve needs besides its tensors.

    Attributes:
        reduction: the reduced problem, without a graph.
        sizes: the parts of theta and of v.
        structure: the sets, which parts they have and of which rows; None for boxes. Parameters are given to `solve`.
        engine: "auto", "newton" or "daqp".
        full: the paper's full system, if derivatives are to come from that.
    """

    reduction: Reduction
    sizes: Sizes
    structure: FeasibleSet | None
    engine: str
    full: FullSystem | None = None

    @cached_property
    def engines(self) -> Engines:
        """The engines of this problem."""
        return Engines(self.reduction, self.structure)

    @cached_property
    def unit(self) -> Tensor:
        """The units in which the rows of v are solved and judged, `(N,)`: one for all problems of a batch."""
        unit = self.reduction.scale.reshape(-1, self.sizes.v).amax(0)
        if self.structure is None:
            return unit
        return self.structure.largest_of_coupled(unit[self.engines.order])[self.engines.inverse]

    @cached_property
    def in_units(self) -> Solver:
        """The same problem for v / unit. What is small or near for a row is small or near 1 there."""
        return replace(self, reduction=self.reduction.in_units(self.unit))

    @cached_property
    def single(self) -> SingleSolver | None:
        """The fast path of single samples; None if there is none for this problem."""
        return SingleSolver.of(self.reduction, self.in_units.reduction, self.sizes, self.in_units.engines, self.unit)

    @cached_property
    def compiled(self) -> CompiledPlanner | None:
        """Whole plans by the compiled kernel; None if it does not take this problem."""
        return CompiledPlanner.of(self.in_units.reduction, self.unit)

    @cached_property
    def optimality(self) -> Optimality:
        """The paper's F, for batches."""
        return Optimality(self.reduction, BATCHED)

    def solve(self, theta: Tensor, sets: Sets, on_failure: str) -> Planned:
        """Solve for every theta, without a graph.

        Args:
            theta: (u_ini, y_ini, u_ref, y_ref), `(*batch, n_theta)`, float64.
            sets: with present parameters, without a graph.
            on_failure: "raise" or "nan".

        Raises:
            ValueError: values that are not finite.
            InfeasibleError, SolveError: with `on_failure="raise"`, if a sample has no accepted solution.
        """
        quick = self.compiled.solve(theta, sets) if self.compiled is not None and self.engine != "daqp" else None
        if quick is not None and quick.convinces.all():
            return self._planned(quick.v, quick.lam, quick.active, quick.info, quick.weak, sets)
        if self.single is not None and isinstance(sets, Bounds):
            planned = self.single.solve(theta, sets, self.engine)
            if planned is not None:
                return planned
        solved = self._solve_generally(theta, sets) if quick is None else self._completed(quick, theta, sets)
        report_failures(solved.info, on_failure)
        return self._planned(*solved, sets)

    def _planned(self, v: Any, lam: Any, active: Any, info: Any, weak: Any, sets: Sets) -> Planned:
        """Return tensors or arrays as the plan."""
        found = [*self.sizes.split(v), lam, active, info]
        if not sets.is_box:
            found += [v[..., self.sizes.u + self.sizes.y :], weak]
        return Planned(*(x if isinstance(x, Tensor) else torch.from_numpy(x) for x in found))

    def _solve_generally(self, theta: Tensor, sets: Sets) -> Solved:
        """Solve by engines, judge, second look and certificate, whatever the problem."""
        check_finite(theta, self.sizes)
        solved = self.in_units._solve_flat(theta, in_units(sets, self.unit))
        solved = solved._replace(v=solved.v * self.unit, lam=solved.lam / self.unit)
        if self.reduction.is_selection:
            excess = excess_cost(self.reduction, theta, solved.lam, solved.v)
            solved.empty(~solved.failed & ~(excess <= ACCEPTANCE.excess), Status.FAILED)
        return solved

    def _completed(self, quick: PlannedArrays, theta: Tensor, sets: Sets) -> Solved:
        """Solve the samples generally that do not convince."""
        if theta.ndim != 2 or not (isinstance(sets, Bounds) or not sets.batch_shape):
            return self._solve_generally(theta, sets)
        v, lam, active, weak, info, convinces = map(torch.from_numpy, quick)
        solved = Solved(v, lam, active, info, None if sets.is_box else weak)
        rest = (~convinces).nonzero()[:, 0]
        part = sets.of_samples(rest) if isinstance(sets, Bounds) else sets
        LOGGER.debug("the compiled kernel left %d of %d samples to the engines", len(rest), len(theta))
        solved.put(rest, self._solve_generally(theta[rest], part))
        return solved

    def jacobian(self, planned: Planned, sets: Sets) -> Blocks:
        """Return D, the Jacobian of the projection at a solution, as :class:`ProjectedSystem` takes it."""
        if isinstance(sets, Bounds):
            return [planned.active]
        assert planned.weak is not None
        v = joined(self.sizes, planned.u, planned.y, planned.du, planned.lam)
        v, lam, weak = (x[..., self.engines.order] for x in (torch.nan_to_num(v), planned.lam, planned.weak))
        return sets.freed(sets.jacobians(v + self.engines.gamma * lam, self.engines.gamma), weak)

    def independent(self, planned: Planned, sets: Sets) -> Tensor:
        """Return whether the directions that the sets hold are independent, `(*batch,)`."""
        G, lam = self.reduction.G, planned.lam
        if self.structure is not None:
            G, lam = self.engines.G_in_parts, lam[..., self.engines.order]
        return self.engines.system.is_regular(G, self.jacobian(planned, sets), lam)

    def _solve_flat(self, theta: Tensor, sets: Sets) -> Solved:
        """Solve samples with one batch dimension; with those of the sets if their parameters have any."""
        if isinstance(sets, FeasibleSet) and sets.batch_shape:
            batch = broadcast_shapes(theta.shape[:-1], sets.batch_shape, self.reduction.V.shape[:-2])
            return self._solve_all(theta.expand(*batch, theta.shape[-1]), sets)
        vectors = (theta, *sets.tensors) if isinstance(sets, Bounds) and not sets.are_shared else (theta,)
        batch, _, (samples, *bounds) = flatten_batch((self.reduction.G,), vectors)
        sets = sets.with_tensors(bounds) if bounds else sets
        shared = self.reduction.G.ndim == 2
        solver = self if shared else replace(self, reduction=self.reduction.of_batch(batch))
        solved = solver._solve_all(samples, sets)
        return solved.map(lambda x: x.reshape(*batch, x.shape[-1]))

    def _solve_all(self, theta: Tensor, sets: Sets) -> Solved:
        """Run the first engine on all samples, the next one on those that it left."""
        v0 = self.optimality.unconstrained(theta)
        first, *others = self.engines.in_order(self.engine, v0, sets)
        solved, gap = self._attempt(first, theta, v0, sets)
        for name in others:
            rest = solved.failed.nonzero()[:, 0]
            if len(rest) == 0:
                return solved
            LOGGER.info("%s left %d of %d samples, %s solves them", first, len(rest), len(theta), name)
            assert isinstance(sets, Bounds)
            retried, _ = self._of_samples(rest)._attempt(name, theta[rest], v0[rest], sets.of_samples(rest))
            solved.put(rest, retried)
        if bool(solved.failed.any()):
            self._mark_failures(solved, theta, v0, gap, sets)
        return solved

    def _of_samples(self, samples: Tensor) -> Solver:
        """Return the solver of some samples of a flattened batch; itself if all samples share one problem."""
        shared = self.reduction.G.ndim == 2
        return self if shared else replace(self, reduction=self.reduction.of_samples(samples))

    def _attempt(self, engine: str, theta: Tensor, v0: Tensor, sets: Sets) -> tuple[Solved, Tensor | None]:
        """Run one engine and judge what it found; return the gap that it saw as well."""
        if self.reduction.is_selection:
            found, moved = uncharged(self.reduction, v0, partial(self.engines.run, engine, sets=sets))
            v0 = v0 + moved
        else:
            found, moved = self.engines.run(engine, v0, sets), torch.zeros(())
        raw, error = self.optimality.displaced(v0, found.lam), self.optimality.error(theta, found.lam)
        solved = self._judged(raw, found.lam, sets, error, found.iterations)
        doubtful = ~(solved.info[..., 2] <= ACCEPTANCE.convincing)
        solved.info[..., 2] -= torch.where(doubtful, 0.0, error)  # a bound that convinces is not part of what is told
        if bool(doubtful.any()):
            self._look_again(solved, theta, moved, sets, doubtful)
        if self.reduction.is_selection:
            missed = inconsistency(self.reduction, theta, solved.lam, solved.v)
            solved.info[..., 0][~(missed <= ACCEPTANCE.of_selection)] = int(Status.FAILED)
            solved.info[..., 2] = torch.maximum(solved.info[..., 2], missed)
        solved.info[..., 0][self.reduction.rows.unreachable(theta)] = int(Status.FAILED)
        return solved, found.gap

    def _look_again(self, solved: Solved, theta: Tensor, moved: Tensor, sets: Sets, doubtful: Tensor) -> None:
        """Judge doubtful samples anew by the map in extended precision, their multipliers polished."""
        if isinstance(sets, FeasibleSet) and sets.batch_shape:
            solver, before, where = self, solved, doubtful  # the sets cannot be had sample by sample: all of them
        else:
            where = doubtful.nonzero()[:, 0]
            solver, theta, before = self._of_samples(where), theta[where], solved.map(lambda x: x[where])
            moved = moved[where] if moved.ndim else moved
        if isinstance(sets, Bounds):
            sets = sets.of_samples(where)
        step = partial(solver._step, sets=sets, held=before.lam != 0)
        look = SecondLook(solver.reduction)
        lam, raw = look.polished(theta, before.lam, moved, step)
        judged = solver._judged(raw, lam, sets, look.missed_equalities(theta, lam), before.info[..., 1])
        better = judged.info[..., 2] < before.info[..., 2]
        better = better & doubtful if where is doubtful else better
        solved.put(better if where is doubtful else where[better], judged.map(lambda x: x[better]))

    def _step(self, raw: Tensor, lam: Tensor, sets: Sets, held: Tensor) -> Tensor:
        """Return Newton's step on the multipliers; for boxes on those of the rows that are held."""
        if isinstance(sets, Bounds):
            on = torch.where(lam > 0, sets.upper, sets.lower)
            missed = torch.where(held & on.isfinite(), raw - on, 0.0)
            return solve_active(self.reduction.G, self.reduction.Ct, held, missed)[0]
        order, inverse, gamma = self.engines.order, self.engines.inverse, self.engines.gamma
        pushed = raw[..., order] + gamma * lam[..., order]
        missed = raw[..., order] - sets.prox(pushed, gamma)
        return newton_step(self.engines.G_in_parts, sets, sets.jacobians(pushed, gamma), missed, gamma)[..., inverse]

    def _judged(self, raw: Tensor, lam: Tensor, sets: Sets, error: Tensor, iterations: Tensor) -> Solved:
        """Judge multipliers, given V theta - G lam and its error."""
        judge = self._judge_box if isinstance(sets, Bounds) else self._judge_sets
        v, residual, active, weak, counts = judge(raw, lam, sets, error)  # type: ignore[arg-type]
        failed = ~(residual <= ACCEPTANCE.residual)
        info = torch.stack([x.double() for x in (failed * Status.FAILED, iterations, residual, *counts)], dim=-1)
        return Solved(v, lam, active, info, weak)

    def _judge_box(self, raw: Tensor, lam: Tensor, sets: Bounds, error: Tensor) -> JudgedSets:
        v, residual, active, n_active, n_weakly_active = self.optimality.judge(raw, lam, *sets.tensors, error)
        return JudgedSets(v, residual, active, None, (n_active, n_weakly_active))

    def _judge_sets(self, raw: Tensor, lam: Tensor, sets: FeasibleSet, error: Tensor) -> JudgedSets:
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

    def _mark_failures(self, solved: Solved, theta: Tensor, v0: Tensor, gap: Tensor | None, sets: Sets) -> None:
        """Look for certificates; leave NaN for v and nothing else of a sample without a solution."""
        failed = solved.failed
        Ct, unreachable = self.reduction.Ct, self.reduction.rows.unreachable(theta)
        if isinstance(sets, Bounds):
            rest = failed.nonzero()[:, 0]
            proven = torch.zeros_like(failed)
            proven[rest] = is_infeasible(Ct if Ct.ndim == 2 else Ct[rest], v0[rest], sets.of_samples(rest), None)
        else:
            order = self.engines.order
            proven = is_infeasible(Ct[..., order, :], v0[..., order], sets, None if gap is None else gap[..., order])
        solved.empty(failed & ~(proven | unreachable), Status.FAILED)
        solved.empty(failed & (proven | unreachable), Status.INFEASIBLE)
