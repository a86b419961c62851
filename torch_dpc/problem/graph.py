"""The graph of a reduction: its map with the derivative in the data and the weights behind it."""

from __future__ import annotations

import torch
from torch import Tensor

from ..autodiff import constant, untransformed
from ..shapes import broadcast_shapes
from .least_squares import gram_of_charged
from .rows import DataRows
from .saddle import Saddle, known_solution
from .weights import Weights


def with_graph(rows: DataRows, weights: Weights, solution: Tensor, T: Tensor, Z: Tensor) -> Tensor:
    """Attach the derivative of [Psi rows'; rows -D] [a; m] = [Phi theta - C' lam; e] to its known solution.

    Psi and Phi are of the terms without a target, and of those that track; the equalities are rows of compliance zero,
    and the fits, lambda |S a - s|^2, rows of compliance 1 / (2 lambda).

    Args:
        rows, weights: with their graph.
        solution: [A_theta, -A_lam], `(..., r, n_theta + N)`, and
        T, Z: of the reduction, without a graph.
    """
    terms: list[tuple[Tensor, Tensor, int | None]] = []
    for term in rows.tracking:
        if (weight := getattr(weights, term.weight)) is not None:
            block = rows.C[..., term.rows, :]
            terms.append(((weight @ block).mT, block, term.reference))
    held, places = [rows.Eq], [rows.Eq_theta]
    D = [weights.lambda_g.new_zeros(rows.Eq.shape[-2], 1)]
    for fit in rows.fits:
        weight, k = 2 * getattr(weights, fit.weight)[..., None, None], fit.rows.shape[-2]
        if fit.measured is None or not bool((weight.detach() > 0).all()):
            terms.append((weight * fit.rows.mT, fit.rows, fit.measured))
            continue
        held.append(fit.rows)
        places.append(torch.arange(fit.measured, fit.measured + k, device=rows.Eq_theta.device))
        D.append((1 / weight).expand(*weight.shape[:-2], k, 1))
    Psi = 2 * weights.lambda_g[..., None, None] * gram_of_charged(rows)
    for weighted, block, _ in terms:
        Psi = Psi + weighted @ block
    batch = broadcast_shapes(Psi.shape[:-2], solution.shape[:-2])
    Phi = Psi.new_zeros(*batch, Psi.shape[-1], rows.n_theta)
    for weighted, _, start in terms:
        if start is not None:
            Phi = Phi + torch.nn.functional.pad(weighted, (start, rows.n_theta - start - weighted.shape[-1]))
    top = torch.cat([Phi, -rows.C.mT.expand(*batch, -1, -1)], dim=-1)
    place, whole = torch.cat(places), torch.cat([x.expand(*batch, *x.shape[-2:]) for x in held], dim=-2)
    bottom = top.new_zeros(*batch, len(place), top.shape[-1])
    bottom[..., torch.arange(len(place)), place] = 1.0
    compliance = torch.cat([x.expand(*batch, *x.shape[-2:]) for x in D], dim=-2)
    at = (T, Z, rows.Eq_pinv, whole, rows.theta_scale[..., place], Psi, compliance)
    T, Z, Eq_pinv, fixed, units, Psi_, D_ = map(constant, at)
    with untransformed(), torch.no_grad():  # the factors outlive a transform that is under way
        saddle = Saddle.of(T, Z, Eq_pinv, fixed, units, Psi_, D_, rows.tolerance)
    return known_solution(Psi, whole, compliance, top, bottom, solution.expand(*batch, -1, -1), saddle)
