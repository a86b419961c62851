"""A layer's problem as a quadratic program for other solvers, in two formulations.

    minimise over z   1/2 z'Pz + q'z     subject to   A z = b,   lower <= C z <= upper,

q, b and the bounds affine in theta = (u_ini, y_ini, u_ref, y_ref). "paper" is the problem as the paper prints it,
z = (u, y, g), A = H. "reduced" is the least-distance form of :mod:`torch_dpc.problem.reduction`, which solvers like
best:

    minimise over x   1/2 |x|^2     subject to   lower - v0 <= Ct x <= upper - v0,     v0 = V theta,  v = v0 + Ct x.

The cost is also given as least squares, 1/2 sum_i |F_i z - f_i|^2 = 1/2 z'Pz + q'z + constant, for conic solvers.

Weights, data and bounds are read once and are constants: the baselines differentiate with respect to theta alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torch_dpc import DPCLayer

from ._layer import bounds_of, cost_rows_of, parts_of, reduction_of

FORMULATIONS = ("paper", "reduced")


@dataclass(frozen=True, eq=False)
class QP:
    """One quadratic program for every theta; float64, constants only.

    Attributes:
        P, A, C: the matrices, `(n, n)`, `(m, n)`, `(k, n)`; C has only rows with a finite bound.
        q_theta, b_theta: q = q_theta theta, b = b_theta theta.
        shift_theta: the bounds are lower - shift_theta theta and upper - shift_theta theta; None for no shift.
        lower, upper: bounds of the rows of C at theta = 0, `(k,)`.
        costs: the least-squares blocks F_i, with the matrix that makes f_i of theta, or None where f_i = 0.
        rows: the places of the rows of C in v = (u, y), `(k,)`.
        v_theta, v_z: v = v_theta theta + v_z z; None where v is the first part of z.
        g_theta, g_z: g likewise; None where g is the last part of z.
        n_v: entries of v.
    """

    P: Tensor
    A: Tensor
    C: Tensor
    q_theta: Tensor
    b_theta: Tensor
    shift_theta: Tensor | None
    lower: Tensor
    upper: Tensor
    costs: tuple[tuple[Tensor, Tensor | None], ...]
    rows: Tensor
    n_v: int
    v_theta: Tensor | None = None
    v_z: Tensor | None = None
    g_theta: Tensor | None = None
    g_z: Tensor | None = None

    @staticmethod
    def of(layer: DPCLayer, formulation: str) -> QP:
        """Return the program of a layer, on the CPU.

        Args:
            layer: one problem, with boxes.
            formulation: "paper" or "reduced".

        Raises:
            ValueError: another formulation, a set that is no box, or no finite bound.
        """
        if formulation not in FORMULATIONS:
            raise ValueError(f"`formulation` must be one of {', '.join(map(repr, FORMULATIONS))}, got {formulation!r}.")
        with torch.no_grad():
            return (_paper if formulation == "paper" else _reduced)(layer)

    def to(self, device: torch.device) -> QP:
        """Return the same program on another device."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {name: x.to(device) for name, x in values.items() if isinstance(x, Tensor)}
        costs = tuple((F.to(device), None if f is None else f.to(device)) for F, f in self.costs)
        return replace(self, costs=costs, **moved)

    def v(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the constrained rows (u, y), `(B, n_v)`."""
        if self.v_theta is None or self.v_z is None:
            return z[..., : self.n_v]
        return torch.addmm(theta @ self.v_theta.mT, z, self.v_z.mT)

    def g(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the combination of the recorded windows, `(B, n_g)`."""
        if self.g_theta is None or self.g_z is None:
            return z[..., self.n_v :]
        return theta @ self.g_theta.mT + z @ self.g_z.mT


class Call:
    """The vectors of a program at a batch of theta, each computed when first asked for, with theta's graph.

    Args:
        qp: the program.
        theta: (u_ini, y_ini, u_ref, y_ref), `(B, n_theta)`.
    """

    def __init__(self, qp: QP, theta: Tensor):
        self.qp, self.theta = qp, theta

    @cached_property
    def q(self) -> Tensor:
        """Linear cost, `(B, n)`."""
        return self.theta @ self.qp.q_theta.mT

    @cached_property
    def b(self) -> Tensor:
        """Right-hand sides of the equalities, `(B, m)`."""
        return self.theta @ self.qp.b_theta.mT

    @cached_property
    def shift(self) -> Tensor | None:
        """What is taken from both bounds, `(B, k)`; None for nothing."""
        return None if self.qp.shift_theta is None else self.theta @ self.qp.shift_theta.mT

    @cached_property
    def lower(self) -> Tensor:
        """Lower bounds, `(B, k)`; minus infinity for none."""
        return self._bound(self.qp.lower)

    @cached_property
    def upper(self) -> Tensor:
        """Upper bounds, `(B, k)`; infinity for none."""
        return self._bound(self.qp.upper)

    @cached_property
    def targets(self) -> list[Tensor | None]:
        """The least-squares targets f_i, `(B, k_i)`, or None for zero."""
        return [None if f is None else self.theta @ f.mT for _, f in self.qp.costs]

    def _bound(self, bound: Tensor) -> Tensor:
        return bound.expand(len(self.theta), -1) if self.shift is None else bound - self.shift


def _paper(layer: DPCLayer) -> QP:
    """P, q, H, b as printed; q and b are linear in theta, so calls at unit vectors give their matrices."""
    data = layer.data
    n_theta = (data.t_ini + data.horizon) * (data.n_u + data.n_y)
    unit = torch.eye(n_theta, dtype=torch.float64)
    u_ini, y_ini, u_ref, y_ref = parts_of(layer, unit)
    P, q, H, b = layer.compact_form(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref)
    lower, upper = bounds_of(layer)
    rows = _finite_rows(lower, upper)
    return QP(
        P=P,
        A=H,
        C=torch.eye(len(lower), len(P), dtype=P.dtype)[rows],
        q_theta=q.mT.contiguous(),
        b_theta=b.mT.contiguous(),
        shift_theta=None,
        lower=lower[rows],
        upper=upper[rows],
        costs=_paper_costs(layer, unit),
        rows=rows,
        n_v=len(lower),
    )


def _paper_costs(layer: DPCLayer, unit: Tensor) -> tuple[tuple[Tensor, Tensor | None], ...]:
    """sqrt(R) (u - u_ref),  sqrt(Q) (y - y_ref),  sqrt(2 lambda_g) M g,  sqrt(2 lambda_s) (Yp g - y_ini)."""
    rows = cost_rows_of(layer)
    # Row i of `unit` is the i-th unit theta: transposed, its parts pick y_ini and the references out of theta.
    _, y_ini, u_ref, y_ref = (part.flatten(-2).mT for part in parts_of(layer, unit))
    n_u, n_v = len(rows.root_R), len(rows.root_R) + len(rows.root_Q)
    n = n_v + layer.data.n_g

    def of_z(block: Tensor, start: int) -> Tensor:
        return torch.nn.functional.pad(block, (start, n - start - block.shape[1]))

    return (
        (of_z(rows.root_R, 0), rows.root_R @ u_ref),
        (of_z(rows.root_Q, n_u), rows.root_Q @ y_ref),
        (of_z(rows.M, n_v), None),
        (of_z(rows.Yp, n_v), rows.root_s * y_ini),
    )


def _reduced(layer: DPCLayer) -> QP:
    reduction = reduction_of(layer)
    lower, upper = bounds_of(layer)
    rows = _finite_rows(lower, upper)
    V, Ct = reduction.V, reduction.Ct
    eye = torch.eye(Ct.shape[1], dtype=Ct.dtype)
    basis = layer.data.basis.cpu()
    return QP(
        P=eye,
        A=Ct.new_zeros(0, Ct.shape[1]),
        C=Ct[rows],
        q_theta=Ct.new_zeros(Ct.shape[1], V.shape[1]),
        b_theta=Ct.new_zeros(0, V.shape[1]),
        shift_theta=V[rows],
        lower=lower[rows],
        upper=upper[rows],
        costs=((eye, None),),
        rows=rows,
        n_v=len(lower),
        v_theta=V,
        v_z=Ct,
        g_theta=basis @ reduction.A_theta,
        # a = A_theta theta - A_lam lam and x = -Ct'lam: the solution lies in the range of Ct', where this is exact.
        g_z=basis @ (reduction.A_lam @ torch.linalg.pinv(Ct.mT)),
    )


def _finite_rows(lower: Tensor, upper: Tensor) -> Tensor:
    rows = (lower.isfinite() | upper.isfinite()).nonzero()[:, 0]
    if len(rows) == 0:
        raise ValueError("the sets have no finite bound: the solution is linear in the measurements, nothing to solve.")
    return rows
