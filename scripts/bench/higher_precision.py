"""The plan and its gradient in higher precision, against which the benchmark measures every solver.

With the rows A that the solution holds at their bounds b_A, the problem is a linear system. In the coordinates
g = B a of the data's row space (`torch_dpc.problem.reduction.DataRows`),

    [Psi Up' C_A'; Up 0 0; C_A 0 0] [a; mu; nu] = [phi; u_ini; b_A],
    Psi = Uf'R Uf + Yf'Q Yf + 2 lambda_g M + 2 lambda_s Yp'Yp,     phi = Uf'R u_ref + Yf'Q y_ref + 2 lambda_s Yp'y_ini,

and v = (u, y) = C a. The gradient of sum(u) with respect to y_ini follows from the same symmetric matrix K,

    K [a_bar; *; *] = [Uf'1; 0; 0],     y_ini_bar = 2 lambda_s Yp a_bar.

Everything from the data and B on is done in NumPy's longdouble, on x86 with 64 bits of mantissa against 53 of float64:
the rows, Psi, and one Gaussian elimination with row equilibration and partial pivoting for both right sides.

Of the layer's factors and solvers nothing enters but B and the set A, and the set is checked: the multipliers nu must
clearly have the right signs and the free rows clearly keep a distance (`STRICT`). A free row that touches its bound
(on the masses the last input, which moves no output of the plan, equals its reference and so its bound) is let pass
where holding it too gives the same gradient. Where any of this fails the sample has no reference, because its gradient
may not exist.

The same elimination in float64 loses 2^11 times as much: what it differs by, divided by 2^11, estimates the error of
the reference itself (`Reference.error`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

import torch_dpc as dpc
from scripts.shared.rows import Array

#: A held row's multiplier must move it, and a free row must keep from its bounds, by this, relative to 1 + |bound|.
STRICT = 1e-6
#: Up to this, two results in higher precision are the same.
ROUNDING = 1e-9
#: Rows of K whose pivot falls below this after equilibration are dependent.
DEPENDENT = 1e-15

Wide = np.longdouble


@dataclass(frozen=True)
class Reference:
    """The plan of one sample.

    Attributes:
        v: (u, y) flattened, `(horizon (n_u + n_y),)`.
        gradient: of sum(u) with respect to y_ini, `(t_ini, n_y)`.
        error: estimated relative errors of v and of the gradient.
    """

    v: Array
    gradient: Array
    error: tuple[float, float]


class HigherPrecision:
    """One layer's problem in longdouble.

    Args:
        layer: with boxes and with weights that are constants.
    """

    def __init__(self, layer: dpc.DPCLayer):
        self._layer, data = layer, layer.data
        assert isinstance(data, dpc.HankelData)
        basis = _wide(data.row_space.basis)
        self.Up, self.Yp, self.Uf, self.Yf = (_wide(m) @ basis for m in (data.Up, data.Yp, data.Uf, data.Yf))
        self.C = np.concatenate([self.Uf, self.Yf])
        weights = layer.reduction.weights
        self.R, self.Q, lambda_g, self.lambda_s = map(_wide, (weights.R, weights.Q, weights.lambda_g, weights.lambda_s))
        M = np.zeros(basis.shape[1], dtype=Wide)
        M[data.row_space.rank_W :] = 1
        self.Psi = (
            self.Uf.T @ (self.R @ self.Uf)
            + self.Yf.T @ (self.Q @ self.Yf)
            + 2 * lambda_g * np.diag(M)
            + 2 * self.lambda_s * (self.Yp.T @ self.Yp)
        )
        self._G_diagonal = layer.reduction.G.diagonal().numpy()
        self.lower, self.upper = (bound.numpy() for bound in layer.bounds(torch.device("cpu")))

    def solve(self, lam: Array, u_ini: Array, y_ini: Array, y_ref: Array, u_ref: Array) -> Reference | None:
        """Return the plan of one sample, or None where its gradient may not exist.

        Args:
            lam: the multipliers of the layer's solution, which say what rows are held, `(horizon (n_u + n_y),)`.
            u_ini, y_ini: the past, `(t_ini, n_u)` and `(t_ini, n_y)`.
            y_ref, u_ref: the references, which broadcast to the horizon.
        """
        horizon = self._layer.data.horizon
        u_ref, y_ref = (_wide(np.broadcast_to(ref, (horizon, np.shape(ref)[-1]))).ravel() for ref in (u_ref, y_ref))
        theta = _wide(u_ini).ravel(), _wide(y_ini).ravel(), u_ref, y_ref
        held, bound = lam != 0, np.where(lam > 0, self.upper, self.lower)
        found = self._with(held, bound, theta)
        if found is None:
            return None
        v, gradient, nu = found
        gap = np.minimum(self.upper - v, v - self.lower) / (1 + abs(v))
        moved = np.sign(lam[held]) * nu * self._G_diagonal[held] / (1 + abs(bound[held]))
        touching = ~held & (gap < STRICT)
        if (moved < STRICT).any() or (gap[touching] < -ROUNDING).any():
            return None
        if touching.any():
            bound[touching] = np.where(self.upper - v < v - self.lower, self.upper, self.lower)[touching]
            also = self._with(held | touching, bound, theta)
            if also is None or relative(also[1], gradient) > ROUNDING:
                return None
        rough = self._with(held, bound, theta, np.float64)
        precision = float(np.finfo(Wide).eps / np.finfo(np.float64).eps)
        error = (np.inf, np.inf)
        if rough is not None:
            error = precision * relative(rough[0], v), precision * relative(rough[1], gradient)
        return Reference(v.astype(float), gradient.reshape(np.shape(y_ini)).astype(float), error)

    def _with(self, held: Array, bound: Array, theta: tuple[Array, ...], kind: type = Wide) -> tuple[Array, ...] | None:
        """Return v, the gradient and nu with the rows `held` at their bounds; None where those are dependent."""
        K, right = self._system(held, bound[held], *theta)
        solution = eliminate(K.astype(kind), right.astype(kind))
        if solution is None:
            return None
        a, a_bar = solution[: self.C.shape[1]].T
        return self.C @ a, 2 * self.lambda_s * (self.Yp @ a_bar), solution[len(K) - held.sum() :, 0]

    def _system(self, held: Array, bound: Array, *theta: Array) -> tuple[Array, Array]:
        u_ini, y_ini, u_ref, y_ref = theta
        rows = np.concatenate([self.Up, self.C[held]])
        K = np.block([[self.Psi, rows.T], [rows, np.zeros((len(rows), len(rows)), dtype=Wide)]])
        right = np.zeros((len(K), 2), dtype=Wide)
        phi = self.Uf.T @ (self.R @ u_ref) + self.Yf.T @ (self.Q @ y_ref) + 2 * self.lambda_s * (self.Yp.T @ y_ini)
        right[:, 0] = np.concatenate([phi, u_ini, bound])
        right[: len(phi), 1] = self.Uf.sum(axis=0)
        return K, right


def eliminate(matrix: Array, right: Array) -> Array | None:
    """Return matrix^-1 right by Gaussian elimination in their own precision; None for a singular matrix.

    Args:
        matrix: `(n, n)`.
        right: `(n, k)`.
    """
    n = len(matrix)
    work = np.concatenate([matrix, right], axis=1)
    work /= abs(matrix).max(axis=1, keepdims=True)  # rows of one size, so that pivots can be compared
    for k in range(n):
        best = k + int(abs(work[k:, k]).argmax())
        if not abs(work[best, k]) > DEPENDENT:
            return None
        work[[k, best]] = work[[best, k]]
        below = work[k + 1 :, k] / work[k, k]
        work[k + 1 :, k + 1 :] -= below[:, None] * work[k, k + 1 :]
    solution = work[:, n:].copy()
    for k in range(n - 1, -1, -1):
        solution[k] = (solution[k] - work[k, k + 1 : n] @ solution[k + 1 :]) / work[k, k]
    return solution


def relative(found: Array, exact: Array) -> float:
    """Return |found - exact| / |exact|; a plain norm, in the precision that came."""
    return float(np.sqrt(((found - exact) ** 2).sum()) / np.sqrt((exact**2).sum()))


def _wide(value: Array | torch.Tensor) -> Array:
    return np.asarray(value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value).astype(Wide)
