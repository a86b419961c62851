"""The forward solve: choose an engine, judge each sample by the paper's own optimality map, name what failed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..batching import flatten_batch, times
from ..checks import as_data, is_finite
from ..errors import InfeasibleError, SolveError, Status
from ..problem.projected_kkt import FullSystem
from ..problem.reduction import Reduction
from ..problem.terms import Sizes
from . import kernels
from .active_set import solve_active
from .dual_active_set import SOLVED_FLAG, Daqp, sense_of, solve_daqp
from .infeasibility import infeasibility_certificate
from .newton import ActiveSetResult, solve_newton
from .optimality import BATCHED, SINGLE, Optimality

#: A sample is accepted when F, relative to its own terms, is at most this.
ACCEPTED = 1e-8
#: One sample's multipliers are taken as they are up to this residual; above it the batched way has its turn.
AS_GOOD_AS_POLISHED = 1e-11
#: Up to this many samples on the CPU, NumPy takes one after the other.
FEW = 3
#: Without the compiled kernels, DAQP takes batches up to this size on the CPU and Newton larger ones.
DAQP_BATCH = 16

Engine = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], ActiveSetResult]


class Solved(NamedTuple):
    """The solution of a batch of reduced problems.

    Attributes:
        v: the constrained rows (u, y), within their bounds, `(B, N)`; NaN where there is no solution.
        lam: their multipliers, `(B, N)`; zero where there is no solution.
        active: the rows that count as active in derivatives, `(B, N)`, boolean.
        info: status, iterations, residual, n_active, n_weakly_active of each sample, `(B, 5)`.
    """

    v: Tensor
    lam: Tensor
    active: Tensor
    info: Tensor

    @property
    def failed(self) -> Tensor:
        """Which samples have no accepted solution, `(B,)`."""
        return self.info[..., 0] != Status.SOLVED


class Planned(NamedTuple):
    """The solution as the layer hands it out: `Solved`, with u `(*batch, horizon, n_u)` and y for v."""

    u: Tensor
    y: Tensor
    lam: Tensor
    active: Tensor
    info: Tensor


@dataclass(frozen=True, eq=False)
class Solver:
    """Everything a solve needs besides its tensors.

    Attributes:
        reduction: the reduced problem, without a graph.
        sizes: the parts of theta.
        engine: "auto", "newton" or "daqp".
        on_failure: "raise" or "nan".
        full: the paper's full system, where the backward is to solve that one.
    """

    reduction: Reduction
    sizes: Sizes
    engine: str
    on_failure: str
    full: FullSystem | None = None

    @cached_property
    def _batched(self) -> Optimality:
        return Optimality(self.reduction, BATCHED)

    @cached_property
    def _single(self) -> Optimality:
        return Optimality(self.reduction, SINGLE)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A_theta, C and G of one problem on the CPU."""
        return self.reduction.A_theta.numpy(), self.reduction.rows.C.numpy(), self.reduction.G.contiguous().numpy()

    @cached_property
    def _daqp(self) -> Daqp | None:
        return Daqp(self.reduction.Ct) if self.reduction.Ct.ndim == 2 else None

    def with_failures(self, on_failure: str) -> Solver:
        """Return the same solver, its prepared parts included, with another `on_failure`."""
        other = replace(self, on_failure=on_failure)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k not in ("on_failure",)})
        return other

    def solve(self, theta: Tensor, lower: Tensor, upper: Tensor) -> Planned:
        """Solve for every theta.

        Args:
            theta: (u_ini, y_ini, u_ref, y_ref), `(*batch, n_theta)`, float64.
            lower, upper: bounds `(N,)` or `(*batch, N)`.

        Raises:
            ValueError: values that are not finite.
            InfeasibleError, SolveError: with `on_failure="raise"`, if a sample has no accepted solution.
        """
        daqp_first = self._is_daqp_first(theta)
        if theta.numel() <= FEW * theta.shape[-1]:
            quick = self._one_by_one(theta, lower, upper, daqp_first)
            if quick is not None:
                return quick
        shared_bounds = lower.ndim == upper.ndim == 1
        vectors = (theta,) if shared_bounds else (theta, lower, upper)
        batch, _, (samples, *bounds) = flatten_batch((self.reduction.G,), vectors)
        check_finite(samples, self.sizes)
        lower, upper = bounds if bounds else (lower, upper)
        one_each = self if self.reduction.G.ndim == 2 else replace(self, reduction=self.reduction.of_batch(batch))
        solved = one_each._solve(samples, lower, upper, daqp_first)
        report_failures(solved.info, batch, self.on_failure)
        v, *rest = (x.reshape(*batch, x.shape[-1]) for x in solved)
        return Planned(*self.sizes.split(v), *rest)

    def independent(self, theta: Tensor, planned: Planned) -> Tensor:
        """Return whether the rows held at a bound are independent, `(*batch,)`."""
        batch, _, (active,) = flatten_batch((self.reduction.G,), (planned.active,))
        one_each = self.reduction.of_batch(batch)
        return solve_active(one_each.G, one_each.Ct, active, torch.zeros_like(active, dtype=torch.float64))[1].reshape(
            batch
        )

    def _solve(self, theta: Tensor, lower: Tensor, upper: Tensor, daqp_first: bool) -> Solved:
        """Run the first engine on the batch, the second on what it left."""
        solved = self._attempt(self._engine(daqp_first), theta, lower, upper)
        failed = solved.failed
        if bool(failed.any()):
            rest = failed.nonzero()[:, 0]
            problem = (theta[rest], _take(lower, rest), _take(upper, rest))
            subset = replace(self, reduction=self.reduction.of_samples(rest))
            retried = subset._attempt(subset._engine(not daqp_first), *problem)
            for whole, part in zip(solved, retried, strict=True):
                whole[rest] = part
            subset._mark_failures(solved, rest, *problem)
        return solved

    def _is_daqp_first(self, theta: Tensor) -> bool:
        """Newton is faster, but without its kernel for a few problems with one matrix."""
        if self.engine != "auto":
            return self.engine == "daqp"
        few = theta.device.type == "cpu" and theta.numel() <= DAQP_BATCH * theta.shape[-1]
        return few and self._daqp is not None and not kernels.serve(theta)

    def _engine(self, daqp: bool) -> Engine:
        return partial(solve_daqp, workspace=self._daqp) if daqp else solve_newton

    def _attempt(self, engine: Engine, theta: Tensor, lower: Tensor, upper: Tensor) -> Solved:
        """Run one engine on the batch and judge what it found."""
        a0, v0 = self._batched.unconstrained(theta)
        found = engine(self.reduction.G, self.reduction.Ct, v0, lower, upper)
        judged = self._batched.judge(theta, a0, v0, found.lam, lower, upper)
        failed = ~(found.converged & (judged.residual <= ACCEPTED)) | self.reduction.rows.unreachable(theta)
        info = [failed * Status.FAILED, found.iterations, judged.residual, judged.n_active, judged.n_weakly_active]
        return Solved(judged.v, found.lam, judged.active, torch.stack([i.double() for i in info], dim=-1))

    def _one_by_one(self, theta: Tensor, lower: Tensor, upper: Tensor, daqp_first: bool) -> Planned | None:
        """Solve and judge the samples in NumPy; None where that does not do, or one of them does not convince.

        A value that is not finite does not: the engines flag what comes of it, and the batched way says its name.
        """
        if theta.device.type != "cpu" or not (daqp_first or kernels.serve(theta)):
            return None
        plain = lower.ndim == upper.ndim == 1 and self.reduction.G.ndim == 2 and self.reduction.rows.Eq_range is None
        batch, sample = theta.shape[:-1], theta.numpy()
        if not plain:
            return None
        bounds = lower.numpy(), upper.numpy()
        if not batch:
            one = self._one(sample, *bounds, daqp_first)
            if one is None:
                return None
            v, *rest = one
        else:
            several = [self._one(row, *bounds, daqp_first) for row in sample.reshape(-1, sample.shape[-1])]
            found = [one for one in several if one is not None]
            if not found or len(found) < len(several):
                return None
            v, *rest = (np.stack(x).reshape((*batch, -1)) for x in zip(*found, strict=True))
        return Planned(*map(torch.from_numpy, (*self.sizes.split(v), *rest)))

    def _one(
        self, theta: np.ndarray, lower: np.ndarray, upper: np.ndarray, daqp_first: bool
    ) -> tuple[np.ndarray, ...] | None:
        """Return v, lam, active and info of one sample, as `Solved` describes them; None if they do not convince."""
        a0, v0 = self._single.unconstrained(theta)
        if daqp_first and self._daqp is not None:
            lam, flag, iterations = self._daqp.solve(lower - v0, upper - v0, sense_of(lower == upper))
            solved = flag == SOLVED_FLAG
        else:
            (lam,), (iterations,), (solved,) = kernels.solve_boxes(self.arrays[2], v0[None], lower, upper)
        v, residual, active, n_active, n_weak = self._single.judge(theta, a0, v0, lam, lower, upper)
        if not (solved and residual <= AS_GOOD_AS_POLISHED):  # NaN is not either
            return None
        return v, lam, active, np.array((Status.SOLVED, iterations, residual, n_active, n_weak), dtype=np.float64)

    def _mark_failures(self, solved: Solved, rest: Tensor, theta: Tensor, lower: Tensor, upper: Tensor) -> None:
        """Look for certificates where both engines failed; leave NaN for v and nothing in the multipliers."""
        Ct, unreachable = self.reduction.Ct, self.reduction.rows.unreachable(theta)
        v0 = times(self.reduction.V, theta)
        for k, i in enumerate(rest.tolist()):
            if solved.info[i, 0] == Status.SOLVED:
                continue
            sample = (Ct if Ct.ndim == 2 else Ct[k], v0[k], _row(lower, k), _row(upper, k))
            if bool(unreachable[k]) or infeasibility_certificate(*sample):
                solved.info[i, 0] = Status.INFEASIBLE
            solved.v[i] = torch.nan
            for emptied in (solved.lam[i], solved.active[i], solved.info[i, 3:]):
                emptied.zero_()


