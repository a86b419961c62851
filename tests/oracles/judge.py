"""What the reference says of a problem, and of what the layer returned for it."""

import enum
from dataclasses import dataclass

import numpy as np

from .blocks import blocks_of
from .extended import LONG, Array, long
from .feasible import least_violation
from .optimum import Optimum, optimum
from .problem import Problem, Sample, root
from .reduction import Reduced, Rows, reduce

WRONG_ROW = 1e-6  # an equality or a set missed by this share of its channel is wrong
WRONG_COST = 1e-6  # a cost above the optimum by this share is wrong,
OF_TRACKING = 1e-10  # beyond this share of the cost of doing nothing,
OF_CHANNEL = 1e-7  # beyond the cost of missing the references by this share of each channel,
ROUNDING = 1e-14  # rounding of a row, in units of its channel times |g|; its square has the weight of the row
INFEASIBLE = 1e-6  # a least violation above this share of a channel: no plan
FEASIBLE = 1e-9  # below: a plan
STRICTLY = 1e-12  # below: a plan that no tolerance excuses to deny
OF_START = 1e-10  # beyond the cost of missing the initial outputs by this share of each channel


class Answer(enum.Enum):
    FEASIBLE = "feasible"
    INFEASIBLE = "infeasible"
    UNDECIDED = "undecided"


class Verdict(enum.Enum):
    RIGHT = "right"
    SUBOPTIMAL = "wrong: suboptimal"
    OUTSIDE = "wrong: outside its sets"
    NO_TRAJECTORY = "wrong: no trajectory of the data"
    FAILED = "FAILED though feasible"
    FALSE_INFEASIBLE = "INFEASIBLE though feasible"
    MARKED = "marked, no plan exists"
    UNDECIDED = "undecided"

    @property
    def is_wrong(self) -> bool:
        return self.value.startswith("wrong")


@dataclass(frozen=True)
class Reference:
    """The reference's own answer for one sample."""

    answer: Answer
    violation: float  # the least there is
    optimum: Optimum | None
    reduced: Reduced
    why: str = ""

    @property
    def plan(self) -> tuple[Array, Array]:
        """The reference's v / scale and a (on the basis)."""
        r = self.reduced
        return r.C @ self.optimum.x + r.c, r.a0 + r.A @ self.optimum.x


def reference(p: Problem, rows: Rows, s: Sample) -> Reference:
    """Solve one sample on the rows of its data."""
    r = reduce(p, rows, s)
    blocks = blocks_of(p, r.C, r.c, r.natural)
    if r.contradiction > INFEASIBLE:
        return Reference(Answer.INFEASIBLE, r.contradiction, None, r, "equalities")
    violation = max(least_violation(r, blocks), r.contradiction)
    if violation > INFEASIBLE:
        return Reference(Answer.INFEASIBLE, violation, None, r, "sets")
    best = optimum(r, blocks)
    violation = min(violation, max(best.violation, r.contradiction)) if np.isfinite(violation) else best.violation
    sure = violation <= FEASIBLE and r.contradiction <= FEASIBLE
    return Reference(Answer.FEASIBLE if sure else Answer.UNDECIDED, violation, best, r)


@dataclass(frozen=True)
class Finding:
    """A verdict and the figures behind it."""

    verdict: Verdict
    equality: float = 0.0  # the worst row of Up g = u_ini, u = Uf g, y = Yf g, relative to its channel
    outside: float = 0.0
    excess: float = 0.0  # (cost - optimum) / optimum
    cost: float = np.nan
    optimum: float = np.nan
    note: str = ""


def check_plan(p: Problem, rows: Rows, s: Sample, ref: Reference, u: Array, y: Array, g: Array) -> Finding:
    """Judge a plan that was returned as solved."""
    equality, outside = rows_missed(p, s, u, y, g), sets_missed(p, s, u, y)
    if not np.isfinite(equality) or equality > WRONG_ROW:
        return Finding(Verdict.NO_TRAJECTORY, equality, outside)
    if outside > WRONG_ROW:
        return Finding(Verdict.OUTSIDE, equality, outside)
    if ref.optimum is None:
        return Finding(Verdict.UNDECIDED, equality, outside, note="a plan within tolerance where none should be")
    value, allowance = cost(p, rows, s, u, y, g)
    best, bound = ref.optimum, ref.optimum.bound
    figures = (equality, outside, float((value - bound) / max(bound, LONG(1e-300))), float(value), float(best.value))
    if value - bound <= WRONG_COST * bound + allowance:
        return Finding(Verdict.RIGHT, *figures)
    if best.violation > FEASIBLE or best.value - bound > 0.1 * (value - bound):
        return Finding(Verdict.UNDECIDED, *figures, note=f"gap of the reference {float(best.value - bound):.1e}")
    if rows.ambiguous:
        return Finding(Verdict.UNDECIDED, *figures, note="the rank of the data is ambiguous")
    return Finding(Verdict.SUBOPTIMAL, *figures)


