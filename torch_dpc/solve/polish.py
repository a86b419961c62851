"""Newton's method on the rows that an interior point holds: from half of the digits to all of them.

An interior-point method comes near the solution along the inside of the cones, and its plan is off by the root of its
gap. It shows which rows are held, which prices are paid and which cones are touched; on those, the conditions are
smooth equations, and sequential quadratic steps double the digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..problem.long_double import Array, back, cholesky, forward, kernel_of
from .cones import inside
from .interior_point import ConeProgram, Point

#: Rounds; each doubles the digits.
ROUNDS = 4
#: Held rows whose part outside the span of the others is below this follow from them.
DEPENDENT = 1e-13


@dataclass(frozen=True, eq=False)
class Held:
    """What an interior point holds.

    Attributes:
        rows: rows of G at their end, `(m,)`, boolean.
        paid: rows of G beyond their end, at their price, `(m,)`, boolean.
        tips: cones at their tip, and
        shells: cones on their boundary elsewhere, `(k,)` each, boolean.
    """

    rows: Array
    paid: Array
    tips: Array
    shells: Array

    @staticmethod
    def of(program: ConeProgram, point: Point) -> Held:
        """Read them off a point: of each pair of a slack and its multiplier the larger one stays."""
        soft = np.isfinite(program.price)
        paid = soft & (point.t > point.z_t)
        rows = (point.z > point.s) & ~paid
        presses = point.z_cone[:, 0] > inside(point.s_cone)
        tips = presses & (inside(point.z_cone) > point.s_cone[:, 0])
        return Held(rows, paid, tips, presses & ~tips)


def polished(program: ConeProgram, point: Point) -> Point:
    """Return the point after a few steps on what it holds."""
    p, held = program, Held.of(program, point)
    y, nu = point.y.copy(), point.z_cone[held.shells, 0].copy()
    fixed = p.q + np.where(held.paid, np.where(np.isfinite(p.price), p.price, 0), 0) @ p.G
    z, z_cone = point.z, point.z_cone
    for _ in range(ROUNDS):
        s = (p.b - p.B @ y)[held.shells]
        length = np.sqrt(np.square(s[:, 1:]).sum(axis=1))
        if not (length > 0).all():
            return point
        n = s[:, 1:] / length[:, None]
        tail = p.B[held.shells, 1:]
        along = (n[:, :, None] * tail).sum(axis=1)
        across = tail - n[:, :, None] * along[:, None, :]
        bent = np.sqrt(np.maximum(nu, 0) / length)[:, None, None] * across
        bent = bent.reshape(tail.shape[0] * tail.shape[1], len(y))
        at_tips = p.B[held.tips].reshape(p.b[held.tips].size, len(y))
        J = np.concatenate([p.G[held.rows], p.B[held.shells, 0] - along, at_tips])
        missed = np.concatenate([(p.G @ y - p.h)[held.rows], length - s[:, 0], -(p.b - p.B @ y)[held.tips].ravel()])
        step, multipliers = _equality_step(p.P + bent.T @ bent, p.P @ y + fixed, J, missed)
        y = y + step
        z, z_cone = np.where(held.paid, p.price, 0), np.zeros_like(p.b)
        cut = np.cumsum([held.rows.sum(), held.shells.sum()])
        z[held.rows], nu, of_tips = np.split(multipliers, cut)
        z_cone[held.shells] = nu[:, None] * np.concatenate([np.ones_like(nu)[:, None], -n], axis=1)
        z_cone[held.tips] = of_tips.reshape(-1, p.b.shape[1])
    gone = p.h - p.G @ y
    return Point(y, np.where(held.paid, -gone, 0), np.where(held.paid, 0, gone), z, point.z_t, p.b - p.B @ y, z_cone)


def _equality_step(H: Array, gradient: Array, J: Array, missed: Array) -> tuple[Array, Array]:
    """Return d and mu: the least of gradient'd + 1/2 d'H d under J d = -missed, and gradient + H d + J'mu = 0."""
    length = np.sqrt(np.square(J).sum(axis=1))
    length[length == 0] = 1
    pinv, N = kernel_of(J / length[:, None], DEPENDENT) if len(J) else (np.zeros((len(H), 0)), np.eye(len(H)))
    step = -pinv @ (missed / length)
    if N.shape[1]:
        R = cholesky(N.T @ H @ N)
        step = step - N @ back(R, forward(R, N.T @ (gradient + H @ step)))
    return step, -(pinv.T @ (gradient + H @ step)) / length
