"""The exact reduction of the DPC problem to its constrained rows.

In the coordinates a of the row space of the data (:mod:`torch_dpc.problem.rows`) two steps remain:

1. The equalities Eq a = e, Up g = u_ini above all, are eliminated:  a = Eq^+ e + Z x,  Z a basis of the kernel of Eq.
2. The cost is one weighted least squares  min 1/2 |E x - f|^2,  with the rows
   sqrt(R) Uf,  sqrt(Q) Yf,  sqrt(2 lambda_g) M,  sqrt(2 lambda_s) Yp,  and f linear in theta = (u_ini, y_ini, u_ref,
   y_ref).  A QR of E gives the triangle T; E'E is never formed, for it squares a condition of 1e5.

The constrained rows v = (u, y) = C a are then, in terms of their multipliers lam alone,

    v = V theta - G lam,    G = Ct Ct',  Ct = C Z T^-1,    lam in the normal cone of U x Y at v,

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

from ..autodiff import carries_derivative, constant, untransformed
from .rows import DataRows
from .saddle import Saddle, known_solution
from .weights import Weights, psd_root

#: Singular values of E at or below this fraction of the largest make the optimum a set.
COST_RANK_TOLERANCE = 1e-14
#: A row of C whose part in the kernel of the equalities is at most this fraction of it is decided by them.
DECIDED = 1e-12
#: Weight on the kernel of E, relative to the largest singular value of E. Its square, 1e-12, is how far from the
#: optimum (in relative cost curvature) the selected solution may be.
TIE_BREAK = 1e-6


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
        """Return the same numbers without their graph.

        With a graph G is C A_lam; here it is Ct Ct' in any case, which loses less, so that a graph changes no result.
        """
        rows, weights = _constants(self.rows, self.weights)
        plain = _map_tensors(self, constant)
        with untransformed():
            return replace(plain, G=plain.Ct @ plain.Ct.mT, rows=rows, weights=weights)

    def of_batch(self, batch: torch.Size) -> Reduction:
        """Return one problem a sample of a flattened batch; itself where all samples share one problem."""
        if self.G.ndim == 2:
            return self

        def spread(x: Tensor, tail: int) -> Tensor:
            own = x.shape[x.ndim - tail :]
            return x.expand(*batch, *own).reshape(batch.numel(), *own)

        rows = self.rows if self.rows.C.ndim == 2 else self.rows.map(spread)
        return replace(_map_tensors(self, lambda x: spread(x, 2)), rows=rows, weights=self.weights.map(spread))

    def of_samples(self, samples: Tensor) -> Reduction:
        """Return the problems of some samples of a flattened batch; itself where all share one problem."""
        if self.G.ndim == 2:
            return self
        weights = self.weights.map(lambda tensor, _: tensor[samples])
        rows = self.rows if self.rows.C.ndim == 2 else self.rows.map(lambda tensor, _: tensor[samples])
        return replace(_map_tensors(self, lambda tensor: tensor[samples]), rows=rows, weights=weights)


def _map_tensors(holder: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Return a copy of a dataclass with its tensors changed."""
    changed = {f.name: change(getattr(holder, f.name)) for f in fields(holder) if _is_tensor(getattr(holder, f.name))}
    return replace(holder, **changed)


def _is_tensor(value: Any) -> bool:
    return isinstance(value, Tensor)


def reduce(rows: DataRows, weights: Weights) -> Reduction:
    """Reduce the problem of the data and weights.

    Values come from the QR of E. Where the data or the weights carry a graph, V, G, A_theta and A_lam carry it on, by
    the derivative of the saddle-point system they solve (:mod:`torch_dpc.problem.saddle`).
    """
    V, G, Ct, A_theta, A_lam, T, is_selection = _values(*_constants(rows, weights))
    if carries_derivative((rows.C, rows.Yp, *weights.tensors.values())):
        A_theta, A_lam = _with_graph(rows, weights, T, A_theta, A_lam)
        V, G = rows.C @ A_theta, rows.C @ A_lam
    return Reduction(V, G, Ct, A_theta, A_lam, rows, weights, is_selection)


def _constants(rows: DataRows, weights: Weights) -> tuple[DataRows, Weights]:
    """Return both without graph or tangent: of equal eigenvalues, say, a factorisation has no derivative."""

    def change(tensor: Tensor, _: int) -> Tensor:
        return constant(tensor)

    return rows.map(change), weights.map(change)


def _values(rows: DataRows, weights: Weights) -> tuple[Any, ...]:
    """Return V, G, Ct, A_theta, A_lam, T and whether the kernel of E had to be charged."""
    E, f = _least_squares(rows, weights)
    T, Qe, is_selection = _factor(E)
    CZ = rows.C @ rows.Z
    # A row that the equalities decide is zero here; its rounding would stand for a motion that does not exist.
    decided = CZ.norm(dim=-1) <= DECIDED * rows.C.norm(dim=-1)
    CZ = torch.where(decided[..., None], 0.0, CZ)
    Ct = torch.linalg.solve_triangular(T, CZ, upper=True, left=False)
    X_theta = torch.linalg.solve_triangular(T, Qe.mT @ f, upper=True)
    # One step of refinement: it matters where weights of zero leave E a condition of 1e10.
    X_theta = X_theta + torch.linalg.solve_triangular(T, Qe.mT @ (f - E @ X_theta), upper=True)
    A_theta = rows.Z @ X_theta
    A_theta[..., :, rows.Eq_theta] += rows.Eq_pinv
    A_lam = rows.Z @ torch.linalg.solve_triangular(T, Ct.mT, upper=True)
    return rows.C @ A_theta, Ct @ Ct.mT, Ct, A_theta, A_lam, T, is_selection