def check_failure(rows: Rows, ref: Reference, infeasible: bool) -> Finding:
    """Judge a sample that was marked."""
    if ref.answer is Answer.INFEASIBLE:
        return Finding(Verdict.MARKED, outside=ref.violation, note=ref.why)
    if ref.answer is Answer.UNDECIDED or (infeasible and (rows.ambiguous or ref.violation > STRICTLY)):
        return Finding(Verdict.UNDECIDED, outside=ref.violation, note="near the edge of the feasible")
    return Finding(Verdict.FALSE_INFEASIBLE if infeasible else Verdict.FAILED, outside=ref.violation)


# --- the plan on the problem as posed ---------------------------------------------------------------------------------


def rows_missed(p: Problem, s: Sample, u: Array, y: Array, g: Array) -> float:
    """Return the worst of Up g = u_ini, u = Uf g, y = Yf g, and of the terminal rows, relative to each channel."""
    g, u, y = long(g), long(u), long(y)
    pairs = [(long(p.Uf) @ g, u.ravel(), p.scale_u), (long(p.Yf) @ g, y.ravel(), p.scale_y)]
    if p.lambda_u is None:
        pairs.append((long(p.Up) @ g, long(s.u_ini).ravel(), p.scale_u))
    if p.terminal_steps:
        pairs.append((y[-p.terminal_steps :].ravel(), long(s.y_ref)[-p.terminal_steps :].ravel(), p.scale_y))
    worst = 0.0
    for ours, target, scale in pairs:
        size = np.maximum(np.abs(target.reshape(-1, len(scale))).max(0), scale)
        worst = np.maximum(worst, (np.abs(ours - target).reshape(-1, len(scale)) / size).max())
    return float(worst)


def sets_missed(p: Problem, s: Sample, u: Array, y: Array) -> float:
    v = p.v_of(u, y, s.u_ini)
    worst = 0.0
    for piece in p.pieces:
        size = p.scale_v[piece.rows]
        out = piece.outside(v)
        if piece.kind == "interval":
            out = np.where(np.isfinite(piece.price), 0, out) / size
        else:
            out = out / size.max()
        worst = max(worst, float(out.max(initial=0)))
    return worst


def cost(p: Problem, rows: Rows, s: Sample, u: Array, y: Array, g: Array) -> tuple[LONG, LONG]:
    """Return the cost of a plan, and what rounding of its rows and the cost of doing nothing excuse."""
    g, u, y = long(g), long(u), long(y)
    reach = ROUNDING * max(LONG(1), np.sqrt((g**2).sum()))
    su, sy = np.tile(p.scale_u, p.horizon), np.tile(p.scale_y, p.horizon)
    du = np.diff(np.concatenate([long(s.u_ini)[-1:], u]), axis=0).ravel()
    least = g - rows.basis[:, : rows.r1] @ (rows.basis[:, : rows.r1].T @ g) if p.regularizer == "projection" else g
    past = long(p.Yp) @ g - long(s.y_ini).ravel()
    half, twice = LONG(0.5), LONG(1)
    rootQ, rootR = root(p.Q), root(p.R)
    terms = [
        (half, rootQ @ (y - s.y_ref).ravel(), rootQ * sy),
        (half, rootR @ (u - s.u_ref).ravel(), rootR * su),
        (twice * p.lambda_g, least, np.eye(1)),
        (twice * p.lambda_s, past, np.tile(p.scale_y, p.t_ini)[None]),
    ]
    if p.R_du is not None:
        rootD = root(p.R_du)
        terms.append((half, rootD @ du, rootD * su))
    if p.lambda_u is not None:
        terms.append((p.lambda_u, long(p.Up) @ g - long(s.u_ini).ravel(), np.tile(p.scale_u, p.t_ini)[None]))
    total, allowance = LONG(0), LONG(0)
    for i, (weight, rest, size) in enumerate(terms):
        total += LONG(weight) * (rest**2).sum()
        missed = max(reach * 1e3, OF_CHANNEL if i < 2 else OF_START)
        allowance += LONG(weight) * (long(size) ** 2).sum() * missed**2
    v = p.v_of(u, y, s.u_ini)
    for piece in p.pieces:
        if piece.kind == "interval":
            soft = np.isfinite(piece.price)
            total += (piece.price[soft] * piece.outside(v)[soft]).sum()
            allowance += (piece.price[soft] * p.scale_v[piece.rows][soft]).sum() * ROUNDING
    nothing = half * ((rootQ @ long(s.y_ref).ravel()) ** 2).sum() + half * ((rootR @ long(s.u_ref).ravel()) ** 2).sum()
    return total, allowance + OF_TRACKING * nothing
