"""Steps of an active set in long double: which blocks hold, the equality problem they pose, multipliers with signs."""

import numpy as np
from scipy.optimize import nnls

from .blocks import Block, norm
from .extended import LONG, Array, minimum_norm, qr, rank_of, solve_upper, solve_upper_transposed
from .reduction import KERNEL, Reduced

States = dict[
    int, str
]  # "upper", "lower", "above" and "below" (at their price), "shell", "apex"; free ones are left out
DEPENDENT = 1e-13  # held rows below this share of the largest follow from the others


def _states(reduced: Reduced, blocks: list[Block], x: Array, lam: list[Array], before: States | None) -> States:
    """Return what holds each block: "upper", "lower", "above", "below" (at their price), "shell" or "apex"."""
    n = reduced.n_xi
    states = {}
    for i, (b, part) in enumerate(zip(blocks, lam, strict=True)):
        if b.decided:
            continue
        z = b.M @ x + b.m
        push = (b.M[:, :n] ** 2).sum(1).max()  # a force moves z by so much
        force = norm(np.asarray(part, LONG))
        if b.kind == "interval":
            state = _interval_state(b, z[0], part[0], push, (before or {}).get(i), before is None)
        elif b.kind == "ball":
            state = "apex" if b.radius == 0 else "shell" if force * push > b.radius - norm(z) else None
        elif norm(z) <= 1e-7 * force * push and force > 0:
            state = "apex"
        else:
            state = "shell" if force * push > z[0] - norm(z[1:]) else None
        if state:
            states[i] = state
    return states


def _interval_state(b: Block, z: LONG, lam: LONG, push: LONG, before: str | None, first: bool) -> str | None:
    if b.lower == b.upper and b.hard:
        return "upper"
    span = LONG(1e-15) * (1 + np.abs(z))
    if first:
        if lam * push > b.upper - z:
            return "above" if (b.price - lam) * push < z - b.upper else "upper"
        if -lam * push > z - b.lower:
            return "below" if (b.price + lam) * push < b.lower - z else "lower"
        return None
    if before in ("upper", "lower"):
        sign = 1 if before == "upper" else -1
        if sign * lam > b.price:
            return "above" if sign > 0 else "below"
        return before if sign * lam >= 0 else None
    if before == "above" and z >= b.upper or before == "below" and z <= b.lower:
        return before
    if z > b.upper + span or before == "above":
        return "upper"
    return "lower" if z < b.lower - span or before == "below" else None


def newton_step(reduced: Reduced, blocks: list[Block], x: Array, lam: list[Array], before: States | None):
    """Return x, lam, states after one step of the active set (of Newton, where a set is curved), and if it repeats."""
    states = _states(reduced, blocks, x, lam, before)
    rows, sides, owners, curved, linear = [], [], [], [], np.zeros(len(x), LONG)
    new = [np.zeros(len(b.m), LONG) for b in blocks]
    for i, state in states.items():
        b = blocks[i]
        if state in ("above", "below"):
            new[i] = np.array([b.price if state == "above" else -b.price])
            linear += new[i] @ b.M
            continue
        if state in ("upper", "lower"):
            directions, side = np.ones((1, 1), LONG), (b.upper if state == "upper" else b.lower) - b.m
        elif state == "apex":
            directions, side = np.eye(len(b.m), dtype=LONG), -b.m
        else:
            directions, side, bend = _shell(b, x, lam[i])
            if bend is not None:
                curved.append((bend, x))
        rows.append(directions.T @ b.M)
        sides.append(side)
        owners.append((i, directions))
    x, multipliers = _held(reduced, x, rows, sides, curved, linear)
    at = 0
    for i, directions in owners:
        at, start = at + directions.shape[1], at
        new[i] = directions @ multipliers[start:at]
    return x, new, states, before == states


