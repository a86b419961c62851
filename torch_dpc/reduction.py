"""The exact reduction of the DPC problem to its constrained rows.

With g = B a (see :mod:`torch_dpc.rowspace`) every quantity of the problem is small. Three steps remain:

1. Up g = u_ini is eliminated:  a = Up^+ u_ini + Z x,  Z a basis of the kernel of Up B.
2. The cost is one weighted least squares  min 1/2 |E x - e|^2,  with the rows
   sqrt(R) Uf,  sqrt(Q) Yf,  sqrt(2 lambda_g) M,  sqrt(2 lambda_s) Yp,  and e linear in theta = (u_ini, y_ini, u_ref,
   y_ref).  A QR of E gives the triangle T; E'E is never formed, for it squares a condition of 1e5.
3. The constrained rows v = (u, y) = C x + c are, in terms of their multipliers lam alone,

       v = V theta - G lam,    G = Ct Ct',  Ct = C T^-1,    lam in the normal cone of U x Y at v,

   and a = A_theta theta - A_lam lam gives everything else back.

Where E is rank-deficient the optimum is a set; the element of minimum norm |g| is selected by charging the kernel
of E with `TIE_BREAK`, and `Reduction.is_selection` says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from .hankel import HankelData
from .saddle import Saddle, known_solution
from .transforms import carries_derivative

#: Singular values of E at or below this fraction of the largest make the optimum a set.
COST_RANK_TOLERANCE = 1e-14
#: Weight on the kernel of E, relative to the largest singular value of E. Its square, 1e-12, is how far from the
#: optimum (in relative cost curvature) the selected solution may be.
TIE_BREAK = 1e-6
#: How far u_ini may be from what the data can produce, relative to its norm.
REACHABLE = 1e-8


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights as tensors; leading dimensions, if any, are one problem each.

    Attributes:
        Q: output weight, `(..., horizon n_y, horizon n_y)`.
        R: input weight, `(..., horizon n_u, horizon n_u)`.
        lambda_g, lambda_s: regularisation of g and of the initial output, `(...)`.
    """

    Q: Tensor
    R: Tensor
    lambda_g: Tensor
    lambda_s: Tensor


@dataclass(frozen=True, eq=False)
class DataRows:
    """The data in the coordinates of their own row space, n_g gone.

    Attributes:
        Up, Yp, Uf, Yf: the rows, `(rows, r)`.
        C: [Uf; Yf], `(horizon (n_u + n_y), r)`.
        Up_pinv: the pseudo-inverse of Up, `(r, t_ini n_u)`.
        Z: orthonormal basis of the kernel of Up, `(r, n_x)`.
        u_ini_range: orthonormal basis of the range of Up, or None where every u_ini can be produced.
        rank_W: the first entries of a, which |M g| does not charge.
    """

    Up: Tensor
    Yp: Tensor
    Uf: Tensor
    Yf: Tensor
    C: Tensor
    Up_pinv: Tensor
    Z: Tensor
    u_ini_range: Tensor | None
    rank_W: int

    def unreachable(self, theta: Tensor) -> Tensor:
        """Return which samples `(B,)` ask for a u_ini that no combination of the data makes."""
        u_ini = theta[..., : self.Up.shape[0]]
        if self.u_ini_range is None:
            return torch.zeros(u_ini.shape[:-1], dtype=torch.bool, device=u_ini.device)
        missed = u_ini - (u_ini @ self.u_ini_range) @ self.u_ini_range.mT
        norm = torch.linalg.vector_norm
        return norm(missed, dim=-1) > REACHABLE * norm(u_ini, dim=-1)

    @staticmethod
    def of(data: HankelData, device: torch.device) -> DataRows:
        """Return the rows of the data; a graph behind the data matrices reaches through."""
        space = data.row_space
        if not space.clear and carries_derivative(data.matrices):
            raise ValueError(
                "the data carry a graph, but their rank is not clear, and derivatives hold at constant rank: the "
                f"singular values around the decision are {space.last_kept:.1e} (kept) and {space.first_dropped:.1e} "
                "(dropped), relative to the largest."
            )
        basis = space.basis.to(device)
        stacked = torch.cat([m.to(device=device, dtype=torch.float64) for m in data.matrices])
        rows = _InRowSpace.apply(stacked, basis) if carries_derivative(data.matrices) else stacked @ basis
        Up, Yp, Uf, Yf = rows.split([len(m) for m in data.matrices])
        with torch.no_grad():
            left, singular, right_h = torch.linalg.svd(Up, full_matrices=True)
            # The rank of Up is judged on channels of one scale too: rows are few and alike, its own norm will do.
            rank = int((singular > 1e-10 * singular[0].clamp_min(torch.finfo(torch.float64).tiny)).sum())
            kept = right_h[:rank].T
            Up_pinv = (kept / singular[:rank]) @ left[:, :rank].T
            u_ini_range = None if rank == Up.shape[0] else left[:, :rank].contiguous()
            Z = right_h[rank:].T.contiguous()
        return DataRows(Up, Yp, Uf, Yf, torch.cat([Uf, Yf]), Up_pinv, Z, u_ini_range, space.rank_W)