def check_finite(theta: Tensor, sizes: Sizes) -> None:
    """Raise ValueError, naming the part of theta that holds it, at a value that is not finite."""
    if is_finite(theta):
        return
    for name, part in zip(("u_ini", "y_ini", "u_ref", "y_ref"), theta.split(sizes.theta, dim=-1), strict=True):
        as_data(name, part)


def report_failures(info: Tensor, batch: torch.Size, on_failure: str) -> None:
    """Raise what the samples without a solution call for, given the info table `(B, 5)`."""
    failed = (info[:, 0] != Status.SOLVED).nonzero()[:, 0]
    if on_failure == "nan" or len(failed) == 0:
        return
    infeasible = (info[failed, 0] == Status.INFEASIBLE).tolist()
    places = [tuple(int(j) for j in torch.unravel_index(i, batch)) if batch else () for i in failed]
    where = f"batch {'index' if len(places) == 1 else 'indices'} {_listed(places)}" if batch else "the problem"
    hint = 'on_failure="nan" marks such samples and returns the others.'
    if all(infeasible):
        why = "no trajectory meets the constraints (the data cannot produce u_ini, or the bounds exclude all)"
        raise InfeasibleError(f"{where}: {why}. {hint}", places)
    worst = float(info[failed, 2].max())
    raise SolveError(
        f"{where}: no engine reached a residual of {ACCEPTED:g} (got {worst:.1e}), and {sum(infeasible)} of "
        f"{len(places)} are proven infeasible. Badly scaled data or weights are the usual reason. {hint}",
        places,
    )


def _listed(places: list[tuple[int, ...]], most: int = 10) -> str:
    names = [str(p[0]) if len(p) == 1 else str(p) for p in places[:most]]
    return ", ".join(names) + (f" and {len(places) - most} more" if len(places) > most else "")


def _take(bound: Tensor, samples: Tensor) -> Tensor:
    return bound if bound.ndim == 1 else bound[samples]


def _row(bound: Tensor, sample: int) -> Tensor:
    return bound if bound.ndim == 1 else bound[sample]