def _shell(b: Block, x: Array, lam: Array) -> tuple[Array, Array, Array | None]:
    """Return the normal of a curved boundary at x, where its plane lies, and the bend that the multiplier gives it."""
    z = b.M @ x + b.m
    tail = z if b.kind == "ball" else z[1:]
    size = norm(tail)
    if size == 0:  # the middle of a ball or the axis of a cone: any plane will do for a start
        tail, size = np.ones_like(tail), norm(np.ones_like(tail))
    direction = tail / size
    normal = direction if b.kind == "ball" else np.concatenate([[-LONG(1)], direction])
    level = normal @ z - b.radius
    force = max(normal @ np.asarray(lam, LONG) / (normal @ normal), LONG(0))
    flat = b.M if b.kind == "ball" else b.M[1:]
    bend = np.sqrt(force / size) * (flat - np.outer(direction, direction @ flat))
    return normal[:, None], np.array([normal @ b.M @ x - level]), bend


def _held(reduced: Reduced, x: Array, rows, sides, curved, linear) -> tuple[Array, Array]:
    """Return argmin 1/2 |xi - xi0|^2 + 1/2 sum |K (x - x_now)|^2 + linear x, rows x = sides, and its multipliers."""
    n, total = reduced.n_xi, len(x)
    E = np.concatenate([np.eye(n, total, dtype=LONG), *(K for K, _ in curved)])
    e = np.concatenate([reduced.xi0, *(K @ at for K, at in curved)])
    A = np.concatenate(rows) if rows else np.zeros((0, total), LONG)
    sizes = np.sqrt((A**2).sum(1))
    sizes = np.where(sizes > 0, sizes, 1)
    A = A / sizes[:, None]
    b = np.concatenate(sides) / sizes if rows else np.zeros(0, LONG)
    start, N = np.zeros(total, LONG), np.eye(total, dtype=LONG)
    if rows:
        start, N, _ = minimum_norm(A, b, DEPENDENT)
    if N.shape[1]:
        q, T, order = qr(E @ N)
        k = rank_of(T, KERNEL)
        side = q.T[:k] @ (e - E @ start) - solve_upper_transposed(T[:k, :k], (N.T @ linear)[order[:k]])
        y = np.zeros(N.shape[1], LONG)
        y[order[:k]] = solve_upper(T[:k, :k], side)
        start = start + N @ y
    gradient = E.T @ (E @ start - e) + linear
    multipliers = minimum_norm(A.T, -gradient, DEPENDENT)[0] / sizes if rows else b
    return start, multipliers


def sign_feasible(reduced: Reduced, blocks: list[Block], x: Array, lam: list[Array]) -> list[Array]:
    """Return multipliers of the right signs where held rows depend on each other, by non-negative least squares."""
    n = reduced.n_xi
    gradient = np.concatenate([x[:n] - reduced.xi0, np.zeros(len(x) - n, LONG)])
    columns, owners, fixed = [], [], [np.zeros(len(b.m), LONG) for b in blocks]
    for i, b in enumerate(blocks):
        if b.decided:
            continue
        z = b.M @ x + b.m
        near = LONG(1e-11) * (1 + norm(z))
        if b.kind == "interval":
            if z[0] > b.upper + near or z[0] < b.lower - near:
                if not b.hard:
                    fixed[i] = np.array([b.price if z[0] > b.upper else -b.price])
                    gradient = gradient + fixed[i][0] * b.M[0]
                    continue
            for sign, end in ((1, b.upper), (-1, b.lower)):
                if np.isfinite(end) and abs(z[0] - end) <= max(near, b.violation(z)):
                    columns.append(sign * b.M[0])
                    owners.append((i, np.array([sign])))
        elif lam[i].any():
            direction = lam[i] / norm(lam[i])
            columns.append(direction @ b.M)
            owners.append((i, direction))
    if columns:
        A = np.array(columns).T
        size = np.sqrt((A**2).sum(0))
        size = np.where(size > 0, size, 1)
        scale = max(float(norm(gradient)), 1e-300)
        try:
            solved, _ = nnls(np.asarray(A / size, float), np.asarray(-gradient / scale, float), maxiter=50 * A.shape[1])
        except RuntimeError:
            return lam
        for value, (i, direction), length in zip(solved, owners, size, strict=True):
            fixed[i] = fixed[i] + value * scale / length * direction
    return fixed
