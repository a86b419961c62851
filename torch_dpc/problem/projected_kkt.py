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
from typing import Any

import torch
from torch import Tensor

from ..batching import flatten_batch, lead_all
from ..data.hankel import HankelData
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


def jacobian(P: Tensor, H: Tensor, free: Tensor) -> Tensor:
    """Return J of Proposition 1, `(n + m, n + m)`.

    Args:
        P, H: of the compact form.
        free: the diagonal of D1, `(n,)`: 1 where the projection passes, 0 at a bound.
    """
    n, m = len(P), len(H)
    eye = torch.eye(n, dtype=P.dtype, device=P.device)
    top = torch.cat([eye - free[:, None] * (eye - P), free[:, None] * H.T], dim=1)
    return torch.cat([top, torch.cat([H, H.new_zeros(m, m)], dim=1)])


@dataclass(frozen=True, eq=False)
class FullSystem:
    """The full system of one problem, for the backward of the layer.

    Attributes:
        data: the recorded data.
        weights: one problem's, without a graph.
    """

    data: HankelData
    weights: Weights

    @cached_property
    def _form(self) -> CompactForm:
        sizes = Sizes.of(self.data)
        zero = torch.zeros(sum(sizes.theta), dtype=torch.float64, device=self.weights.Q.device)
        return compact_form(self.data, self.weights, zero)

    def adjoint(self, v_bar: Tensor, lam_bar: Tensor | None, active: Tensor) -> Tensor:
        """Return theta_bar `(B, n_theta)` for cotangents of v = (u, y) and lam and the rows held at a bound, `(B, N)`.

        With J' nu = (z_bar, w_bar), theta_bar = -K' nu.
        """
        if lam_bar is None:
            lam_bar = torch.zeros_like(v_bar)
        theta_bar = v_bar.new_empty(len(v_bar), sum(Sizes.of(self.data).theta))
        for i, sample in enumerate(zip(v_bar, lam_bar, active, strict=True)):
            theta_bar[i] = self._one(*sample)
        return theta_bar

    def _one(self, v_bar: Tensor, lam_bar: Tensor, active: Tensor) -> Tensor:
        P, _, H, _ = self._form
        sizes, n_v = Sizes.of(self.data), len(v_bar)
        free = torch.ones(len(P), dtype=P.dtype, device=P.device)
        free[:n_v][active] = 0.0
        # lam = w_v - blkdiag(R, Q) (v - ref): its cotangent reaches z, w and, at the end, the references.
        weighted = P[:n_v, :n_v] @ lam_bar
        bar = v_bar.new_zeros(len(P) + len(H))
        bar[:n_v] = v_bar - weighted
        bar[-n_v:] = lam_bar
        nu = _scaled_least_squares(jacobian(P, H, free).T, bar)
        of_q, of_b = -free * nu[: len(P)], nu[len(P) :]
        Yp = self.data.Yp.detach().to(nu)
        refs = -P[:n_v, :n_v] @ of_q[:n_v] + weighted
        y_ini = -2 * self.weights.lambda_s * (Yp @ of_q[n_v:])
        return torch.cat([of_b[: sizes.u_ini], y_ini, refs])


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


class FullAdjoint(torch.autograd.Function):
    """(v_bar, lam_bar, active, system) -> theta_bar, once."""

    @staticmethod
    def forward(v_bar: Tensor, lam_bar: Tensor | None, active: Tensor, system: FullSystem) -> Tensor:
        batch, _, (rows, *bars) = flatten_batch((), (active, v_bar, lam_bar))
        theta_bar = system.adjoint(bars[0], bars[1], rows)
        return theta_bar.reshape(*batch, theta_bar.shape[-1])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        v_bar, lam_bar, active, system = args
        lifted = lead_all((v_bar, lam_bar, active), in_dims[:3], (1, 1, 1), info.batch_size)
        return FullAdjoint.apply(*lifted, system), 0

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> Tensor:
        raise NotImplementedError('backward="full" gives first derivatives; use backward="reduced" for higher ones.')
