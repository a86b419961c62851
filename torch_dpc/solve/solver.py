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
from ..shapes import broadcast_shapes
from .compiled import CompiledPlanner
from .consistency import coefficients, excess_cost, inconsistency
from .engines import Engines, Sets
from .judge import Judge
from .kernels import PlannedArrays
from .last_resort import LastResort, Settled, marked
from .outcome import ACCEPTANCE, LOGGER, Planned, Solved, check_finite, joined, report_failures
from .screen import Screen
from .second_look import SecondLook
from .selection import uncharged
from .single import SingleSolver


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
    def judge(self) -> Judge:
        """The judge of what engines find."""
        return Judge(self.reduction, self.engines)

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
        may_be_quick = self.engine != "daqp" and self.is_clear
        quick = self.compiled.solve(theta, sets) if self.compiled is not None and may_be_quick else None
        if quick is not None and not sets.is_box:
            lam, v = torch.from_numpy(quick.lam), torch.from_numpy(quick.v)
            quick.convinces[...] &= self.screen.vouches(theta, lam, v).numpy().reshape(quick.convinces.shape)
        if quick is not None and quick.convinces.all():
            return self._planned(quick.v, quick.lam, quick.active, quick.info, quick.weak, sets)
        if self.single is not None and self.is_clear and isinstance(sets, Bounds):
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
        own = in_units(sets, self.unit)
        solved = self.in_units._solve_flat(theta, own)
        self._settle(solved, theta, own)
        return solved._replace(v=solved.v * self.unit, lam=solved.lam / self.unit)

    @property
    def is_clear(self) -> bool:
        """Whether double precision vouches for plans: one optimum, by a map whose verification needed no more."""
        return self.reduction.excess is None and not self.reduction.is_selection

    def _doubtful(self, solved: Solved, theta: Tensor, sets: Sets) -> Tensor:
        """Return the samples that the last resort looks at, `(*batch,)`."""
        failed = solved.failed
        lost = (solved.info[..., 0] == Status.FAILED) if self.is_clear else failed  # where clear, a certificate holds
        lost = lost & ~self.reduction.rows.unreachable(theta)
        if self.is_clear and sets.is_box:
            return lost
        if not self.is_clear and not sets.is_box:
            return lost | ~failed
        lam, v = solved.lam / self.unit, solved.v * self.unit
        if self.is_clear:
            return lost | (~failed & ~self.screen.vouches(theta, lam, v))
        excess = excess_cost(self.reduction, theta, coefficients(self.reduction, theta, lam, v), lam, v)
        return lost | (~failed & ~(excess <= ACCEPTANCE.excess))

    @cached_property
    def screen(self) -> Screen:
        """The screen of plans whose sets are no boxes."""
        return Screen.of(self.reduction)

    def _settle(self, solved: Solved, theta: Tensor, sets: Sets) -> None:
        """Have the last resort prove, solve or refuse what the engines leave; all in units, in place."""
        doubtful = self._doubtful(solved, theta, sets)
        if not bool(doubtful.any()):
            return
        found = self._resort_of(doubtful.shape).look_at(solved, theta, sets, doubtful)
        for status in (Status.FAILED, Status.INFEASIBLE):
            places = [at for at, why in found.items() if why is status]
            solved.empty(marked(places, like=doubtful), status)
        plans = {at: plan for at, plan in found.items() if isinstance(plan, Settled)}
        if not plans:
            return
        v, lam = torch.nan_to_num(solved.v), solved.lam.clone()
        for at, plan in plans.items():
            v[at], lam[at] = torch.from_numpy(plan.v).to(v), torch.from_numpy(plan.lam).to(v)
        judged = self.in_units.judge.judged(v, lam, sets, torch.zeros((), device=v.device), solved.info[..., 1])
        for at, plan in plans.items():
            solved.put(at, judged._replace(v=v).at(at))
            solved.info[at][0], solved.info[at][2] = float(Status.SOLVED), plan.proof.residual

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

    def accurate_coefficients(self, theta: Tensor, v: Tensor, lam: Tensor, a: Tensor, where: Tensor) -> Tensor:
        """Return a `(*batch, r)` with that of some samples computed in extended precision.

        v, lam as in `Solved`; entries of v that are NaN are unknown.
        """
        return self._resort_of(where.shape).coefficients(theta, v / self.unit, lam * self.unit, a, where)

    def _resort_of(self, batch: torch.Size) -> LastResort:
        """What settles the samples that no engine does."""
        shared = self.reduction.G.ndim == 2
        return self._last_resort if shared else LastResort(self.reduction.of_batch(batch), self.unit)

    @cached_property
    def _last_resort(self) -> LastResort:
        return LastResort(self.reduction, self.unit)

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
        v0 = self.judge.optimality.unconstrained(theta)
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
        raw, error = self.judge.optimality.displaced(v0, found.lam), self.judge.optimality.error(theta, found.lam)
        solved = self.judge.judged(raw, found.lam, sets, error, found.iterations)
        doubtful = ~(solved.info[..., 2] <= ACCEPTANCE.convincing)
        solved.info[..., 2] -= torch.where(doubtful, 0.0, error)  # a bound that convinces is not part of what is told
        if bool(doubtful.any()):
            self._look_again(solved, theta, moved, sets, doubtful)
        if self.reduction.is_selection:
            a = coefficients(self.reduction, theta, solved.lam, solved.v)
            missed = inconsistency(self.reduction, a, solved.v)
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
        step = partial(solver.judge.step, sets=sets, held=before.lam != 0)
        look = SecondLook(solver.reduction)
        lam, raw = look.polished(theta, before.lam, moved, step)
        judged = solver.judge.judged(raw, lam, sets, look.missed_equalities(theta, lam), before.info[..., 1])
        better = judged.info[..., 2] < before.info[..., 2]
        better = better & doubtful if where is doubtful else better
        solved.put(better if where is doubtful else where[better], judged.map(lambda x: x[better]))

    def _mark_failures(self, solved: Solved, theta: Tensor, v0: Tensor, gap: Tensor | None, sets: Sets) -> None:
        """Look for certificates; leave NaN for v and nothing else of a sample without a solution."""
        failed = solved.failed
        proven = self.judge.infeasible(failed, v0, gap, sets) | self.reduction.rows.unreachable(theta)
        solved.empty(failed & ~proven, Status.FAILED)
        solved.empty(failed & proven, Status.INFEASIBLE)
