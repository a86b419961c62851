"""The coefficients a of g = B a that reproduce a plan.

a = A_theta theta - A_lam lam, but large multipliers round a by more than they round the plan, and where the cost has a
kernel the plan may have moved along it. Both are made good here, and what cannot be made good is measured.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..batching import times
from ..problem.cost import slope_of_cost, terms_of_cost
from ..problem.reduction import Reduction
from .outcome import ACCEPTANCE

#: Singular values at or below this fraction of the largest are no direction to correct along.
NO_DIRECTION = 1e-13
#: A miss of a reference that costs nothing worth the name, relative to the unit of its channel.
NEGLIGIBLE = 1e-8
#: Plans go no further along directions without cost, relative to 1 + |a|.
REACH = 1e3


def rounding_of(reduction: Reduction, theta: Tensor, a: Tensor, v: Tensor) -> Tensor:
    """Return the change of a that brings Up g, Uf g and Yf g onto u_ini, u and y, `(*batch, r)`.

    The kernel of the cost comes first, for moving along it changes no cost. The rest, which changes the cost by as
    little as can be, is done where the plan is missed by more than is accepted.

    Args:
        reduction: without a graph.
        theta: (u_ini, y_ini, u_ref, y_ref), `(*batch, n_theta)`.
        a: the coefficients, `(*batch, r)`.
        v: the plan, `(*batch, n)`: (u, y), du left out or not.
    """
    rows, n = reduction.rows, v.shape[-1]
    per = 1 / reduction.scale[..., :n]
    C, kernel, K = rows.C[..., :n, :], reduction.kernel[..., :n, :], reduction.kernel_in_a
    change = times(rows.Eq_pinv, theta[..., rows.Eq_theta] - times(rows.Eq, a))
    change = torch.where(rows.unreachable(theta)[..., None], 0.0, change)
    back, Ct = reduction.Z @ torch.linalg.inv(reduction.T), reduction.Ct[..., :n, :]
    if reduction.is_selection:
        # What large multipliers leave along the kernel is rounding: w follows from the plan.
        change = change - times(K, times(K.mT, a + change))
        change = change + times(K, _solved(kernel * per[..., None], torch.nan_to_num((v - times(C, a + change)) * per)))
        along = K.mT @ back
        Ct, back = Ct - kernel @ along, back - K @ along  # the small charge of the kernel would hide all else
    missed = torch.nan_to_num((v - times(C, a + change)) * per)
    is_off = (missed.abs() / (1 + (v * per).abs())).amax(-1, keepdim=True) > ACCEPTANCE.residual
    return change + torch.where(is_off, times(back, _solved(Ct * per[..., None], missed)), 0.0)


def coefficients(reduction: Reduction, theta: Tensor, lam: Tensor, v: Tensor) -> Tensor:
    """Return the coefficients that reproduce the plan v `(*batch, N)`, du left out or not, `(*batch, r)`."""
    a = times(reduction.A_theta, theta) - times(reduction.A_lam, lam)
    return a + rounding_of(reduction, theta, a, v)


def inconsistency(reduction: Reduction, a: Tensor, v: Tensor) -> Tensor:
    """Return by how much coefficients miss the plan v `(*batch, N)`, relative to each row's unit, `(*batch,)`."""
    n = v.shape[-1]
    per = 1 / reduction.scale[..., :n]
    missed = (v - times(reduction.rows.C[..., :n, :], a)) * per
    return (missed.abs() / (1 + (v * per).abs())).amax(-1)


def excess_cost(reduction: Reduction, theta: Tensor, a: Tensor, lam: Tensor, v: Tensor) -> Tensor:
    """Return a bound on what coefficients of a plan v cost beyond the optimum, relative to their cost, `(*batch,)`.

    The cost is quadratic with the Hessian T'T on the kernel of Eq, so a slope r of the Lagrangian is worth at most
    1/2 |T^-T r|^2. Along the kernel of the cost no curvature ends a slope: it is worth as much as a plan may go there.
    A cost below that of missing every target by :data:`NEGLIGIBLE` of its unit counts as that.
    """
    left = slope_of_cost(reduction, theta, a) + times(reduction.rows.C.mT, lam)
    slope = times(reduction.Z.mT, left)
    worth = torch.linalg.solve_triangular(reduction.T.mT, slope[..., None], upper=False)[..., 0].square().sum(-1) / 2
    missed = torch.nan_to_num(v - times(reduction.rows.C[..., : v.shape[-1], :], a))
    worth = worth + (missed * lam[..., : v.shape[-1]]).abs().sum(-1)
    if reduction.is_selection:
        far = REACH * (1 + torch.linalg.vector_norm(a, dim=-1))
        worth = worth + times(reduction.kernel_in_a.mT, left).abs().sum(-1) * far
    return worth / torch.maximum(terms_of_cost(reduction, theta, a).abs(), negligible_cost(reduction))


def negligible_cost(reduction: Reduction) -> Tensor:
    """Return the cost of missing every reference by :data:`NEGLIGIBLE` of its unit, `()` or one a problem."""
    rows, weights = reduction.rows, reduction.weights
    total = torch.zeros((), dtype=torch.float64, device=reduction.T.device) + torch.finfo(torch.float64).tiny
    for term in rows.tracking:
        if (weight := getattr(weights, term.weight)) is not None:
            near = NEGLIGIBLE * reduction.scale[..., term.rows]
            total = total + (weight.diagonal(dim1=-2, dim2=-1) * near.square()).sum(-1) / 2
    return total


def _solved(matrix: Tensor, missed: Tensor) -> Tensor:
    """Return the least x with matrix x = missed, as far as there is one."""
    return times(torch.linalg.pinv(matrix, rtol=NO_DIRECTION), missed)
