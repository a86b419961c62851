"""The optimal cost, with the derivative that the envelope theorem gives it.

With h the indicator of the sets (or the price of leaving them), h* its conjugate and f the terms of the cost, the
Lagrangian at a solution is

    value = f(a, theta) + lam'(C a) - h*(lam),      a = A_theta theta - A_lam lam.

It is stationary in lam, so that its derivative is the partial one in theta, the weights and the sets' parameters. lam
carries its graph all the same: second derivatives need how it moves.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..batching import times
from ..sets.bounds import Bounds
from ..sets.feasible import FeasibleSet
from .least_squares import gram_of_charged
from .reduction import Reduction


def optimal_cost(reduction: Reduction, theta: Tensor, lam: Tensor, v: Tensor, sets: Bounds | FeasibleSet) -> Tensor:
    """Return the optimal cost, `(*batch,)`; differentiable in every argument, twice.

    Args:
        reduction: with its graph.
        theta: (u_ini, y_ini, u_ref, y_ref), `(*batch, n_theta)`.
        lam: optimal multipliers, `(*batch, N)`.
        v: the constrained rows (u, y, du, slack), `(*batch, N)`; only sets without a `conjugate` of their own need it.
        sets: with their present parameters and their graph.

    Raises:
        NotImplementedError: a penalty of one's own does not define `conjugate`.
    """
    a = times(reduction.A_theta, theta) - times(reduction.A_lam, lam)
    multipliers = (lam * times(reduction.rows.C, a)).sum(-1)
    return terms_of_cost(reduction, theta, a) + multipliers - sets.conjugate(lam, v)


def terms_of_cost(reduction: Reduction, theta: Tensor, a: Tensor) -> Tensor:
    """Return f(a, theta), the terms of the cost in the coordinates of the row space, `(*batch,)`."""
    rows, weights = reduction.rows, reduction.weights
    total = weights.lambda_g * (a * times(gram_of_charged(rows), a)).sum(-1)
    for term in rows.tracking:
        weight = getattr(weights, term.weight)
        if weight is None:
            continue
        error = times(rows.C[..., term.rows, :], a)
        if term.reference is not None:
            error = error - theta[..., term.reference : term.reference + error.shape[-1]]
        total = total + (error * times(weight, error)).sum(-1) / 2
    for fit in rows.fits:
        error = times(fit.rows, a)
        if fit.measured is not None:
            error = error - theta[..., fit.measured : fit.measured + fit.rows.shape[-2]]
        total = total + getattr(weights, fit.weight) * error.square().sum(-1)
    return total


def slope_of_cost(reduction: Reduction, theta: Tensor, a: Tensor) -> Tensor:
    """Return the gradient of :func:`terms_of_cost` in a, `(*batch, r)`."""
    rows, weights = reduction.rows, reduction.weights
    total = 2 * weights.lambda_g[..., None] * times(gram_of_charged(rows), a)
    for term in rows.tracking:
        weight = getattr(weights, term.weight)
        if weight is None:
            continue
        block = rows.C[..., term.rows, :]
        error = times(block, a)
        if term.reference is not None:
            error = error - theta[..., term.reference : term.reference + error.shape[-1]]
        total = total + times(block.mT, times(weight, error))
    for fit in rows.fits:
        error = times(fit.rows, a)
        if fit.measured is not None:
            error = error - theta[..., fit.measured : fit.measured + fit.rows.shape[-2]]
        total = total + 2 * getattr(weights, fit.weight)[..., None] * times(fit.rows.mT, error)
    return total


def mismatch(reduction: Reduction, theta: Tensor, lam: Tensor) -> Tensor:
    """Return Yp g - y_ini, `(*batch, t_ini n_y)`."""
    a = times(reduction.A_theta, theta) - times(reduction.A_lam, lam)
    (fit,) = (fit for fit in reduction.rows.fits if fit.weight == "lambda_s")
    assert fit.measured is not None
    return torch.sub(times(fit.rows, a), theta[..., fit.measured : fit.measured + fit.rows.shape[-2]])
