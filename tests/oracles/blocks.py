"""The sets on the reduced variables, channels scaled: M x + m in an interval (hard or priced), a ball or a cone."""

from dataclasses import dataclass

import numpy as np

from .extended import LONG, Array, long
from .problem import Problem

DECIDED = 1e-12  # an entry of v that moves less than this share of its channel is decided by the equalities


@dataclass(frozen=True)
class Block:
    """Rows z = M x + m. An interval has one row and ends; a ball a radius; a cone its bound first."""

    kind: str
    rows: Array  # z = shares * (v / scale)[rows] - center
    shares: Array
    center: Array
    M: Array
    m: Array
    lower: LONG = LONG(-np.inf)
    upper: LONG = LONG(np.inf)
    price: LONG = LONG(np.inf)
    radius: LONG = LONG(0)
    decided: bool = False  # the equalities leave it no choice

    def z_of(self, v: Array) -> Array:
        return self.shares * v[self.rows] - self.center

    @property
    def hard(self) -> bool:
        return not np.isfinite(self.price)

    def violation(self, z: Array) -> LONG:
        if self.kind == "interval":
            return np.maximum(np.maximum(self.lower - z[0], z[0] - self.upper), 0)
        if self.kind == "ball":
            return np.maximum(norm(z) - self.radius, 0)
        return np.maximum(norm(z[1:]) - z[0], 0)

    def dual_feasible(self, lam: Array) -> Array:
        """Return the nearest multiplier whose bound on the cost is finite."""
        if self.kind == "interval":
            low = -self.price if np.isfinite(self.lower) else LONG(0)
            high = self.price if np.isfinite(self.upper) else LONG(0)
            return np.clip(lam, low, high)
        if self.kind == "cone":
            return -_onto_cone(-lam)
        return lam

    def support(self, lam: Array) -> LONG:
        """Return the supremum of lam z over the set, for a multiplier that is dual feasible."""
        if self.kind == "interval":
            value = lam[0]
            return value * self.upper if value > 0 else value * self.lower if value < 0 else LONG(0)
        return self.radius * norm(lam) if self.kind == "ball" else LONG(0)

    def charge(self, z: Array) -> LONG:
        return LONG(0) if self.hard else self.price * self.violation(z)


def norm(x: Array) -> LONG:
    return np.sqrt((x**2).sum())


def _onto_cone(x: Array) -> Array:
    """Return the projection onto |x_1:| <= x_0."""
    size = norm(x[1:])
    if size <= x[0]:
        return x
    if size <= -x[0]:
        return np.zeros_like(x)
    half = (size + x[0]) / 2
    return np.concatenate([[half], half * x[1:] / size])


def blocks_of(p: Problem, C: Array, c: Array, natural: Array) -> list[Block]:
    """Return the constraints that bind at all, on v / scale = C x + c; `natural` says which entries can move."""
    scale = long(p.scale_v)
    fixed = (natural**2).sum(1) < DECIDED**2
    found = []
    for piece in p.pieces:
        if piece.kind == "interval":
            size = scale[piece.rows]
            for i, row in enumerate(piece.rows):
                lower, upper, price = (end[i] for end in (piece.lower, piece.upper, piece.price))
                if np.isfinite(lower) or np.isfinite(upper):
                    ends = (LONG(lower) / size[i], LONG(upper) / size[i], LONG(price) * size[i])
                    at = np.array([row])
                    ones, zeros = np.ones(1, LONG), np.zeros(1, LONG)
                    found.append(Block("interval", at, ones, zeros, C[at], c[at], *ends, decided=bool(fixed[row])))
            continue
        size = scale[piece.rows].max()
        shares = scale[piece.rows] / size
        ball = piece.kind == "ball"
        center = long(piece.center) / size if ball else np.zeros(len(shares), LONG)
        M, m = shares[:, None] * C[piece.rows], shares * c[piece.rows] - center
        radius = LONG(piece.radius) / size if ball else LONG(0)
        decided = bool(fixed[piece.rows].all())
        found.append(Block(piece.kind, piece.rows, shares, center, M, m, radius=radius, decided=decided))
    return found
