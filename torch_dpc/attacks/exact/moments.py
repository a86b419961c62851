"""Bounds over all plans of a budget by a moment relaxation: what complementarity says of second moments.

z = (1, s, lam) and v = v0 + A s - G lam. Products that are known for every plan, row by row, become forms of a
semidefinite program (:mod:`torch_dpc.attacks.exact.semidefinite`):

    only the upper bound within reach    lam (upper - v) = 0,  lam >= 0,  v <= upper,  lam (cap - lam) >= 0
    both bounds within reach             lam (v - upper) >= 0,  lam (v - lower) >= 0,  lam (v - line(lam)) >= 0

where line passes through (cap_high, upper) and (-cap_low, lower), caps being bounds of the multiplier. The budget is
r^2 - |N s + o|^2 >= 0, and plans that are better than one in hand have cut - psi >= 0. No row is decided: the bound
holds for every active set at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from ..budgets.base import NormBound
from .complementarity import HIGH, LOW, Array, Rows, allowed_states
from .relaxation import Linear, Quadratic
from .semidefinite import Program, prove


@dataclass(frozen=True)
class MomentSettings:
    """Constants of the relaxation: multipliers that it starts from, relative to that of the complementarity."""

    multiplier: float = 0.1  # of the complementarity of a psi of order 1
    inside: float = 0.05  # share of each bound's multiplier, where one of the two would do
    by_cap: float = 0.1  # share of the form with the caps
    signs: float = 0.1  # of the signs of lam and of upper - v, in units of each
    budget: float = 0.3  # of the budget, times |X|^2
    cut: float = 0.01  # of cut - psi
    floor: float = 1e-13  # least eigenvalue of the scaled G in the change of coordinates, relative


SETTINGS = MomentSettings()


class Bounded(NamedTuple):
    """A bound, and what it says of every other function of the plan.

    Attributes:
        bound: of the objective from below.
        most: functionals `(n, N)` of z -> upper bounds over all plans, `(n,)`; None where the proof holds none.
    """

    bound: float
    most: Callable[[Array], Array] | None


class Moments:
    """The relaxation of some rows.

    Args:
        rows: with their intervals, which give the caps and say which bounds are within reach.
        pieces: the budget in s.
        lam: of the plan at s = 0, `(n,)`, where the search for multipliers starts.
        better_than: psi and a value; only plans with a smaller psi count.
    """

    def __init__(
        self,
        rows: Rows,
        pieces: list[NormBound],
        lam: Array,
        better_than: tuple[Quadratic, float] | None = None,
    ):
        states = allowed_states(rows)
        self.high, self.low = (states & HIGH) != 0, (states & LOW) != 0
        self.open = self.high | self.low
        pick, d = np.flatnonzero(self.open), rows.A.shape[1]
        self.pick, self.n, self.d = pick, len(pick), d
        self.high, self.low = self.high[pick], self.low[pick]
        G = rows.G[np.ix_(pick, pick)]
        self.scale = 1 / np.sqrt(np.maximum(G.diagonal(), np.finfo(float).tiny))
        self.one = np.eye(1 + d + self.n)[0]
        self.lam = np.hstack([np.zeros((self.n, 1 + d)), np.diag(1 / self.scale)])
        self.v = np.hstack([rows.v0[pick, None], rows.A[pick], -G]) * self.scale[:, None]
        self.upper, self.lower = rows.upper[pick] * self.scale, rows.lower[pick] * self.scale
        self.caps = np.maximum(rows.lam_high[pick], 0.0) / self.scale, np.maximum(-rows.lam_low[pick], 0.0) / self.scale
        self.nominal = lam[pick] / self.scale
        scaled = G * self.scale[:, None] * self.scale
        values, vectors = np.linalg.eigh(scaled) if self.n else (np.ones(0), np.ones((0, 0)))
        root = vectors / np.sqrt(np.maximum(values, SETTINGS.floor * values.max(initial=1.0)))
        self.T = scipy.linalg.block_diag(np.eye(1 + d), root * self.scale[:, None])
        self.G_scaled = scaled
        self.dense = [_dense(piece, self.one, d) for piece in pieces]
        inner = sum(piece.matrix.T @ piece.matrix for piece in pieces)
        reach = (root * self.scale[:, None]).T @ rows.A[pick] if self.n else np.zeros((1, d))
        self.spread = float(np.linalg.eigvalsh(reach.T @ reach @ np.linalg.pinv(inner)).max(initial=0.0)) if d else 0.0
        self.better_than = None
        if better_than is not None:
            psi, value = better_than
            self.better_than = value * np.outer(self.one, self.one) - self.quadratic(psi)

    def quadratic(self, objective: Quadratic) -> Array:
        """Return the matrix of an objective of all rows."""
        rows = np.hstack([objective.a[:, None], objective.B_s, objective.B_lam[:, self.pick]])
        return rows.T @ rows / 2

    def linear(self, objective: Linear, constant: float = 0.0) -> Array:
        """Return the matrix of an objective of all rows."""
        return self._form(self.one, np.concatenate([[constant], objective.c_s, objective.c_lam[self.pick]]))

    def multipliers(self, weight: Array) -> Array:
        """Return the matrix of minus the sum of weight |lam| / scale, `weight` one number for each open row."""
        half, middle = (self.upper - self.lower) / 2, (self.upper + self.lower) / 2
        F = np.zeros((len(self.one), len(self.one)))
        for i in np.flatnonzero(weight):
            if self.high[i] and self.low[i]:  # |lam| = lam (v - middle) / half
                F -= weight[i] * self._form(self.lam[i], (self.v[i] - middle[i] * self.one) / half[i])
            else:
                F -= weight[i] * self._form(self.one, self.lam[i] if self.high[i] else -self.lam[i])
        return F

    def minimum(
        self,
        F: Array,
        weight: Array | None = None,
        *,
        enough: float = np.inf,
        tolerance: float = 1e-3,
        deadline: float = np.inf,
    ) -> Bounded | None:
        """Return a lower bound of z'Fz over all plans; None where rows depend on each other too much to start.

        Args:
            F: objective.
            weight: what `multipliers` took to make F.
            enough, tolerance, deadline: as of :func:`torch_dpc.attacks.exact.semidefinite.prove`.
        """
        a, b, inequality, y = self._forms(weight)
        D = np.stack([*self.dense, *([] if self.better_than is None else [self.better_than])])
        T = self.T
        program = Program(T.T @ F @ T, a @ T, b @ T, T.T @ D @ T, inequality)
        proof = prove(program, y, enough=enough, tolerance=tolerance, deadline=deadline)
        if proof is None:
            return None
        return Bounded(proof.bound, self._ellipsoid(proof.M - program.F, proof.bound))

    def _form(self, a: Array, b: Array) -> Array:
        return (np.outer(a, b) + np.outer(b, a)) / 2

    def _forms(self, weight: Array | None) -> tuple[Array, Array, np.ndarray, Array]:
        """Return a, b, which forms are inequalities, and multipliers to start from.

        With the same multiplier t for every row, t lam'w and the linear terms of the plan at s = 0, w = upper - v or
        v - lower, the forms add up to t dlam'(G dlam - A s): positive semidefinite together with the budget's.
        """
        one, both = np.broadcast_to(self.one, self.v.shape), self.high & self.low
        half = np.where(both, (self.upper - self.lower) / 2, 1.0)
        w = np.where(both, (np.zeros(self.n) if weight is None else weight) / half, 0.0)
        t = max(SETTINGS.multiplier, 10 * float(w.max(initial=0.0)))
        v = self.v[:, 0] - self.G_scaled @ self.nominal
        with np.errstate(invalid="ignore"):
            middle = (self.upper + self.lower) / 2
            centre = (t * v - np.where(both, w * middle, 0.0)) / (t - w)
            share = np.clip((centre - self.lower) / (2 * half), 0.0, 1.0)
        share = SETTINGS.inside + (1 - 2 * SETTINGS.inside) * np.where(both, share, 0.0)
        top, bottom = self.upper[:, None] * one - self.v, self.v - self.lower[:, None] * one
        caps = np.where(both, self.caps[0] + self.caps[1], np.where(self.high, self.caps[0], self.caps[1]))
        capped = np.isfinite(caps)
        r = (t - w) * np.where(capped, 1 - SETTINGS.by_cap, 1.0)
        blocks = [
            (self.lam, -top, both, both, r * share),
            (self.lam, bottom, both, both, r * (1 - share)),
            (self.lam, -top, self.high & ~both, ~self.high, np.full(self.n, t)),
            (self.lam, bottom, self.low & ~both, ~self.low, np.full(self.n, t)),
        ]
        slope = np.where(both & capped, 2 * half / np.where(capped, np.maximum(caps, 1e-300), 1.0), 0.0)
        with np.errstate(invalid="ignore"):
            line = (self.upper - slope * self.caps[0])[:, None] * one + slope[:, None] * self.lam
        blocks.append((self.lam, self.v - line, both & capped, both, (t - w) * SETTINGS.by_cap))
        sign = np.where(self.high, 1.0, -1.0)[:, None]
        with np.errstate(invalid="ignore"):
            below_cap = np.where(capped, caps, 0.0)[:, None] * one - sign * self.lam
        blocks.append((sign * self.lam, below_cap, ~both & capped, ~both, np.full(self.n, 1e-3 * t)))
        gap = np.where(self.high, self.upper - v, v - self.lower)
        blocks.append((one, sign * self.lam, ~both, ~both, t * np.maximum(gap, 0.0) + self._unit(self.lam, t)))
        at = np.maximum(self.nominal, 0.0), np.maximum(-self.nominal, 0.0)
        blocks.append((one, top, self.high, self.high, t * at[0] + self._unit(top, t)))
        blocks.append((one, bottom, self.low, self.low, t * at[1] + self._unit(bottom, t)))
        a, b = (np.vstack([self.one, *[block[k][block[2]] for block in blocks]]) for k in (0, 1))
        inequality = np.concatenate([[False], *[signed[on] for _, _, on, signed, _ in blocks]])
        cut = [] if self.better_than is None else [SETTINGS.cut * t]
        dense = np.full(len(self.dense), SETTINGS.budget * t * self.spread + 1e-3)
        y = np.concatenate([[-dense.sum() - 1], *[y[on] for _, _, on, _, y in blocks], dense, cut])
        return a, b, inequality, y

    def _unit(self, functionals: Array, t: float) -> Array:
        """Return a small multiplier of linear forms, relative to their size."""
        with np.errstate(invalid="ignore"):
            return SETTINGS.signs * t / np.linalg.norm(functionals @ self.T, axis=1)

    def _ellipsoid(self, rest: Array, bound: float) -> Callable[[Array], Array] | None:
        """Return the bounds that M - F + bound e_0 e_0' gives: minus the sum of the forms, not positive for any plan.

        That is an ellipsoid of z that holds every plan; a linear functional has its maximum there in closed form.
        """
        Q = rest.copy()
        Q[0, 0] += bound
        try:
            root = scipy.linalg.cholesky(Q[1:, 1:], lower=True)
        except np.linalg.LinAlgError:
            return None
        centre = scipy.linalg.solve_triangular(root, Q[1:, 0], lower=True)
        radius = float(centre @ centre - Q[0, 0])
        if radius < 0:
            return None

        def most(functionals: Array) -> Array:
            f = functionals @ self.T
            x = scipy.linalg.solve_triangular(root, f[:, 1:].T, lower=True)
            return f[:, 0] - centre @ x + np.sqrt(radius * (x * x).sum(0))

        return most


def _dense(piece: NormBound, one: Array, d: int) -> Array:
    """Return radius^2 - |matrix s + offset|^2 as a form of z."""
    X = np.zeros((len(piece.matrix), len(one)))
    X[:, 0], X[:, 1 : 1 + d] = piece.offset, piece.matrix
    return piece.radius**2 * np.outer(one, one) - X.T @ X
