"""The paper's map F at a solution, evaluated block by block in the coordinates of the row space.

    F = [z - Proj_D(z - P z - q - H'w);  H z - b],        z = (u, y, g),  w = (w_p, w_u, w_y)

The multipliers of u = Uf g and y = Yf g follow from lam: w_u = R (u - u_ref) + lam_u, w_y = Q (y - y_ref) + lam_y, so
that the first blocks read v - Proj(v + lam). w_p, of Up g = u_ini, is the least-squares choice, which leaves in the
block of g its part in the kernel of Up. B is orthonormal: norms in its coordinates are those of the n_g entries of g.

The code runs on torch tensors and, for single samples, on NumPy arrays.
"""

from __future__ import annotations

from typing import Any

from .reduction import Reduction


class Optimality:
    """F relative to its own terms, for one reduction.

    Args:
        reduction: the reduced problem.
        as_array: what turns its tensors into the arrays that the calls will bring.
    """

    def __init__(self, reduction: Reduction, as_array: Any):
        rows, weights = reduction.rows, reduction.weights
        self.n_up, self.n_yp, self.n_u = rows.Up.shape[0], rows.Yp.shape[0], rows.Uf.shape[0]
        names = {
            "A_theta": reduction.A_theta, "A_lam": reduction.A_lam, "Up": rows.Up, "Yp": rows.Yp, "C": rows.C,
            "R": weights.R, "Q": weights.Q, "C_Z": rows.C @ rows.Z, "Yp_Z": rows.Yp @ rows.Z,
            "M_Z": rows.Z[rows.rank_W :],
        }  # fmt: skip
        for name, value in names.items():
            setattr(self, name, as_array(value.detach()))
        self.lambda_g, self.lambda_s = as_array(weights.lambda_g.detach()), as_array(weights.lambda_s.detach())
        self.rank_W = rows.rank_W
        self.size_Up, self.size_C = (float(m.detach().norm()) for m in (rows.Up, rows.C))

    def residual(self, theta: Any, v: Any, v0: Any, lam: Any, lower: Any, upper: Any) -> Any:
        """Return the sum over the blocks of |F| relative to its terms, `(B,)`."""
        u_ini, y_ini, refs = self._split(theta)
        a = _times(self.A_theta, theta) - _times(self.A_lam, lam)
        size_a = _norm(a)
        # z - Proj_D(z - P z - q - H'w), the rows of u and y
        in_set = _norm(v - (v + lam).clip(lower, upper)) / _positive(_norm(v) + _norm(v0))
        # H z - b: Up g = u_ini, and (u, y) = (Uf, Yf) g
        past = _norm(_times(self.Up, a) - u_ini) / _positive(_norm(u_ini) + self.size_Up * size_a)
        future = _norm(_times(self.C, a) - v) / _positive(_norm(v) + self.size_C * size_a)
        # 2 lambda_g M g + 2 lambda_s Yp'(Yp g - y_ini) + Uf'w_u + Yf'w_y, on the kernel of Up
        gap = v - refs
        w_u = _times(self.R, gap[..., : self.n_u]) + lam[..., : self.n_u]
        w_y = _times(self.Q, gap[..., self.n_u :]) + lam[..., self.n_u :]
        slack = _times(self.Yp, a)
        weight_s, weight_g = 2 * self.lambda_s[..., None], 2 * self.lambda_g[..., None]
        terms = (
            _combine(weight_s * slack, self.Yp_Z),
            -_combine(weight_s * y_ini, self.Yp_Z),
            _combine(weight_g * a[..., self.rank_W :], self.M_Z),
            _combine(w_u, self.C_Z[: self.n_u]),
            _combine(w_y, self.C_Z[self.n_u :]),
        )
        total = sum(terms[1:], terms[0])
        size = sum((_norm(t) for t in terms[1:]), _norm(terms[0]))
        return in_set + past + future + _norm(total) / _positive(size)

    def _split(self, theta: Any) -> tuple[Any, Any, Any]:
        cut = self.n_up + self.n_yp
        return theta[..., : self.n_up], theta[..., self.n_up : cut], theta[..., cut:]


def _times(matrix: Any, x: Any) -> Any:
    return x @ matrix.mT if matrix.ndim == 2 else (matrix @ x[..., None])[..., 0]


def _combine(weights: Any, rows: Any) -> Any:
    return weights @ rows


def _norm(x: Any) -> Any:
    return (x * x).sum(-1) ** 0.5


def _positive(x: Any) -> Any:
    """Keep 0 / 0 at 0."""
    return x + 1e-300