class _InRowSpace(torch.autograd.Function):
    """(D, B) -> D B for an orthonormal basis B of the rows of D, which moves with D.

    What follows depends on D through D D' alone, so that to first order, and only so, B may be taken as fixed:
    D_bar = bar B'. A derivative of that is refused.
    """

    @staticmethod
    def forward(D: Tensor, basis: Tensor) -> Tensor:  # noqa: D102
        return D @ basis

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:  # noqa: D102
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:  # noqa: D102
        if torch.is_grad_enabled() and bar.requires_grad:
            raise NotImplementedError(
                "the derivative with respect to the recorded data is of first order: it cannot be taken with "
                "`create_graph=True`. Detach the data, or ask for first derivatives."
            )
        return bar @ ctx.saved_tensors[0].mT, None


@dataclass(frozen=True, eq=False)
class Reduction:
    """The reduced problem; all float64. Leading dimensions, if any, are one problem each.

    Attributes:
        V: unconstrained minimiser, v = V theta, `(..., N, n_theta)`.
        G: effect of the multipliers, `(..., N, N)`, symmetric positive semidefinite.
        Ct: its factor, `(..., N, n_x)`.
        A_theta, A_lam: a = A_theta theta - A_lam lam, `(..., r, n_theta)` and `(..., r, N)`.
        rows: the data rows behind them.
        weights: the weights behind them.
        is_selection: the cost has a kernel, and the minimum-norm g was selected.
    """

    V: Tensor
    G: Tensor
    Ct: Tensor
    A_theta: Tensor
    A_lam: Tensor
    rows: DataRows
    weights: Weights
    is_selection: bool

    def detach(self) -> Reduction:
        """Return the same numbers without their graph."""
        rows = _map_tensors(self.rows, Tensor.detach)
        weights = _map_tensors(self.weights, Tensor.detach)
        return replace(_map_tensors(self, Tensor.detach), rows=rows, weights=weights)

    def of_batch(self, batch: torch.Size) -> Reduction:
        """Return one problem a sample of a flattened batch; itself where all samples share one problem."""
        if self.G.ndim == 2:
            return self

        def spread(x: Tensor, tail: int) -> Tensor:
            own = x.shape[x.ndim - tail :]
            return x.expand(*batch, *own).reshape(batch.numel(), *own)

        w = self.weights
        weights = Weights(spread(w.Q, 2), spread(w.R, 2), spread(w.lambda_g, 0), spread(w.lambda_s, 0))
        return replace(_map_tensors(self, lambda x: spread(x, 2)), weights=weights)

    def of_samples(self, samples: Tensor) -> Reduction:
        """Return the problems of some samples of a flattened batch; itself where all share one problem."""
        if self.G.ndim == 2:
            return self
        weights = _map_tensors(self.weights, lambda tensor: tensor[samples])
        return replace(_map_tensors(self, lambda tensor: tensor[samples]), weights=weights)


