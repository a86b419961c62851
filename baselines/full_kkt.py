"""The paper's own backward: the full projected-KKT system, in plain torch.

    F = [z - Proj_D(z - Pz - q - H'w);  Hz - b],            J = [I - D1 (I - P),  D1 H';  H,  0],
    d(z, w)/dtheta = -J^-1 K,                               K = [D1 dq/dtheta;  -db/dtheta].

J is singular or nearly so on noise-free data (condition 1e14 on the oscillating masses), and a least-squares solve with
LAPACK's default cut-off throws away what matters. Scaling the rows of J' to unit norm first mends that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torch_dpc import DPCLayer
from torch_dpc.solve.weakness import WEAKLY_ACTIVE

from ._adapter import Baseline, PeerResult
from ._layer import Judge
from ._problem import QP, Call

#: (J', right) -> the least-squares solution of least norm.
LeastSquares = Callable[[Tensor, Tensor], Tensor]


def _gelsd(matrix: Tensor, right: Tensor) -> Tensor:
    return torch.linalg.lstsq(matrix, right, driver="gelsd").solution


class FullKKT(Baseline):
    """The layer's forward solve, differentiated by the paper's full system.

    Args:
        layer: the layer whose problem is solved.
        scaled: scale the rows of J' to unit norm before the least squares; False for the system as printed.
        least_squares: solves J' s = right, `(n, n)` and `(n, 1)`; by default LAPACK's gelsd with its default cut-off.

    A weakly active row counts as inactive, as in the layer.
    """

    def __init__(self, layer: DPCLayer, *, scaled: bool = True, least_squares: LeastSquares | None = None):
        super().__init__(layer, "paper")
        self.scaled, self._exact = scaled, Judge(layer, WEAKLY_ACTIVE)
        self.least_squares = _gelsd if least_squares is None else least_squares
        self.name = "full KKT" if scaled else "full KKT as printed"

    @property
    def kkt_size(self) -> int:
        """The order of J, read from the matrix."""
        return jacobian(self.qp, torch.zeros(self.qp.n_v, dtype=torch.bool)).shape[0]

    def _solve(self, call: Call) -> PeerResult:
        theta = call.theta.detach()
        with torch.no_grad():
            sol = self.layer.plan(theta, *self.layer.bounds(theta.device), on_failure="raise")
            v = torch.cat([sol.u.flatten(-2), sol.y.flatten(-2)], dim=-1)
            active, _ = self._exact.active(v, sol.lam)
            z = torch.cat([v, sol.g], dim=-1)
        z = _FullSystem.apply(call.theta, z, active, self.qp, self.scaled, self.least_squares)
        return PeerResult(z, sol.lam[:, self.qp.rows], sol.info.iterations)


def jacobian(qp: QP, active: Tensor) -> Tensor:
    """Return J as printed, `(n + m, n + m)`, for the active rows of v, `(n_v,)`."""
    n, m = len(qp.P), len(qp.A)
    D1 = torch.ones(n, 1, dtype=qp.P.dtype)
    D1[: qp.n_v, 0] = (~active).double()
    J = torch.zeros(n + m, n + m, dtype=qp.P.dtype)
    eye = torch.eye(n, dtype=qp.P.dtype)
    J[:n, :n] = eye - D1 * (eye - qp.P)
    J[:n, n:] = D1 * qp.A.mT
    J[n:, :n] = qp.A
    return J


class _FullSystem(torch.autograd.Function):
    """theta -> z, its derivative from J and K."""

    @staticmethod
    def forward(
        ctx: Any, theta: Tensor, z: Tensor, active: Tensor, qp: QP, scaled: bool, least_squares: LeastSquares
    ) -> Tensor:
        ctx.save_for_backward(active)
        ctx.qp, ctx.scaled, ctx.least_squares = qp, scaled, least_squares
        return z.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, z_bar: Tensor) -> tuple[Tensor | None, ...]:
        (active,) = ctx.saved_tensors
        qp: QP = ctx.qp
        n, m = len(qp.P), len(qp.A)
        theta_bar = []
        for bar, rows in zip(z_bar, active, strict=True):
            transposed = jacobian(qp, rows).mT
            right = torch.cat([bar, bar.new_zeros(m)])[:, None]
            if ctx.scaled:
                norms = torch.linalg.vector_norm(transposed, dim=1, keepdim=True)
                scale = torch.where(norms > 0, 1 / norms, 1.0)
                transposed, right = scale * transposed, scale * right
            s = ctx.least_squares(transposed, right)[:, 0]
            free = s[:n].clone()
            free[: qp.n_v][rows] = 0.0  # D1
            theta_bar.append(s[n:] @ qp.b_theta - free @ qp.q_theta)  # -K's
        return torch.stack(theta_bar), None, None, None, None, None
