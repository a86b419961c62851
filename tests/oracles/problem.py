"""The problem as posed, in NumPy, and what makes a trajectory right for it. Nothing here is reduced or solved.

    minimise    1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2 + 1/2 |du|_R_du^2
                + lambda_g |M g|^2 + lambda_s |Yp g - y_ini|^2 + lambda_u |Up g - u_ini|^2
                + prices of what leaves a soft interval
    subject to  Up g = u_ini (without lambda_u),  u = Uf g,  y = Yf g,  the last outputs equal y_ref,  sets of u, y, du

v = (u, y, du), time-major; a set is a list of pieces, each over some entries of v.
"""

from dataclasses import dataclass, field

import numpy as np

from .extended import Array, long


@dataclass(frozen=True)
class Piece:
    """One constraint on v[rows]: lower <= v <= upper (hard, or priced per unit), |v - center| <= radius, or a cone."""

    kind: str  # "interval", "ball", "cone" (the first entry bounds the norm of the others)
    rows: Array
    lower: Array | None = None
    upper: Array | None = None
    price: Array | None = None  # inf: hard
    radius: float = 0.0
    center: Array | None = None

    def outside(self, v: Array) -> Array:
        """Return how far each entry (interval) or the block lies outside, in the units of v."""
        x = v[self.rows]
        if self.kind == "interval":
            return np.maximum(np.maximum(self.lower - x, x - self.upper), 0)
        if self.kind == "ball":
            return np.maximum(_norm(x - self.center) - self.radius, 0)[None]
        return np.maximum(_norm(x[1:]) - x[0], 0)[None]


def _norm(x: Array) -> Array:
    return np.sqrt((long(x) ** 2).sum())


@dataclass(frozen=True)
class Problem:
    """Data, weights and sets in the units of the user. Weights are `(horizon n, horizon n)`."""

    Up: Array
    Uf: Array
    Yp: Array
    Yf: Array
    n_u: int
    n_y: int
    t_ini: int
    horizon: int
    Q: Array
    R: Array
    lambda_g: float
    lambda_s: float
    R_du: Array | None = None
    lambda_u: float | None = None
    regularizer: str = "projection"
    terminal_steps: int = 0
    pieces: list[Piece] = field(default_factory=list)

    @property
    def scale_u(self) -> Array:
        """The largest recorded value of each input; 1 where there is none."""
        return _scale(self.Up, self.Uf, self.n_u)

    @property
    def scale_y(self) -> Array:
        return _scale(self.Yp, self.Yf, self.n_y)

    @property
    def scale_v(self) -> Array:
        """The scale of each entry of v = (u, y, du)."""
        u, y = np.tile(self.scale_u, self.horizon), np.tile(self.scale_y, self.horizon)
        return np.concatenate([u, y, u])

    def v_of(self, u: Array, y: Array, u_ini: Array) -> Array:
        """Return v = (u, y, du) flattened."""
        du = np.diff(np.concatenate([long(u_ini)[-1:], long(u)]), axis=0)
        return np.concatenate([long(u).ravel(), long(y).ravel(), du.ravel()])


def _scale(past: Array, future: Array, n: int) -> Array:
    size = np.abs(np.concatenate([past, future])).reshape(-1, n, past.shape[1]).max(axis=(0, 2))
    return np.where(size > 0, size, 1.0).astype(float)


@dataclass(frozen=True)
class Sample:
    """What one call is given, flattened by nobody: `(t_ini, n)` and `(horizon, n)`."""

    u_ini: Array
    y_ini: Array
    u_ref: Array
    y_ref: Array


def root(weight: Array) -> Array:
    """Return F with F'F = weight, exact for each channel's own weight, however unlike the channels are."""
    diagonal = np.diagonal(weight)
    if not (weight - np.diag(diagonal)).any():
        return np.diag(np.sqrt(long(diagonal)))
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(weight / np.outer(size, size))
    keep = values > 1e-14 * values[-1]
    return long(np.sqrt(values[keep])[:, None] * vectors.T[keep]) * size
