"""The exact reduction of the DPC problem to its constrained rows.

In the coordinates a of the row space of the data (:mod:`torch_dpc.problem.rows`) two steps remain:

1. The equalities Eq a = e, Up g = u_ini above all, are eliminated:  a = Eq^+ e + Z x,  Z a basis of the kernel of Eq.
2. The cost is one weighted least squares  min 1/2 |E x - f|^2,  with the rows
   sqrt(R) Uf,  sqrt(Q) Yf,  sqrt(2 lambda_g) M,  sqrt(2 lambda_s) Yp,  and f linear in theta = (u_ini, y_ini, u_ref,
   y_ref).  A QR of E gives the triangle T (:mod:`torch_dpc.problem.factorization`); E'E is never formed, for it
   squares a condition of 1e5.

The constrained rows v = (u, y) = C a are then, in terms of their multipliers lam alone,

    v = V theta - G lam,    G = Ct Ct',  Ct = C Z T^-1,    lam in the normal cone of U x Y at v,

and a = A_theta theta - A_lam lam gives everything else back.

Where E is rank-deficient the optimum is a set; the element of minimum norm |g| is selected by a small charge on the
kernel of E, and `Reduction.is_selection` says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..autodiff import carries_derivative, constant, untransformed
from .factorization import factor_cost
from .graph import with_graph
from .least_squares import least_squares, moved_by, without_rounding
from .rows import DataRows
from .verification import Map, Posed, Term, verify
from .weights import Weights


@dataclass(frozen=True, eq=False)
class Reduction:
    """The reduced problem; all float64. Leading dimensions, if any, are one problem each.

    Attributes:
        V: unconstrained minimiser, v = V theta, `(..., N, n_theta)`.
        G: effect of the multipliers, `(..., N, N)`, symmetric positive semidefinite.
        Ct: its factor, `(..., N, n_x)`.
        A_theta, A_lam: a = A_theta theta - A_lam lam, `(..., r, n_theta)` and `(..., r, N)`.
        T, Z: the triangle of the cost and a basis of the kernel of Eq, a = Eq^+ e + Z x, `(..., r, n_x)`.
        kernel: how the directions w in which the cost is flat move v, `(..., N, n_k)`, and
        kernel_in_a: how they move a, `(..., r, n_k)`.
        gain: they are charged 1/2 |w|^2 / gain, so that w = -gain kernel' lam, `(..., 1, 1)`.
        error: errors of v, then of Eq a = e, in their units, as the verification bounds them: for a unit of theta, and
            for multipliers that displace v by a unit, `(..., N + n_eq, 2)`.
        excess: [V, -G] minus the exact map, `(..., N, n_theta + N)`, where extended precision was needed; else None.
        rounding: of each entry of V and G, relative to it, if that is all of the error of v; else 0.
        rows: the data rows behind them.
        weights: the weights behind them.
        constants: the same without a graph; None if this is it.
    """

    V: Tensor
    G: Tensor
    Ct: Tensor
    A_theta: Tensor
    A_lam: Tensor
    T: Tensor
    Z: Tensor
    kernel: Tensor
    kernel_in_a: Tensor
    gain: Tensor
    error: Tensor
    excess: Tensor | None
    rows: DataRows
    weights: Weights
    constants: Reduction | None = None
    rounding: float = 0.0

    @property
    def is_selection(self) -> bool:
        """Whether the cost has a kernel, so that the minimum-norm g was selected."""
        return self.kernel.shape[-1] > 0

    @property
    def scale(self) -> Tensor:
        """The unit of each row of v, `(..., N)`: what is small for a row is small relative to it."""
        return self.rows.scale

    def detach(self) -> Reduction:
        """Return the same problem without a graph, to the last bit as if there were none."""
        return self if self.constants is None else self.constants

    def in_units(self, unit: Tensor) -> Reduction:
        """Return the same problem for v / unit and lam unit; units `(N,)` that are powers of two change no digit."""
        per, rows, excess = 1 / unit[:, None], self.rows, self.excess
        if excess is not None:
            excess = excess * per * torch.cat([unit.new_ones(rows.n_theta), 1 / unit])
        return replace(
            self,
            V=self.V * per,
            G=self.G * per * per.mT,
            Ct=self.Ct * per,
            A_lam=self.A_lam * per.mT,
            kernel=self.kernel * per,
            excess=excess,
            rows=replace(rows, C=rows.C * per, scale=rows.scale / unit),
        )

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
    values = {f.name: getattr(holder, f.name) for f in fields(holder)}
    return replace(holder, **{name: change(x) for name, x in values.items() if isinstance(x, Tensor)})


def reduce(rows: DataRows, weights: Weights) -> Reduction:
    """Reduce the problem of the data and weights.

    Values come from the QR of E. Where the data or the weights carry a graph, V, G, A_theta and A_lam carry it on, by
    the derivative of the saddle-point system they solve (:mod:`torch_dpc.problem.saddle`).
    """
    without_graph = _constants(rows, weights)
    with untransformed():  # LAPACK needs plain numbers, which a transform would wrap
        values = _values(*without_graph)
    if not carries_derivative((rows.C, rows.Yp, *weights.tensors.values())):
        return values
    reduction = replace(values, rows=rows, weights=weights, constants=values)
    known = torch.cat([values.A_theta, -values.A_lam], dim=-1)
    solution = with_graph(rows, weights, known, values.T, values.Z)
    A_theta, A_lam = solution[..., : rows.n_theta], -solution[..., rows.n_theta :]
    return replace(reduction, V=rows.C @ A_theta, G=rows.C @ A_lam, A_theta=A_theta, A_lam=A_lam)


def _constants(rows: DataRows, weights: Weights) -> tuple[DataRows, Weights]:
    """Return both without graph or tangent: of equal eigenvalues, say, a factorisation has no derivative."""

    def change(tensor: Tensor, _: int) -> Tensor:
        return constant(tensor)

    return rows.map(change), weights.map(change)


def _values(rows: DataRows, weights: Weights) -> Reduction:
    """Return the reduced problem of constants."""
    E, f = least_squares(rows, weights)
    factor = factor_cost(E)
    T, batch = factor.T, E.shape[:-2]
    Z = rows.Z.expand(*batch, *rows.Z.shape[-2:])
    Z = Z.gather(-1, factor.order[..., None, :].expand_as(Z))
    CZ, kernel = moved_by(factor.kernel, without_rounding(rows.C @ Z, rows.C), rows.tolerance)
    Ct = torch.linalg.solve_triangular(T, CZ, upper=True, left=False)
    X_theta = torch.linalg.solve_triangular(T, factor.Q.mT @ f, upper=True)
    # One step of refinement: it matters where weights of zero leave E a condition of 1e10.
    permuted = E.gather(-1, factor.order[..., None, :].expand_as(E))
    X_theta = X_theta + torch.linalg.solve_triangular(T, factor.Q.mT @ (f - permuted @ X_theta), upper=True)
    A_theta = Z @ X_theta
    A_theta[..., :, rows.Eq_theta] += rows.Eq_pinv
    A_lam = Z @ torch.linalg.solve_triangular(T, Ct.mT, upper=True)
    reduction = Reduction(
        V=rows.C @ A_theta,
        G=Ct @ Ct.mT,
        Ct=Ct,
        A_theta=A_theta,
        A_lam=A_lam,
        T=T,
        Z=Z,
        kernel=kernel,
        kernel_in_a=Z @ factor.kernel,
        gain=factor.charge.square().reciprocal(),
        error=T.new_zeros(*batch, 0, 2),
        excess=None,
        rows=rows,
        weights=weights,
    )
    return _verified(reduction, factor.kernel)


def _verified(reduction: Reduction, kernel: Tensor) -> Reduction:
    """Return the reduction, corrected where need be, with its errors; `kernel` is that of the cost, in x."""
    batch, n_theta = reduction.V.shape[:-2], reduction.rows.n_theta
    flat = reduction.of_batch(batch) if batch else _map_tensors(reduction, lambda x: x[None])
    problems = [_one_of(flat, i, bool(batch)) for i in range(len(flat.V))]
    maps = [_map_of(flat, i, k) for i, k in enumerate(kernel.reshape(len(problems), *kernel.shape[-2:]))]
    checked = [verify(posed, found) for posed, found in zip(problems, maps, strict=True)]

    def stacked(parts: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(parts)).reshape(*batch, *parts[0].shape).to(reduction.V.device)

    error = stacked([verdict.error for _, verdict in checked])
    if all(verdict.excess is None for _, verdict in checked):
        return replace(reduction, error=error, rounding=min((verdict.rounding for _, verdict in checked), default=0.0))
    values, A = stacked([found.values for found, _ in checked]), stacked([found.A for found, _ in checked])
    unknown = np.zeros_like(checked[0][0].values)
    excess = stacked([unknown if verdict.excess is None else verdict.excess for _, verdict in checked])
    G = -values[..., n_theta:]
    return replace(
        reduction,
        V=values[..., :n_theta].contiguous(),
        G=(G + G.mT) / 2,
        A_theta=A[..., :n_theta].contiguous(),
        A_lam=-A[..., n_theta:],
        error=error,
        excess=excess,
    )


def _one_of(flat: Reduction, i: int, is_batched: bool) -> Posed:
    """Return problem i of a flattened batch as posed, in arrays."""
    own = flat.rows.C.ndim > 2

    def of_data(tensor: Tensor) -> np.ndarray:
        return (tensor[i] if own else tensor).cpu().numpy()

    def of_weights(name: str) -> np.ndarray:
        tensor = getattr(flat.weights, name)
        return (tensor[i] if is_batched else tensor).cpu().numpy()

    rows, charged = flat.rows, of_data(flat.rows.charged)
    C = of_data(rows.C)
    terms = [Term(2 * of_weights("lambda_g"), np.diag(charged)[charged != 0], None)]
    terms += [
        Term(of_weights(term.weight), C[term.rows], term.reference, term.rows)
        for term in rows.tracking
        if getattr(flat.weights, term.weight) is not None
    ]
    terms += [Term(2 * of_weights(fit.weight), of_data(fit.rows), fit.measured) for fit in rows.fits]
    return Posed(
        terms=tuple(terms),
        C=C,
        Eq=of_data(rows.Eq),
        places=rows.Eq_theta.cpu().numpy(),
        reach=None if rows.Eq_range is None else of_data(rows.Eq_range),
        Z=flat.Z[i].cpu().numpy(),
        scale=of_data(rows.scale),
        theta_scale=of_data(rows.theta_scale),
    )


def _map_of(flat: Reduction, i: int, kernel: Tensor) -> Map:
    """Return the reduced map of problem i of a flattened batch, in arrays."""
    V, G, Ct, A_theta, A_lam, T = (
        x[i].cpu().numpy() for x in (flat.V, flat.G, flat.Ct, flat.A_theta, flat.A_lam, flat.T)
    )
    Eq_pinv = flat.rows.Eq_pinv if flat.rows.Eq_pinv.ndim == 2 else flat.rows.Eq_pinv[i]
    return Map(
        values=np.concatenate([V, -G], axis=1),
        A=np.concatenate([A_theta, -A_lam], axis=1),
        T=T,
        Ct=Ct,
        kernel=kernel.cpu().numpy(),
        Eq_pinv=Eq_pinv.cpu().numpy(),
    )
