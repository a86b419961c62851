"""What engines find and what a solve returns; which samples are accepted; how failures are reported."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..checks import as_data, is_finite
from ..errors import InfeasibleError, SolveError, Status
from ..problem.terms import Sizes

LOGGER = logging.getLogger("torch_dpc.solve")


@dataclass(frozen=True)
class Acceptance:
    """Which solutions are accepted.

    Attributes:
        residual: largest residual of an accepted sample (:mod:`torch_dpc.solve.optimality`).
        convincing: residual above which a sample gets a second look in extended precision.
        of_selection: largest amount by which the best g may miss a plan that moved along the kernel of the cost.
        excess: largest cost of such a plan beyond the optimum, relative to it.
    """

    residual: float = 1e-8
    convincing: float = 1e-9
    of_selection: float = 1e-7
    excess: float = 1e-7


ACCEPTANCE = Acceptance()


@dataclass
class Found:
    """What an engine found for each sample.

    Attributes:
        lam: multipliers, `(B, N)`, in the order of v.
        iterations: steps, `(B,)`, int64.
        converged: whether the engine reached its own tolerance, `(B,)`, boolean.
        gap: a guess of the shortest vector from the sets to the trajectories, `(B, N)`, for the certificate of
            infeasibility; None if the engine has none.
    """

    lam: Tensor
    iterations: Tensor
    converged: Tensor
    gap: Tensor | None = None


class Solved(NamedTuple):
    """The solution of a batch of reduced problems.

    Attributes:
        v: the constrained rows (u, y, du, slack), within their sets, `(*batch, N)`; NaN without a solution.
        lam: their multipliers, `(*batch, N)`; zero without a solution.
        active: the rows that count as active in derivatives, `(*batch, N)`, boolean.
        info: status, iterations, residual, n_active, n_weakly_active of each sample, `(*batch, 5)`, float64.
        weak: the rows whose multiplier counts as zero, `(*batch, N)`, boolean; None for boxes, where `active` says it.
    """

    v: Tensor
    lam: Tensor
    active: Tensor
    info: Tensor
    weak: Tensor | None = None

    @property
    def failed(self) -> Tensor:
        """Which samples have no accepted solution, `(*batch,)`."""
        return self.info[..., 0] != Status.SOLVED

    def map(self, change: Callable[[Tensor], Tensor]) -> Solved:
        """Return the solution with each tensor changed."""
        weak = None if self.weak is None else change(self.weak)
        return Solved(change(self.v), change(self.lam), change(self.active), change(self.info), weak)

    def at(self, place: tuple[int, ...]) -> Solved:
        """Return the solution of one sample."""
        return self.map(lambda x: x[place])

    def put(self, samples: Tensor | tuple[int, ...], part: Solved) -> None:
        """Write the solution of some samples in place."""
        for whole, of_samples in zip(self, part, strict=True):
            if whole is not None and of_samples is not None:
                whole[samples] = of_samples

    def empty(self, samples: Tensor, status: Status) -> None:
        """Leave NaN for v, and nothing else but the status, of some samples `(*batch,)`, boolean, in place."""
        self.info[..., 0] = torch.where(samples, float(status), self.info[..., 0])
        self.v[samples] = torch.nan
        for emptied in (self.lam, self.active, self.info[..., 3:]):
            emptied[samples] = 0
        if self.weak is not None:
            self.weak[samples] = True


class JudgedSets(NamedTuple):
    """What the conditions say of a batch: v, residual, active and weak rows, n_active and n_weakly_active."""

    v: Tensor
    residual: Tensor
    active: Tensor
    weak: Tensor | None
    counts: tuple[Tensor, Tensor]


class Planned(NamedTuple):
    """The solution as the autograd Function returns it.

    Attributes:
        u, y: the plan, `(*batch, horizon, n)`; NaN without a solution.
        lam, active, info: as in :class:`Solved`.
        du: the rows of v after u and y, `(*batch, n)`, and
        weak: as in :class:`Solved`; both None for boxes, whose derivative needs neither.
    """

    u: Tensor
    y: Tensor
    lam: Tensor
    active: Tensor
    info: Tensor
    du: Tensor | None = None
    weak: Tensor | None = None

    def without(self, samples: Tensor) -> Planned:
        """Return the solution with some samples, `(*batch,)`, marked as failed."""
        lost = samples.expand(self.info.shape[:-1])[..., None]
        info = torch.zeros_like(self.info)
        info[..., 0], info[..., 2] = float(Status.FAILED), torch.nan
        return Planned(
            torch.where(lost[..., None], torch.nan, self.u),
            torch.where(lost[..., None], torch.nan, self.y),
            torch.where(lost, 0.0, self.lam),
            self.active & ~lost,
            torch.where(lost, info, self.info),
            None if self.du is None else torch.where(lost, torch.nan, self.du),
            None if self.weak is None else self.weak | lost,
        )


def joined(sizes: Sizes, u: Tensor | None, y: Tensor | None, du: Tensor | None, like: Tensor) -> Tensor:
    """Return v `(*batch, N)` of its parts u, y `(*batch, horizon, n)` and du `(*batch, n)`; zero for None."""
    v = sizes.join(u, y, like)
    return v if du is None or not sizes.more else torch.cat([v[..., : sizes.u + sizes.y], du], dim=-1)


def check_finite(theta: Tensor, sizes: Sizes) -> None:
    """Raise ValueError, naming the part of theta, at a value that is not finite."""
    if is_finite(theta):
        return
    for name, part in zip(("u_ini", "y_ini", "u_ref", "y_ref"), theta.split(sizes.theta, dim=-1), strict=True):
        as_data(name, part)


def report_failures(info: Tensor, on_failure: str) -> None:
    """Raise if a sample failed and `on_failure` is "raise"; log it if it is "nan".

    Args:
        info: as in :class:`Solved`, `(*batch, 5)`.
        on_failure: "raise" or "nan".

    Raises:
        InfeasibleError: every failed sample is proven infeasible.
        SolveError: another failure.
    """
    if not bool((info[..., 0] != Status.SOLVED).any()):
        return
    if on_failure == "nan":
        without = [int((info[..., 0] == status).sum()) for status in (Status.INFEASIBLE, Status.FAILED)]
        LOGGER.info("no plan for %d samples: %d proven infeasible, %d failed", sum(without), *without)
        return
    batch, info = info.shape[:-1], info.reshape(-1, info.shape[-1])
    failed = (info[:, 0] != Status.SOLVED).nonzero()[:, 0]
    infeasible = (info[failed, 0] == Status.INFEASIBLE).tolist()
    places = [tuple(int(j) for j in torch.unravel_index(i, batch)) if batch else () for i in failed]
    where = f"batch {'index' if len(places) == 1 else 'indices'} {_listed(places)}" if batch else "the problem"
    hint = 'on_failure="nan" marks such samples and returns the others.'
    if all(infeasible):
        why = "no trajectory meets the constraints (the data cannot produce u_ini, or the bounds exclude all)"
        raise InfeasibleError(f"{where}: {why}. {hint}", places)
    worst = float(info[failed, 2].max())
    raise SolveError(
        f"{where}: no engine reached a residual of {ACCEPTANCE.residual:g} (got {worst:.1e}), and {sum(infeasible)} of "
        f"{len(places)} are proven infeasible. Badly scaled data or weights are the usual reason. {hint}",
        places,
    )


def _listed(places: list[tuple[int, ...]], most: int = 10) -> str:
    names = [str(p[0]) if len(p) == 1 else str(p) for p in places[:most]]
    return ", ".join(names) + (f" and {len(places) - most} more" if len(places) > most else "")
