"""The algebra of the cones {|x_1:| <= x_0}: arrays `(k, d)` of k vectors, in extended precision."""

from __future__ import annotations

import numpy as np

from ..problem.long_double import Array


def inside(x: Array) -> Array:
    """Return how far each cone vector `(k, d)` is inside its cone."""
    return x[:, 0] - np.sqrt(np.square(x[:, 1:]).sum(axis=1))


def determinant(x: Array) -> Array:
    """Return x_0^2 - |x_1:|^2 of each vector, without its cancellation."""
    norm = np.sqrt(np.square(x[:, 1:]).sum(axis=1))
    return (x[:, 0] - norm) * (x[:, 0] + norm)


def product(x: Array, y: Array) -> Array:
    """Return the Jordan product of cone vectors."""
    return np.concatenate([(x * y).sum(axis=1, keepdims=True), x[:, :1] * y[:, 1:] + y[:, :1] * x[:, 1:]], axis=1)


def quotient(x: Array, y: Array) -> Array:
    """Return u with x o u = y."""
    along = (x[:, 1:] * y[:, 1:]).sum(axis=1)
    first = (x[:, 0] * y[:, 0] - along) / determinant(x)
    return np.concatenate([first[:, None], (y[:, 1:] - first[:, None] * x[:, 1:]) / x[:, :1]], axis=1)


def to_boundary(x: Array, d: Array) -> Array:
    """Return the step from x along d to the boundary of each cone; infinite if there is none."""
    a, c = d[:, 0] ** 2 - np.square(d[:, 1:]).sum(axis=1), determinant(x)
    b = x[:, 0] * d[:, 0] - (x[:, 1:] * d[:, 1:]).sum(axis=1)
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    # The zeros of c + 2 b t + a t^2, without cancellation; the first positive one, or none.
    q = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        zeros = np.stack([q / a, c / q])
    zeros = np.where(np.isfinite(zeros) & (zeros > 0), zeros, np.inf)
    leaves = (b * b - a * c >= 0) & ((a < 0) | (b < 0))
    return np.where(leaves, zeros.min(axis=0), np.inf)
