"""Samples that the engines leave: proven right, solved in extended precision, or proven to have no solution.

The engines work in double precision on the reduced map. A sample they fail on, or whose plan that precision cannot
vouch for, comes here one at a time: its plan is proven on the rows as posed (:mod:`torch_dpc.solve.proof`), or solved
anew by an interior-point method and proven then. What is not proven is marked as FAILED.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ..errors import Status
from ..problem.extended import Extended, Sample
from ..problem.long_double import Array
from ..problem.reduction import Reduction
from ..sets.values import BALL, SetValues, values_of
from .cone_program import Block, Ends, outcome_of
from .engines import Sets
from .outcome import Solved
from .proof import Proof, coefficients, excludes, prove

#: Times that a sample is solved, each from where the charge on flat directions led before.
ROUNDS = 3


@dataclass(frozen=True)
class Settled:
    """A plan with its multipliers, `(N,)` each, in units, and its proof."""

    v: Array
    lam: Array
    proof: Proof


@dataclass(frozen=True, eq=False)
class LastResort:
    """The problems of one reduction in extended precision, made when first asked for.

    Attributes:
        reduction: in the caller's units, without a graph; one problem, or one a sample of a flattened batch.
        unit: of the rows of v, `(N,)`.
    """

    reduction: Reduction
    unit: Tensor
    _kept: dict[int, Extended] = field(default_factory=dict)

    def problem(self, i: int) -> Extended:
        """Return the problem of sample i."""
        i = i if self.reduction.G.ndim > 2 else 0
        if i not in self._kept:
            self._kept[i] = Extended.of_reduction(self.reduction, i, self.unit.cpu().numpy())
        return self._kept[i]

    def look_at(
        self, solved: Solved, theta: Tensor, sets: Sets, doubtful: Tensor
    ) -> dict[tuple[int, ...], Settled | Status]:
        """Return the plans of doubtful samples by their place in the batch, or why there is none.

        What the engines found of the others stands.

        Args:
            solved: what the engines found, in units.
            theta: of the samples, `(*batch, n_theta)`, or one that all share.
            sets: in units.
            doubtful: `(*batch,)`.
        """
        found: dict[tuple[int, ...], Settled | Status] = {}
        batch = doubtful.shape
        values = values_of(sets, batch, theta.device)
        theta = theta.expand(*batch, theta.shape[-1])
        for i, at in _places(doubtful):
            is_solved = bool(solved.info[at][0] == Status.SOLVED)
            if values is None:  # a set of the user's own
                if is_solved:
                    found[at] = Status.FAILED
                continue
            problem, ends = self.problem(i), ends_of(values, i)
            sample = problem.sample(theta[at].cpu().numpy())
            if is_solved and prove(problem, sample, ends, *(x[at].cpu().numpy() for x in (solved.v, solved.lam))).holds:
                continue
            found[at] = settled(problem, sample, ends)
        return found

    def coefficients(self, theta: Tensor, v: Tensor, lam: Tensor, a: Tensor, where: Tensor) -> Tensor:
        """Return a `(*batch, r)` with that of the plans v with multipliers lam, in units, in place of some samples'."""
        a, theta = a.clone(), theta.expand(*where.shape, theta.shape[-1])
        for i, at in _places(where):
            problem = self.problem(i)
            sample = problem.sample(theta[at].cpu().numpy())
            arrays = (x[at].cpu().numpy().astype(np.longdouble) for x in (v, lam))
            accurate = sample.a0 + problem.A @ coefficients(problem, sample, *arrays)
            a[at] = torch.from_numpy(accurate.astype(float)).to(a)
        return a


def settled(problem: Extended, sample: Sample, ends: Ends) -> Settled | Status:
    """Return the plan of a sample, solved anew; INFEASIBLE if that is proven, or FAILED."""
    centre = np.zeros(problem.M.shape[1] - problem.n_xi, dtype=np.longdouble)
    for _ in range(ROUNDS if len(centre) else 1):
        with np.errstate(all="ignore"):  # an iterate that overflows ends the method
            outcome = outcome_of(problem, sample, ends, centre)
        found = [_proven(problem, sample, ends, x, lam) for x, lam in outcome.candidates]
        proven = [one for one in found if one is not None and one.proof.holds]
        if proven:
            return min(proven, key=lambda one: one.proof.gap)
        if excludes(problem, sample, ends, outcome.direction):
            return Status.INFEASIBLE
        centre = outcome.candidates[-1][0][problem.n_xi :]  # the charge on flat directions fades: proximal points
        if not np.isfinite(centre).all():
            break
    return Status.FAILED


def _proven(problem: Extended, sample: Sample, ends: Ends, x: Array, lam: Array) -> Settled | None:
    """Return a candidate in double precision with its proof; None if it is not finite."""
    if not (np.isfinite(x).all() and np.isfinite(lam).all()):
        return None
    v = _within(ends, (sample.c + problem.M @ x).astype(float))
    return Settled(v, lam.astype(float), prove(problem, sample, ends, v, lam.astype(float), lam))


def marked(places: list[tuple[int, ...]], like: Tensor) -> Tensor:
    """Return a boolean tensor that is true at some places."""
    where = torch.zeros_like(like)
    for at in places:
        where[at] = True
    return where


def _places(where: Tensor) -> list[tuple[int, tuple[int, ...]]]:
    """Return the flat and the full index of each true entry."""
    flat = where.reshape(-1).nonzero()[:, 0].tolist()
    return [(i, tuple(int(k) for k in np.unravel_index(i, where.shape)) if where.ndim else ()) for i in flat]


def ends_of(values: SetValues, i: int) -> Ends:
    """Return the sets of sample i."""

    def own(x: Tensor) -> Array:
        return (x if x.ndim == 1 else x[i]).detach().cpu().numpy()

    lower, rows, start = own(values.lower), values.rows.cpu().numpy(), values.start.tolist()
    center, radius = own(values.center).astype(np.longdouble), own(values.radius)
    price = np.full_like(lower, np.inf) if values.price is None else own(values.price)
    blocks = []
    for k, kind in enumerate(values.kind.tolist()):
        part = slice(start[k], start[k + 1])
        blocks.append(Block(rows[part], center[part] if kind == BALL else None, float(radius[k])))
    return Ends(lower, own(values.upper), price, blocks)


def _within(ends: Ends, v: Array) -> Array:
    """Return v with what rounding leaves beyond a hard bound taken away."""
    hard = np.isinf(ends.price)
    return np.where(hard, np.clip(v, ends.lower, ends.upper), v)
