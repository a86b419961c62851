"""A proof that a sample has no solution: a direction that separates the trajectories from the sets."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..batching import times
from ..sets.feasible import FeasibleSet
from .dual_active_set import SOLVED_FLAG, Daqp

#: Directions of Ct below this fraction of the largest are none.
DEPENDENT = 1e-10
#: Entries of a direction below this fraction of its largest are rounding, and rounds of leaving those out.
NOTHING, ROUNDS = 1e-12, 10
#: Rounds that make a direction of the gap between trajectories and sets.
ALTERNATIONS = 60
#: By how much the certificate must separate, relative to the size of v0 and of the bounds.
MARGIN = 1e-9
#: A certificate whose Ct'd is not quite zero excludes only |x| below this, relative to the size of the problem.
FAR = 1e6


def infeasibility_certificate(Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> bool:
    """Return whether one sample is proven to have no v = v0 + Ct x between its bounds.

    By Farkas' lemma a direction d with Ct' d = 0 and d'v0 > max {d'b : lower <= b <= upper} is a proof. The direction
    is the residual of the nearest point,  min 1/2 |x|^2 + 1/(2 eps) |s|^2,  lower <= v0 + Ct x + s <= upper,  which
    always exists; it is checked afterwards, whoever found it.

    Args:
        Ct: `(N, n_x)`.
        v0, lower, upper: `(N,)`.
    """
    Ct, v0, lower, upper = (x.detach().cpu() for x in (Ct, v0, lower, upper))
    scale = max(float(torch.linalg.matrix_norm(Ct, ord=2)), 1e-12) if Ct.numel() else 1.0
    unbounded = torch.stack([upper.isinf(), lower.isinf()])
    no_equality = np.zeros(len(v0), dtype=np.int32)
    for eps in (1e-6, 1e-9, 1e-12):
        soft = eps**0.5 * scale * torch.eye(len(v0), dtype=Ct.dtype)
        workspace = Daqp(torch.cat([Ct, soft], dim=1))
        lam, flag, _ = workspace.solve((lower - v0).numpy(), (upper - v0).numpy(), no_equality)
        if flag != SOLVED_FLAG:
            continue
        d = torch.from_numpy(lam)
        if any(_separates(c, Ct, v0, lower, upper) for c in (d, _in_kernel(d, Ct, unbounded))):
            return True
    return False


def _in_kernel(d: Tensor, Ct: Tensor, unbounded: Tensor) -> Tensor:
    """Return a direction near d with Ct' d = 0 that uses no row without a bound on the side it points to.

    Args:
        d: `(N,)`.
        Ct: `(N, n_x)`.
        unbounded: whether the upper and the lower bound are missing, `(2, N)`.
    """
    for _ in range(ROUNDS):
        d = torch.where(torch.where(d > 0, unbounded[0], unbounded[1]), 0.0, d)
        d = torch.where(d.abs() > NOTHING * d.abs().amax(), d, 0.0)
        used = d.nonzero()[:, 0]
        left, singular, _ = torch.linalg.svd(Ct[used], full_matrices=False)
        span = left[:, singular > DEPENDENT * singular.max()] if singular.numel() else left
        d = torch.zeros_like(d).index_copy(0, used, d[used] - span @ (span.T @ d[used]))
        if not bool((torch.where(d > 0, unbounded[0], unbounded[1]) & (d != 0)).any()):
            break
    return d


def _separates(d: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> bool:
    norm = torch.linalg.vector_norm
    d = d / norm(d).clamp_min(torch.finfo(d.dtype).tiny)
    used = d != 0
    bound = torch.where(d > 0, upper, lower)[used]
    margin = (d * v0)[used].sum() - (d[used] * bound).sum()
    size = norm(v0) + norm(bound)
    leak = norm(Ct.T @ d)
    # x with |x| > margin / leak are not excluded: demand that they be absurdly far away.
    return bool(margin > MARGIN * size) and bool(margin > FAR * (1 + size) * leak)


def separates_from_set(Ct: Tensor, v0: Tensor, sets: FeasibleSet, gap: Tensor) -> Tensor:
    """Return which samples, `(...)`, are proven to have no v = v0 + Ct x in the sets.

    The shortest way from the sets to the trajectories, brought into the kernel of Ct' and to where the sets are
    bounded, is a direction d; d'v0 > sup {d'v : v in the sets} is a proof, whoever found it.

    Args:
        Ct: `(N, n_x)`, or one a sample, in part order.
        v0: `(..., N)`.
        sets: all sets.
        gap: a guess of that way, `(..., N)`; zero where there is none.
    """
    left, singular, _ = torch.linalg.svd(Ct, full_matrices=False)
    span = left * (singular > DEPENDENT * singular.amax(-1, keepdim=True)).to(Ct)[..., None, :]
    norm = torch.linalg.vector_norm
    d = gap
    for _ in range(ALTERNATIONS):
        d = sets.bounded_direction(d - times(span, times(span.mT, d)))
        d = d / norm(d, dim=-1, keepdim=True).clamp_min(torch.finfo(d.dtype).tiny)
    most = sets.support(d)
    margin = (d * v0).sum(-1) - most
    size = norm(v0, dim=-1) + most.abs()
    leak = norm(times(Ct.mT, d), dim=-1)
    # x with |x| > margin / leak are not excluded: demand that they be absurdly far away.
    return most.isfinite() & (margin > MARGIN * size) & (margin > FAR * (1 + size) * leak)