def _map_tensors(holder: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Return a copy of a dataclass with its tensors changed."""
    changed = {f.name: change(getattr(holder, f.name)) for f in fields(holder) if _is_tensor(getattr(holder, f.name))}
    return replace(holder, **changed)


def _is_tensor(value: Any) -> bool:
    return isinstance(value, Tensor)


def reduce(rows: DataRows, weights: Weights) -> Reduction:
    """Reduce the problem of the data and weights.

    Values come from the QR of E. Where the data or the weights carry a graph, V, G, A_theta and A_lam carry it on, by
    the derivative of the saddle-point system they solve (:mod:`torch_dpc.saddle`).
    """
    with torch.no_grad():
        E, e = _least_squares(rows, weights)
        T, Qe, is_selection = _factor(E)
        Ct = torch.linalg.solve_triangular(T, rows.C @ rows.Z, upper=True, left=False)
        X_theta = torch.linalg.solve_triangular(T, Qe.mT @ e, upper=True)
        # One step of refinement: it matters where weights of zero leave E a condition of 1e10.
        X_theta = X_theta + torch.linalg.solve_triangular(T, Qe.mT @ (e - E @ X_theta), upper=True)
        A_theta = rows.Z @ X_theta
        A_theta[..., :, : rows.Up.shape[0]] += rows.Up_pinv
        A_lam = rows.Z @ torch.linalg.solve_triangular(T, Ct.mT, upper=True)
        V, G = rows.C @ A_theta, Ct @ Ct.mT
    tensors = (rows.C, rows.Yp, weights.Q, weights.R, weights.lambda_g, weights.lambda_s)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        A_theta, A_lam = _with_graph(rows, weights, T, A_theta, A_lam)
        V, G = rows.C @ A_theta, rows.C @ A_lam
    return Reduction(V, G, Ct, A_theta, A_lam, rows, weights, is_selection)


def _least_squares(rows: DataRows, weights: Weights) -> tuple[Tensor, Tensor]:
    """Return E `(..., k, n_x)` and the matrix of e = (matrix) theta, `(..., k, n_theta)`."""
    root_R, root_Q = psd_root(weights.R), psd_root(weights.Q)
    root_g = (2 * weights.lambda_g).sqrt()[..., None, None]
    root_s = (2 * weights.lambda_s).sqrt()[..., None, None]
    n_up, n_yp, n_u, n_y = (m.shape[0] for m in (rows.Up, rows.Yp, rows.Uf, rows.Yf))
    # One block row each for sqrt(R) Uf, sqrt(Q) Yf, sqrt(2 lambda_g) M, sqrt(2 lambda_s) Yp.
    blocks = [root_R @ rows.Uf, root_Q @ rows.Yf, root_g * _outside_W(rows), root_s * rows.Yp]
    targets = [(n_up + n_yp, root_R), (n_up + n_yp + n_u, root_Q), None, (n_up, root_s * _eye(n_yp, rows.Yp))]
    batch = torch.broadcast_shapes(*(b.shape[:-2] for b in blocks))
    E, e = [], []
    for block, target in zip(blocks, targets, strict=True):
        E.append((block @ rows.Z).expand(*batch, -1, -1))
        theta = block.new_zeros(*batch, block.shape[-2], n_up + n_yp + n_u + n_y)
        theta[..., :n_up] = -block @ rows.Up_pinv
        if target is not None:
            start, matrix = target
            theta[..., start : start + matrix.shape[-1]] = matrix
        e.append(theta)
    return torch.cat(E, dim=-2), torch.cat(e, dim=-2)


def _factor(E: Tensor) -> tuple[Tensor, Tensor, bool]:
    """Return T, the orthogonal factor cut to the rows of E, and whether the kernel of E had to be charged."""
    k = E.shape[-2]
    Qe, T = torch.linalg.qr(E)
    if E.shape[-2] >= E.shape[-1]:
        # A first cheap look at the diagonal: only a suspicious one pays for the singular values.
        diagonal = T.diagonal(dim1=-2, dim2=-1).abs()
        if bool((diagonal.amin(-1) > 1e4 * COST_RANK_TOLERANCE * diagonal.amax(-1)).all()):
            return T, Qe, False
    _, singular, right_h = torch.linalg.svd(E, full_matrices=True)
    largest = singular.amax(-1, keepdim=True)
    padded = torch.nn.functional.pad(singular, (0, E.shape[-1] - singular.shape[-1]))
    in_kernel = padded <= COST_RANK_TOLERANCE * largest
    if not bool(in_kernel.any()):
        return T, Qe, False
    charge = torch.where(in_kernel, TIE_BREAK * largest, 0.0)
    Qe, T = torch.linalg.qr(torch.cat([E, charge[..., None] * right_h], dim=-2))
    return T, Qe[..., :k, :], True


def _outside_W(rows: DataRows) -> Tensor:
    """M in the coordinates a: the identity on the entries beyond the rank of W."""
    return _eye(rows.C.shape[-1], rows.C)[rows.rank_W :]


def _with_graph(rows: DataRows, weights: Weights, T: Tensor, A_theta: Tensor, A_lam: Tensor) -> tuple[Tensor, Tensor]:
    """Attach the derivative of [Psi Up'; Up 0] [a; mu] = [Phi theta - C' lam; u_ini] to its known solution."""
    n_up = rows.Up.shape[0]
    lambda_g, lambda_s = weights.lambda_g[..., None, None], weights.lambda_s[..., None, None]
    RU, QY = weights.R @ rows.Uf, weights.Q @ rows.Yf
    Psi = rows.Uf.mT @ RU + rows.Yf.mT @ QY + 2 * lambda_s * (rows.Yp.mT @ rows.Yp) + 2 * lambda_g * _M(rows)
    batch = Psi.shape[:-2]
    none = Psi.new_zeros(*batch, Psi.shape[-1], n_up)
    parts = [none, 2 * lambda_s * rows.Yp.mT, RU.mT, QY.mT, -rows.C.mT]
    top = torch.cat([p.expand(*batch, *p.shape[-2:]) for p in parts], dim=-1)
    bottom = top.new_zeros(n_up, top.shape[-1])
    bottom[:, :n_up] = _eye(n_up, bottom)
    solution = torch.cat([A_theta, -A_lam], dim=-1)
    saddle = Saddle(T=T, Z=rows.Z, Up_pinv=rows.Up_pinv)
    solution = known_solution(Psi, rows.Up, top, bottom, solution.expand(*batch, -1, -1), saddle)
    n_theta = A_theta.shape[-1]
    return solution[..., :n_theta], -solution[..., n_theta:]


def _M(rows: DataRows) -> Tensor:
    """M = I - W^+ W in the coordinates a, with its derivative at constant rank of W where the data carry a graph."""
    M = _outside_W(rows)
    M = M.mT @ M
    W = torch.cat([rows.Up, rows.Yp, rows.Uf])
    if not W.requires_grad:
        return M
    with torch.no_grad():
        W_pinv = torch.linalg.pinv(W, rtol=1e-10)
    # M dW = 0 at the point itself, so the term below is 0 in value and -(W^+ dW M + M dW' W^+') in derivative.
    change = W_pinv @ (W - W.detach()) @ M
    return M - change - change.mT


def psd_root(matrix: Tensor) -> Tensor:
    """Return S with S'S = matrix, for a symmetric positive semidefinite matrix `(..., n, n)`."""
    values, vectors = torch.linalg.eigh(matrix)
    return values.clamp_min(0.0).sqrt()[..., None] * vectors.mT


def _eye(n: int, like: Tensor) -> Tensor:
    return torch.eye(n, dtype=like.dtype, device=like.device)
