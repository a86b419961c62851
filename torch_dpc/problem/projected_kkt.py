"""The paper's projected Karush-Kuhn-Tucker system, as printed: F, J and K, in all n + m unknowns (z, w).

Lemma 1:        (z, w) is optimal iff F = [z - Proj_D(z - P z - q - H'w);  H z - b] = 0.
Proposition 1:  with D1 the Jacobian of Proj_D at z - P z - q - H'w,

    J = [I - D1 (I - P),  D1 H';  H, 0],      K = dF/dtheta,      dS/dtheta = -J^-1 K.

For boxes D1 is diagonal: 1 where a row is free, 0 where it is held at a bound; the rows of g are free. J is badly
scaled: with lambda_s = 1e6 its condition is 1e14, and a least-squares solve with the usual cut-off returns nonsense.
With rows and columns of J' brought to like norms the same solve is right to about 1e-9.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..data.hankel import HankelData
from ..shapes import broadcast_shapes
from .compact_form import CompactForm, compact_form
from .terms import Sizes
from .weights import Weights

#: Rounds of scaling rows and columns. One round of rows alone leaves errors 30 times as large; more gain nothing.
EQUILIBRATION_ROUNDS = 3


def optimality_map(form: CompactForm, z: Tensor, w: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return F of Lemma 1, `(n + m,)`, for bounds on the rows (u, y) of z, `(N,)`."""
    P, q, H, b = form
    pushed = z - P @ z - q - H.T @ w
    n = len(lower)
    projected = torch.cat([torch.minimum(torch.maximum(pushed[:n], lower), upper), pushed[n:]])
    return torch.cat([z - projected, H @ z - b])


def jacobian(P: Tensor, H: Tensor, D1: Tensor) -> Tensor:
    """Return J of Proposition 1, `(n + m, n + m)`.

    Args:
        P, H: of the compact form.
        D1: the Jacobian of the projection, `(n, n)`, or its diagonal `(n,)`: 1 where a row is free, 0 at a bound.
    """
    n, m = len(P), len(H)
    eye = torch.eye(n, dtype=P.dtype, device=P.device)
    top = torch.cat([eye - _apply(D1, eye - P), _apply(D1, H.T)], dim=1)
    return torch.cat([top, torch.cat([H, H.new_zeros(m, m)], dim=1)])


def _apply(D1: Tensor, matrix: Tensor) -> Tensor:
    """Return D1 matrix for the leading block of D1, or the diagonal of that; the rest of D1 is the identity."""
    k = len(D1)
    rows = D1[:, None] * matrix[:k] if D1.ndim == 1 else D1 @ matrix[:k]
    return rows if k == len(matrix) else torch.cat([rows, matrix[k:]])


@dataclass(frozen=True, eq=False)
class FullSystem:
    """The full system of one problem, for the backward of the layer.

    Attributes:
        data: the recorded data.
        weights: one problem's, without a graph.
        is_diagonal: whether D1 is diagonal and given as the rows held at a bound, `(*batch, N)`, boolean; otherwise it
            is a matrix, `(*batch, N, N)`.
    """

    data: HankelData
    weights: Weights
    is_diagonal: bool

    #: What `Adjoint` reads besides: D1 does not move with a derivative, because there is no second one.
    sets = None

    @property
    def tails(self) -> tuple[int, ...]:
        """How many dimensions of D1 are its own."""
        return (1,) if self.is_diagonal else (2,)

    def check_second_derivative(self) -> None:
        """Raise NotImplementedError."""
        raise NotImplementedError('backward="full" gives first derivatives; use backward="reduced" for higher ones.')

    @cached_property
    def _form(self) -> CompactForm:
        sizes = Sizes.of(self.data)
        zero = torch.zeros(sum(sizes.theta), dtype=torch.float64, device=self.weights.Q.device)
        return compact_form(self.data, self.weights, zero)

    def adjoint(self, v_bar: Tensor | None, lam_bar: Tensor | None, G: Tensor, D: list[Tensor]) -> Tensor:
        """Return theta_bar and the first N entries of nu side by side, `(*batch, n_theta + N)`.

        With J' nu = (z_bar, w_bar), theta_bar = -K' nu, and a parameter s of the set has s_bar = (dP/ds)' nu.

        Args:
            v_bar, lam_bar: cotangents of v = (u, y) and lam, `(*batch, N)`; None for zero.
            G: not used.
            D: D1 as one tensor.
        """
        (D1,) = D
        like = v_bar if v_bar is not None else lam_bar
        assert like is not None
        v_bar, lam_bar = (torch.zeros_like(like) if bar is None else bar for bar in (v_bar, lam_bar))
        tail = self.tails[0]
        batch = broadcast_shapes(v_bar.shape[:-1], lam_bar.shape[:-1], D1.shape[: D1.ndim - tail])
        flat = [bar.expand(*batch, -1).reshape(-1, bar.shape[-1]) for bar in (v_bar, lam_bar)]
        D1 = D1.expand(*batch, *D1.shape[D1.ndim - tail :]).reshape(-1, *D1.shape[D1.ndim - tail :])
        out = v_bar.new_empty(len(flat[0]), sum(Sizes.of(self.data).theta) + v_bar.shape[-1])
        for i, sample in enumerate(zip(*flat, D1, strict=True)):
            out[i] = self._one(*sample)
        return out.reshape(*batch, out.shape[-1])

    def _one(self, v_bar: Tensor, lam_bar: Tensor, D1: Tensor) -> Tensor:
        P, _, H, _ = self._form
        sizes, n_v = Sizes.of(self.data), len(v_bar)
        D1 = (~D1).to(P) if self.is_diagonal else D1
        # lam = w_v - blkdiag(R, Q) (v - ref): its cotangent reaches z, w and, at the end, the references.
        weighted = P[:n_v, :n_v] @ lam_bar
        bar = v_bar.new_zeros(len(P) + len(H))
        bar[:n_v] = v_bar - weighted
        bar[-n_v:] = lam_bar
        nu = _scaled_least_squares(jacobian(P, H, D1).T, bar)
        of_q, of_b = -_apply(D1 if self.is_diagonal else D1.T, nu[: len(P), None])[:, 0], nu[len(P) :]
        Yp = self.data.Yp.detach().to(nu)
        refs = -P[:n_v, :n_v] @ of_q[:n_v] + weighted
        y_ini = -2 * self.weights.lambda_s * (Yp @ of_q[n_v:])
        return torch.cat([of_b[: sizes.u_ini], y_ini, refs, nu[:n_v]])


def _scaled_least_squares(matrix: Tensor, rhs: Tensor) -> Tensor:
    """Return the minimum-norm least-squares solution, after bringing rows and columns to like norms (Ruiz 2001)."""
    scale_rows, scale_columns = torch.ones_like(rhs), torch.ones_like(rhs)
    for _ in range(EQUILIBRATION_ROUNDS):
        scaled = scale_rows[:, None] * matrix * scale_columns
        scale_rows = scale_rows / _root_norm(scaled, dim=1)
        scale_columns = scale_columns / _root_norm(scaled, dim=0)
    scaled = scale_rows[:, None] * matrix * scale_columns
    solution = torch.linalg.lstsq(scaled.cpu(), (scale_rows * rhs)[:, None].cpu(), driver="gelsd").solution[:, 0]
    return scale_columns * solution.to(rhs.device)


def _root_norm(matrix: Tensor, dim: int) -> Tensor:
    norm = torch.linalg.vector_norm(matrix, dim=dim)
    return torch.where(norm > 0, norm, 1.0).sqrt()