def _least_squares(rows: DataRows, weights: Weights) -> tuple[Tensor, Tensor]:
    """Return E `(..., k, n_x)` and the matrix of f = (matrix) theta, `(..., k, n_theta)`."""
    # Each block row of the cost, with the matrix that makes its target of a part of theta, and where that part begins.
    root_g = (2 * weights.lambda_g).sqrt()[..., None, None]
    blocks: list[tuple[Tensor, Tensor | None, int | None]] = [(root_g * _charged(rows), None, None)]
    for term in rows.tracking:
        if (weight := getattr(weights, term.weight)) is not None:
            root = psd_root(weight)
            blocks.append((root @ rows.C[..., term.rows, :], root, term.reference))
    for fit in rows.fits:
        root = (2 * getattr(weights, fit.weight)).sqrt()[..., None, None]
        blocks.append((root * fit.rows, root * _eye(fit.rows.shape[-2], fit.rows), fit.measured))
    batch = torch.broadcast_shapes(*(block.shape[:-2] for block, _, _ in blocks))
    E, f = [], []
    for block, matrix, start in blocks:
        E.append((block @ rows.Z).expand(*batch, -1, -1))
        target = block.new_zeros(*batch, block.shape[-2], rows.n_theta)
        if matrix is not None and start is not None:
            target[..., start : start + matrix.shape[-1]] = matrix
        target[..., rows.Eq_theta] -= block @ rows.Eq_pinv
        f.append(target)
    return torch.cat(E, dim=-2), torch.cat(f, dim=-2)


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


def _charged(rows: DataRows) -> Tensor:
    """M in the coordinates a, the identity on the entries beyond the rank of W; or all of the identity."""
    if rows.charged.ndim == 1:
        return torch.diag(rows.charged)[rows.charged.bool()]
    return torch.diag_embed(rows.charged)


def _with_graph(rows: DataRows, weights: Weights, T: Tensor, A_theta: Tensor, A_lam: Tensor) -> tuple[Tensor, Tensor]:
    """Attach the derivative of [Psi Eq'; Eq 0] [a; mu] = [Phi theta - C' lam; e] to its known solution."""
    # Psi = sum of rows' weight rows, and Phi likewise towards what each term is to meet.
    terms: list[tuple[Tensor, Tensor, int | None]] = []
    for term in rows.tracking:
        if (weight := getattr(weights, term.weight)) is not None:
            block = rows.C[..., term.rows, :]
            terms.append(((weight @ block).mT, block, term.reference))
    for fit in rows.fits:
        terms.append((2 * getattr(weights, fit.weight)[..., None, None] * fit.rows.mT, fit.rows, fit.measured))
    Psi = 2 * weights.lambda_g[..., None, None] * _gram_of_charged(rows)
    for weighted, block, _ in terms:
        Psi = Psi + weighted @ block
    batch = Psi.shape[:-2]
    Phi = Psi.new_zeros(*batch, Psi.shape[-1], rows.n_theta)
    for weighted, _, start in terms:
        if start is not None:
            Phi = Phi + torch.nn.functional.pad(weighted, (start, rows.n_theta - start - weighted.shape[-1]))
    top = torch.cat([Phi, -rows.C.mT.expand(*batch, -1, -1)], dim=-1)
    n_eq = rows.Eq.shape[-2]
    bottom = top.new_zeros(n_eq, top.shape[-1])
    bottom[torch.arange(n_eq), rows.Eq_theta] = 1.0
    solution = torch.cat([A_theta, -A_lam], dim=-1)
    saddle = Saddle(T=T, Z=rows.Z, Eq_pinv=rows.Eq_pinv)
    solution = known_solution(Psi, rows.Eq, top, bottom, solution.expand(*batch, -1, -1), saddle)
    return solution[..., : rows.n_theta], -solution[..., rows.n_theta :]


def _gram_of_charged(rows: DataRows) -> Tensor:
    """M = I - W^+ W in the coordinates a (or I), with its derivative at constant rank of W where W has a graph."""
    N = _charged(rows)
    M = N.mT @ N
    W = torch.cat([rows.Up, rows.Yp, rows.Uf], dim=-2)
    if not carries_derivative((W,)) or rows.is_identity:
        return M
    with torch.no_grad():
        W_pinv = torch.linalg.pinv(W, rtol=1e-10)
    # M dW = 0 at the point itself, so the term below is 0 in value and -(W^+ dW M + M dW' W^+') in derivative.
    change = W_pinv @ (W - W.detach()) @ M
    return M - change - change.mT


def _eye(n: int, like: Tensor) -> Tensor:
    return torch.eye(n, dtype=like.dtype, device=like.device)
