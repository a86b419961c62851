"""The optimal cost and its proof: Clarabel comes near, an active set in long double finishes, duality bounds the rest.

For multipliers lam that the sets admit, the cost of every plan is at least

    1/2 |xi - xi0|^2 + rest + sum (lam z - support(lam)) - 1/2 |xi - xi0 + M'lam|^2      at any xi,

so the answer needs no trust in who found it.
"""

from dataclasses import dataclass

import numpy as np

from .active_set import newton_step, sign_feasible
from .blocks import Block, norm
from .conic import conic
from .extended import LONG, Array
from .reduction import Reduced

STEPS = 60  # of the active set
CLOSED = 1e-9  # a gap below this share of the cost ends the search
TIGHT = 1e-12  # violation, relative to the channel, that the reference allows itself
REACH = 1e3  # plans go no further along directions without cost, in units of the reference's own combination of rows


@dataclass(frozen=True)
class Optimum:
    """A plan, its cost, what no plan can go below, and how far it lies outside of the sets (share of a channel)."""

    x: Array
    lam: list[Array]
    value: LONG
    bound: LONG
    violation: float


def optimum(reduced: Reduced, blocks: list[Block]) -> Optimum:
    """Return the best that was found; value - bound says how good it is."""
    x, lam = _approximate(reduced, blocks)
    best = _weigh(reduced, blocks, x, lam)
    x = np.asarray(x, LONG)
    held = {}
    for step in range(STEPS):
        try:
            found = newton_step(reduced, blocks, x, lam, held if step else None)
        except np.linalg.LinAlgError:
            break
        x, lam, held, settled = found
        best = _better(best, _weigh(reduced, blocks, x, lam))
        if not settled:
            best = _better(best, _weigh(reduced, blocks, x, sign_feasible(reduced, blocks, x, lam)))
        if best.violation <= TIGHT and best.value - best.bound <= CLOSED * abs(best.value):
            break
        if settled and step > 8:
            break
    return best


def _better(a: Optimum, b: Optimum) -> Optimum:
    """Return the better plan with the higher bound."""
    first, second = (max(o.violation, TIGHT) for o in (a, b))
    plan = a if (first, a.value) <= (second, b.value) else b
    if abs(np.log10(first / second)) < 1e-3:
        plan = a if a.value <= b.value else b
    tighter = a if a.bound >= b.bound else b
    return Optimum(plan.x, tighter.lam, plan.value, tighter.bound, plan.violation)


def _weigh(reduced: Reduced, blocks: list[Block], x: Array, lam: list[Array]) -> Optimum:
    x = np.asarray(x, LONG)
    lam = [b.dual_feasible(np.asarray(part, LONG)) for b, part in zip(blocks, lam, strict=True)]
    n = reduced.n_xi
    gradient = x[:n] - reduced.xi0
    forces = np.zeros(len(x), LONG)
    value = LONG(0.5) * (gradient**2).sum() + reduced.rest
    bound, violation = value, LONG(0)
    for b, part in zip(blocks, lam, strict=True):
        z = b.M @ x + b.m
        value += b.charge(z)
        if b.decided:
            bound += b.charge(z)
        else:
            forces += part @ b.M
            bound += part @ z - b.support(part)
        if b.hard:
            violation = max(violation, b.violation(z))
    bound -= LONG(0.5) * ((gradient + forces[:n]) ** 2).sum()
    if n < len(x):  # a force that is left along a direction without cost pays for as far as a plan may go
        size = np.sqrt((reduced.A[:, n:] ** 2).sum(0))
        bound -= (np.abs(forces[n:]) * (np.abs(x[n:]) + REACH * (1 + norm(reduced.a0 + reduced.A @ x)) / size)).sum()
    return Optimum(x, lam, value, max(bound, LONG(0)), float(violation))


def _approximate(reduced: Reduced, blocks: list[Block]) -> tuple[Array, list[Array]]:
    """Return (x, lam) by Clarabel, in units in which the step from xi0 to the sets is near 1."""
    n, total = reduced.n_xi, reduced.C.shape[1]
    start = np.concatenate([reduced.xi0, np.zeros(total - n, LONG)])
    free = [b for b in blocks if not b.decided]
    if not free:
        return start, [np.zeros(len(b.m)) for b in blocks]
    columns = np.ones(total)
    for j in range(n, total):
        size = max(float(np.abs(b.M[:, j]).max()) for b in free)
        columns[j] = 1 / size if size > 0 else 1.0
    rows = [max(float(np.sqrt(((b.M * columns) ** 2).sum(1)).max()), 1e-300) for b in free]
    offsets = [b.M @ start + b.m for b in free]
    reach = max(float(b.violation(o)) / r for b, o, r in zip(free, offsets, rows, strict=True))
    reach = reach if reach > 0 else 1.0
    P = np.diag((np.arange(total) < n).astype(float))
    scaled = []
    for b, o, r in zip(free, offsets, rows, strict=True):
        shape = Block(b.kind, b.rows, b.shares, b.center, b.M, b.m, b.lower / (r * reach), b.upper / (r * reach),
                      b.price * r / reach, b.radius / (r * reach))  # fmt: skip
        scaled.append((shape, np.asarray(b.M * columns / r, float), np.asarray(o / (r * reach), float)))
    x, lam = conic(P, np.zeros(total), scaled, 1e-11)
    if not np.isfinite(x).all():
        return start, [np.zeros(len(b.m)) for b in blocks]
    solved = iter([part * reach / r for part, r in zip(lam, rows, strict=True)])
    return start + columns * x * reach, [np.zeros(len(b.m)) if b.decided else next(solved) for b in blocks]
