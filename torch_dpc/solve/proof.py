"""The proof that a plan is right: feasible for the problem as posed, and a primal-dual gap that is nothing.

For multipliers lam that the sets admit, duality bounds the cost of every plan from below. With the slope of the
Lagrangian in x = (xi, eta) (:mod:`torch_dpc.problem.extended`), s = A' grad f(a) + M'lam, a plan costs at most

    gap = price(v) + support(lam) - lam'v + 1/2 |s_xi|^2 + |s_eta|' reach

more than the best one, whoever found it and lam. Along eta the cost has no curvature: a slope that is left there pays
for as far as a plan may go. All of it is in extended precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..problem.extended import Extended, Sample
from ..problem.long_double import Array, back, triangle
from .cone_program import Ends, without_work
from .consistency import NEGLIGIBLE, REACH


@dataclass(frozen=True)
class ProofSettings:
    """What counts as nothing.

    Attributes:
        gap: relative to the cost;
        of_reference: or the cost of missing every reference by this much of its channel's unit,
        of_start: and every measured output by this much.
        row: by which a row or a set may be missed, relative to 1 + |v| in units.
        reach: plans go no further along directions without cost, relative to 1 + |a|.
        pulls: of v on the coefficients, relative to the curvature of the cost, in the order tried; see `coefficients`.
        near: coefficients are taken that are this near v, relative to 1 + |v|.
        charge: root of the charge on directions without cost: v decides, and the least |g| beyond.
        apart: a certificate must separate by this, relative to its terms.
        met: what a certificate leaves of a column of M, relative to its terms, counts as zero.
        faint: entries of a certificate below this fraction of its largest count as zero.
    """

    gap: float = 1e-7
    of_reference: float = NEGLIGIBLE
    of_start: float = 1e-11
    row: float = 1e-8
    reach: float = REACH
    pulls: tuple[float, ...] = (1e6, 1e9, 1e12, 1e15)
    near: float = 1e-9
    charge: float = 1e-9
    apart: float = 1e-8
    met: float = 1e-14
    faint: float = 1e-12


SETTINGS = ProofSettings()


@dataclass(frozen=True)
class Proof:
    """What is known of a plan: how far it is from the equalities, its own rows and its sets, relative to 1 + |v|."""

    cost: float
    gap: float
    negligible: float
    missed: float

    @property
    def holds(self) -> bool:
        """Whether the plan is right."""
        return self.missed <= SETTINGS.row and self.gap <= SETTINGS.gap * self.cost + self.negligible

    @property
    def residual(self) -> float:
        """The worst of what is missed and of the gap relative to the cost."""
        return max(self.missed, self.gap / max(self.cost, self.negligible, 1e-300))


def coefficients(problem: Extended, sample: Sample, v: Array, lam: Array) -> Array:
    """Return x of the plan v `(N,)` with multipliers lam, both in units.

    It is the minimiser of the augmented Lagrangian 1/2 |xi - xi0|^2 + lam'M x + 1/2 |w (c + M x - v)|^2: near v, at a
    cost of no more than the optimum where lam is right.
    """
    known = np.isfinite(v)
    x = np.zeros(problem.M.shape[1], dtype=np.longdouble)
    for pull in SETTINGS.pulls:
        x = _pulled(problem, sample, np.where(known, v, 0), lam, known, pull)
        missed = np.where(known, sample.c + problem.M @ x - v, 0)
        if (np.abs(missed) / (1 + np.abs(v))).max(initial=0.0, where=known) <= SETTINGS.near:
            break
    return x


def _pulled(problem: Extended, sample: Sample, v: Array, lam: Array, known: Array, pull: float) -> Array:
    M, k, n = problem.M, problem.n_xi, problem.M.shape[1]
    size = np.sqrt(np.square(M).sum(axis=1))
    pulls = known & (size > 0)
    w = np.sqrt(pull) / size[pulls]
    eye = np.eye(n, dtype=np.longdouble)
    eye[range(k, n), range(k, n)] = SETTINGS.charge
    wanted = w * (v - sample.c)[pulls] - lam[pulls] / w
    pushed = lam[~known] @ M[~known]  # rows that are not known keep their multipliers
    target = np.concatenate([sample.xi0 - pushed[:k], -pushed[k:] / SETTINGS.charge, wanted])
    R, rotated, order = triangle(np.concatenate([eye, w[:, None] * M[pulls]]), target[:, None])
    x = np.zeros(n, dtype=np.longdouble)
    x[order] = back(R, rotated[:n, 0])
    return x


def prove(problem: Extended, sample: Sample, ends: Ends, v: Array, lam: Array, dual: Array | None = None) -> Proof:
    """Weigh a plan v and its multipliers lam, `(N,)` each, in units.

    The bound on the cost comes from `dual`, multipliers in extended precision; from lam if there are none.
    """
    v, lam = v.astype(np.longdouble), lam.astype(np.longdouble)
    x = coefficients(problem, sample, v, lam)
    a, reached = sample.a0 + problem.A @ x, sample.c + problem.M @ x
    cost, slope = problem.cost(a, sample.theta)
    moves = np.abs(problem.M).max(axis=1, initial=0.0) > 0
    bound_by = np.where(moves, admitted(ends, lam if dual is None else dual), 0)
    far = np.abs(x[problem.n_xi :]) + SETTINGS.reach * (1 + np.sqrt(np.square(a).sum()))
    price = np.where(moves, _price(ends, reached), 0)
    gaps = []
    for multipliers in (bound_by, np.zeros_like(bound_by)):
        left = slope + multipliers @ problem.M
        of_xi, of_eta = left[: problem.n_xi], left[problem.n_xi :]
        of_sets = _grouped(ends, price - multipliers * reached + _support(ends, multipliers))
        gaps.append(np.abs(of_sets).sum() + np.square(of_xi).sum() / 2 + np.abs(of_eta) @ far)
    # A g of double precision reproduces the plan up to the rounding of its terms.
    rounding = 2.0**-53 * (np.abs(problem.posed.C) @ np.abs(a)) / problem.unit
    missed = [(np.abs(reached - v) + rounding) / (1 + np.abs(v)), _outside(ends, v), _equalities(problem, sample, a)]
    at_price = np.isfinite(ends.price)
    rounded = 2.0**-52 * (ends.price * (1 + np.abs(v)))[at_price].sum()  # what rounding of v costs at its prices
    return Proof(
        float(cost + _price(ends, reached).sum()),
        float(min(gaps)),
        _negligible(problem) + float(rounded),
        float(max(part.max(initial=0.0) for part in missed)),
    )


def excludes(problem: Extended, sample: Sample, ends: Ends, d: Array) -> bool:
    """Return whether a direction d `(N,)`, or a row that cannot move, proves that no plan lies in the sets.

    By Farkas' lemma: d'M = 0 and d'c > sup {d'v : v in the sets}. d is first freed of what rounding leaves of d'M, and
    a column of M counts as met by zero only if the sum is nothing beside its own terms.
    """
    moves = np.abs(problem.M).max(axis=1, initial=0.0) > 0
    if (_outside(_without(ends, moves), sample.c) > SETTINGS.apart).any():
        return True
    hard = replace(ends, price=np.full_like(ends.price, np.inf))
    d = np.where(moves & np.isinf(ends.price), d, 0)
    d = np.where(np.abs(d) > SETTINGS.faint * np.abs(d).max(initial=0.0), d, 0)
    d = admitted(hard, without_work(admitted(hard, d), problem.M))
    leak, terms = np.abs(d @ problem.M), np.abs(d) @ np.abs(problem.M)
    support = _support(hard, d)
    margin, size = d @ sample.c - support.sum(), np.abs(d) @ np.abs(sample.c) + np.abs(support).sum()
    return bool((leak <= SETTINGS.met * terms).all() and margin > SETTINGS.apart * size)


def _without(ends: Ends, rows: Array) -> Ends:
    """Return the ends without those of some rows `(N,)`, boolean, and without blocks that hold one of them."""
    lower, upper = np.where(rows, -np.inf, ends.lower), np.where(rows, np.inf, ends.upper)
    return replace(ends, lower=lower, upper=upper, blocks=[b for b in ends.blocks if not rows[b.rows].any()])


def admitted(ends: Ends, lam: Array) -> Array:
    """Return the nearest multipliers for which the bound is finite."""
    low = np.where(np.isfinite(ends.lower), -ends.price, 0)
    high = np.where(np.isfinite(ends.upper), ends.price, 0)
    out = np.clip(lam, low, high)
    for block in ends.blocks:
        own = lam[block.rows]
        out[block.rows] = own if block.center is not None else -_onto_cone(-own)
    return out


def _price(ends: Ends, v: Array) -> Array:
    beyond = np.maximum(np.maximum(v - ends.upper, ends.lower - v), 0)
    return np.where(np.isfinite(ends.price), np.where(np.isfinite(ends.price), ends.price, 0) * beyond, 0)


def _support(ends: Ends, lam: Array) -> Array:
    """Return the supremum of lam v over the sets, `(N,)`; that of a block stands in its first row."""
    end = np.where(lam > 0, ends.upper, ends.lower)
    support = np.where(lam != 0, lam * np.where(lam != 0, end, 0), 0)
    for block in ends.blocks:
        support[block.rows] = 0
        if block.center is not None:
            own = lam[block.rows]
            support[block.rows[0]] = own @ block.center + block.radius * np.sqrt(np.square(own).sum())
    return support


def _grouped(ends: Ends, total: Array) -> Array:
    """Return the total of each row, summed over each block in its first row."""
    for block in ends.blocks:
        whole = total[block.rows].sum()
        total[block.rows] = 0
        total[block.rows[0]] = whole
    return total


def _outside(ends: Ends, v: Array) -> Array:
    hard = np.isinf(ends.price)
    beyond = np.where(hard, np.maximum(np.maximum(v - ends.upper, ends.lower - v), 0), 0) / (1 + np.abs(v))
    for block in ends.blocks:
        part = v[block.rows]
        if block.center is None:
            over = np.sqrt(np.square(part[1:]).sum()) - part[0]
        else:
            over = np.sqrt(np.square(part - block.center).sum()) - block.radius
        beyond[block.rows[0]] = max(0, over) / (1 + np.abs(part).max())
    return beyond


def _equalities(problem: Extended, sample: Sample, a: Array) -> Array:
    posed = problem.posed
    if not len(posed.Eq):
        return np.zeros(0)
    wanted, own = sample.theta[posed.places], posed.theta_scale[posed.places]
    return np.abs(posed.Eq @ a - wanted) / (own + np.abs(wanted))


def _negligible(problem: Extended) -> float:
    """Return what it costs to miss the targets by next to nothing."""
    total, scale = np.longdouble(1e-300), problem.posed.theta_scale
    for term in problem.posed.terms:
        if term.start is None:
            continue
        own = scale[term.start : term.start + len(term.S)].astype(np.longdouble)
        near = (SETTINGS.of_reference if term.W.ndim else SETTINGS.of_start) * own
        weight = term.W.diagonal() if term.W.ndim else term.W
        total = total + (weight * np.square(near)).sum() / 2
    return float(total)


def _onto_cone(x: Array) -> Array:
    norm = np.sqrt(np.square(x[1:]).sum())
    if norm <= x[0]:
        return x
    if norm <= -x[0]:
        return np.zeros_like(x)
    half = (norm + x[0]) / 2
    return np.concatenate([[half], half * x[1:] / norm])
