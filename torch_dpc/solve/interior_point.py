"""A primal-dual interior-point method in extended precision, for samples that no faster engine solves.

    minimise 1/2 y'Py + q'y + w't   subject to   G y - t + s = h,   s >= 0, t >= 0,     B_k y + s_k = b_k in a cone,

t only where a row has a price w (elsewhere w is infinite and t is zero). Mehrotra's predictor and corrector with the
scaling of Nesterov and Todd, as in Vandenberghe, "The CVXOPT linear and quadratic cone program solvers" (2010). The
cones are {|x_1:| <= x_0}, all padded to one size with zero rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..problem.long_double import Array, back, cholesky, forward
from .cones import determinant, inside, product, quotient, to_boundary


@dataclass(frozen=True)
class InteriorPointSettings:
    """When the method ends; residuals and gap are relative to their terms.

    Attributes:
        steps: the most there are; problems take 10 to 40.
        closed: residuals and gap at which it ends.
        fraction: of the way to the boundary that a step goes.
        shortest: a step below this makes no headway.
    """

    steps: int = 80
    closed: float = 1e-17
    fraction: float = 0.99
    shortest: float = 1e-9


SETTINGS = InteriorPointSettings()


@dataclass(frozen=True, eq=False)
class ConeProgram:
    """The program, in long double.

    Attributes:
        P, q: `(n, n)` and `(n,)`.
        G, h, price: `(m, n)`, `(m,)`, `(m,)`; infinite prices are hard rows.
        B, b: `(k, d, n)` and `(k, d)`.
    """

    P: Array
    q: Array
    G: Array
    h: Array
    price: Array
    B: Array
    b: Array

    @property
    def B_rows(self) -> Array:
        """B with its cones one below the other, `(k d, n)`."""
        return self.B.reshape(self.b.size, len(self.q))


@dataclass(eq=False)
class Point:
    """An iterate: y, t, slacks and multipliers of rows, of t >= 0, and of cones; t is zero on hard rows."""

    y: Array
    t: Array
    s: Array
    z: Array
    z_t: Array
    s_cone: Array
    z_cone: Array


def solve(program: ConeProgram) -> tuple[Point, Point]:
    """Return the best iterate and the last one, whose multipliers diverge where the program has no solution."""
    p, soft = program, np.isfinite(program.price)
    point = _start(p, soft)
    best, least = point, np.inf
    for _ in range(SETTINGS.steps):
        r_y = p.P @ point.y + p.q + point.z @ p.G + point.z_cone.ravel() @ p.B_rows
        r_t = np.where(soft, p.price - point.z - point.z_t, 0)
        r_z = point.s + p.G @ point.y - point.t - p.h
        r_c = point.s_cone + p.B @ point.y - p.b
        products = point.s @ point.z + point.t @ point.z_t + (point.s_cone * point.z_cone).sum()
        mu = products / max(1, len(p.h) + soft.sum() + len(p.b))
        size = 1 + np.abs(point.y).max(initial=0.0)
        cost = np.abs(point.y @ p.P @ point.y) + np.abs(p.q @ point.y) + np.where(soft, p.price, 0) @ point.t
        force = 1 + np.abs(point.z).max(initial=0.0) + np.abs(point.z_cone).max(initial=0.0)
        missed = max(np.abs(r_z).max(initial=0.0), np.abs(r_c).max(initial=0.0)) / size
        worst = float(max(products / (cost + 1e-30), np.abs(r_y).max(initial=0.0) / force, missed))
        if not np.isfinite(worst):
            break
        if worst < least:
            best, least = _copy(point), worst
        if worst <= SETTINGS.closed:
            break
        scaling = _Scaling(p, point, soft)
        none = np.zeros_like(point.s_cone)
        affine = scaling.step(r_y, r_t, r_z, r_c, -point.s * point.z, -point.t * point.z_t, -scaling.squared)
        length = _longest(point, affine)
        center = (1 - length) ** 3
        of_cone = scaling.second_order(affine) if len(p.b) else none
        target = center * mu
        e = np.zeros_like(none)
        e[:, :1] = 1
        keep = 1 - center
        change = scaling.step(
            keep * r_y,
            keep * r_t,
            keep * r_z,
            keep * r_c,
            target - point.s * point.z - affine.s * affine.z,
            np.where(soft, target - point.t * point.z_t - affine.t * affine.z_t, 0),
            target * e - scaling.squared - of_cone,
        )
        length = min(1, SETTINGS.fraction * _longest(point, change))
        if not length > SETTINGS.shortest:
            break
        for name in point.__dataclass_fields__:
            setattr(point, name, getattr(point, name) + length * getattr(change, name))
    return best, point


def _copy(point: Point) -> Point:
    return Point(**{name: getattr(point, name).copy() for name in point.__dataclass_fields__})


def _start(p: ConeProgram, soft: Array) -> Point:
    """Return the least-squares start of coneqp, moved into the cones; a priced row starts within its price."""
    F = np.concatenate([p.G, p.B_rows])
    h = np.concatenate([p.h, p.b.ravel()])
    R = cholesky(p.P + F.T @ F)
    y = back(R, forward(R, F.T @ h - p.q))
    z = F @ y - h
    m = len(p.h)
    ones = np.zeros_like(p.b)
    ones[:, :1] = 1
    s_row, z_row, s_cone, z_cone = -z[:m], z[:m].copy(), -z[m:].reshape(p.b.shape), z[m:].reshape(p.b.shape)
    for of_rows, of_cones in ((s_row, s_cone), (z_row, z_cone)):
        outside = max(-of_rows.min(initial=0.0), -inside(of_cones).min(initial=0.0))
        if outside > -1e-8:
            of_rows += 1 + outside
            of_cones += (1 + outside) * ones
    price = np.where(soft, p.price, 1)
    z_row = np.where(soft, np.minimum(z_row, price / 2), z_row)
    zero = np.zeros_like(p.h)
    t = np.where(soft, np.maximum(s_row.max(initial=1.0) / 1e3, 1e-3), 0)
    return Point(y, t, s_row, z_row, np.where(soft, price - z_row, zero), s_cone, z_cone)


class _Scaling:
    """The scaling at a point, and Newton's step with it."""

    def __init__(self, p: ConeProgram, point: Point, soft: Array):
        self.p, self.point, self.soft = p, point, soft
        self.d = point.z / point.s
        self.d_t = np.where(soft, point.z_t / np.where(soft, point.t, 1), 0)
        total = np.where(soft, self.d + self.d_t, 1)
        self.share = np.where(soft, self.d / total, 0)
        self.e = np.where(soft, self.share * self.d_t, self.d)
        F = [np.sqrt(self.e)[:, None] * p.G]
        self.squared = np.zeros_like(point.s_cone)
        if len(p.b):
            self._scale_cones()
            self.cone_rows = self._unscaled(p.B).reshape(p.b.size, len(p.q))
            F.append(self.cone_rows)
        rows = np.concatenate(F)
        self.R = cholesky(p.P + rows.T @ rows)

    def _scale_cones(self) -> None:
        """Find W with W z = W^-1 s = lam for every cone."""
        s, z = self.point.s_cone, self.point.z_cone
        of_s, of_z = (np.sqrt(determinant(x)) for x in (s, z))
        s, z = s / of_s[:, None], z / of_z[:, None]
        inner = np.sqrt((1 + (s * z).sum(axis=1)) / 2)
        w = s.copy()
        w[:, 0] += z[:, 0]
        w[:, 1:] -= z[:, 1:]
        self.w = w / (2 * inner[:, None])
        # Renewed from its tail, for the hyperbolic norm of w must be 1 to the last bit.
        self.w[:, 0] = np.sqrt(1 + np.square(self.w[:, 1:]).sum(axis=1))
        self.size = np.sqrt(of_s / of_z)
        self.lam = self._scaled(self.point.z_cone)
        self.squared = product(self.lam, self.lam)

    def _scaled(self, x: Array, sign: int = 1) -> Array:
        """Return W x, for x `(k, d)` or `(k, d, n)`; with sign -1 and 1 / size it is W^-1 x."""
        flat = x.ndim == 2
        x = x[..., None] if flat else x
        w0, w1 = self.w[:, :1, None], sign * self.w[:, 1:, None]
        along = (w1 * x[:, 1:]).sum(axis=1, keepdims=True)
        out = np.concatenate([w0 * x[:, :1] + along, x[:, 1:] + w1 * (x[:, :1] + along / (1 + w0))], axis=1)
        size = self.size if sign > 0 else 1 / self.size
        out = out * size[:, None, None]
        return out[..., 0] if flat else out

    def _unscaled(self, x: Array) -> Array:
        return self._scaled(x, -1)

    def second_order(self, affine: Point) -> Array:
        """Return (W^-1 ds) o (W dz) of the affine step."""
        return product(self._unscaled(affine.s_cone), self._scaled(affine.z_cone))

    def step(
        self, r_y: Array, r_t: Array, r_z: Array, r_c: Array, of_rows: Array, of_t: Array, of_cones: Array
    ) -> Point:
        """Return the step for residuals and the right-hand sides of the complementarities."""
        p, point, soft = self.p, self.point, self.soft
        b_z = -r_z - of_rows / point.z
        b_t = np.where(soft, -of_t / np.where(soft, point.z_t, 1), 0)  # t >= 0 has no residual of its own
        wanted = self.e * (b_z - b_t) - self.share * r_t
        rhs = -r_y + wanted @ p.G
        divided = np.zeros_like(of_cones)
        if len(p.b):
            divided = quotient(self.lam, of_cones)
            b_c = -r_c - self._scaled(divided)
            half = self._unscaled(b_c)
            rhs = rhs + half.ravel() @ self.cone_rows
        y = back(self.R, forward(self.R, rhs))
        moved = p.G @ y
        z = self.e * (moved - b_z + b_t) + self.share * r_t
        t = np.where(soft, (-r_t + self.d * (moved - b_z) - self.d_t * b_t) / np.where(soft, self.d + self.d_t, 1), 0)
        z_t = np.where(soft, r_t - z, 0)
        s = -r_z - moved + t
        if not len(p.b):
            return Point(y, t, s, z, z_t, divided, divided)
        z_cone = self._unscaled(self._unscaled(p.B @ y) - half)
        return Point(y, t, s, z, z_t, -r_c - p.B @ y, z_cone)


def _longest(point: Point, change: Point) -> float:
    """Return the longest step, at most 1 / fraction, that stays within the cones."""
    longest = 1 / SETTINGS.fraction
    pairs = [(point.s, change.s), (point.z, change.z), (point.t, change.t), (point.z_t, change.z_t)]
    for x, d in pairs:
        falls = (d < 0) & (x > 0)
        if falls.any():
            longest = min(longest, float((-x[falls] / d[falls]).min()))
    for x, d in ((point.s_cone, change.s_cone), (point.z_cone, change.z_cone)):
        if len(x):
            longest = min(longest, float(to_boundary(x, d).min()))
    return longest
