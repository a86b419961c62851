"""A proof that a sample has no solution: a direction that separates the trajectories from the sets.

By Farkas' lemma a direction d with Ct'd = 0 and d'v0 > sup {d'v : v in the sets} proves that no v = v0 + Ct x lies in
the sets. Candidates come from the vector between trajectories and sets at the point where they are nearest; each is
checked by :func:`_separates`, whatever produced it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..batching import times
from ..sets.bounds import Bounds
from ..sets.feasible import FeasibleSet
from .daqp import SOLVED_FLAG, Daqp


@dataclass(frozen=True)
class CertificateSettings:
    """Tolerances of the certificate, and how far the search for one goes.

    Attributes:
        margin: the certificate must separate by this, relative to the size of v0 and of the bounds.
        far: a certificate whose Ct'd is not exactly zero excludes only |x| below margin / |Ct'd|; demand this, relative
            to the size of the problem.
        rank: singular values of Ct below this fraction of the largest count as zero.
        rounding: entries of a direction below this fraction of its largest count as zero.
        rounds: rounds of leaving out rows without a bound, for boxes.
        alternations: alternating projections between the kernel of Ct' and the bounded directions, for other sets.
        softness: weights of the least violation in the nearest-point problem of boxes, relative to |Ct|^2, in order.
    """

    margin: float = 1e-9
    far: float = 1e6
    rank: float = 1e-10
    rounding: float = 1e-12
    rounds: int = 10
    alternations: int = 60
    softness: tuple[float, ...] = (1e-6, 1e-9, 1e-12)


SETTINGS = CertificateSettings()


def is_infeasible(Ct: Tensor, v0: Tensor, sets: Bounds | FeasibleSet, gap: Tensor | None) -> Tensor:
    """Return which samples are proven to have no v = v0 + Ct x in the sets, `(*batch,)`.

    Args:
        Ct: `(N, n_x)`, or one a sample; in part order for sets that are no boxes, as v0 and gap.
        v0: `(B, N)`; `(*batch, N)` for sets that are no boxes.
        sets: with present parameters; bounds are shared or one a sample.
        gap: a guess of the shortest vector from the sets to the trajectories, shaped like v0; not used for boxes.
    """
    if isinstance(sets, FeasibleSet):
        return torch.zeros_like(v0[..., 0], dtype=torch.bool) if gap is None else _by_gap(Ct, v0, sets, gap)
    proven = torch.zeros(len(v0), dtype=torch.bool, device=v0.device)
    for k in range(len(v0)):
        bounds = Bounds(*(bound if bound.ndim == 1 else bound[k] for bound in sets.tensors))
        proven[k] = _box_is_infeasible(Ct if Ct.ndim == 2 else Ct[k], v0[k], bounds)
    return proven


def _by_gap(Ct: Tensor, v0: Tensor, sets: FeasibleSet, gap: Tensor) -> Tensor:
    left, singular, _ = torch.linalg.svd(Ct, full_matrices=False)
    largest = singular[..., :1]  # none if the equalities decide everything
    span = left * (singular > SETTINGS.rank * largest).to(Ct)[..., None, :]
    d = gap
    for _ in range(SETTINGS.alternations):
        d = _unit(sets.bounded_direction(d - times(span, times(span.mT, d))))
    return _separates(d, Ct, v0, sets)


def _box_is_infeasible(Ct: Tensor, v0: Tensor, bounds: Bounds) -> bool:
    """Look for a certificate of one sample.

    The direction is the residual s of the nearest point, which always exists,

        min 1/2 |x|^2 + 1/(2 eps) |s|^2   subject to   lower <= v0 + Ct x + s <= upper.

    Args:
        Ct: `(N, n_x)`.
        v0: `(N,)`.
        bounds: `(N,)`.
    """
    Ct, v0, lower, upper = (x.detach().cpu() for x in (Ct, v0, *bounds.tensors))
    bounds = Bounds(lower, upper)
    scale = max(float(torch.linalg.matrix_norm(Ct, ord=2)), 1e-12) if Ct.numel() else 1.0
    no_equality = np.zeros(len(v0), dtype=np.int32)
    for eps in SETTINGS.softness:
        soft = eps**0.5 * scale * torch.eye(len(v0), dtype=Ct.dtype)
        workspace = Daqp(torch.cat([Ct, soft], dim=1))
        lam, flag, _ = workspace.solve((lower - v0).numpy(), (upper - v0).numpy(), no_equality)
        if flag != SOLVED_FLAG:
            continue
        d = torch.from_numpy(lam)
        if any(bool(_separates(_unit(c), Ct, v0, bounds)) for c in (d, _in_kernel(d, Ct, bounds))):
            return True
    return False


def _in_kernel(d: Tensor, Ct: Tensor, bounds: Bounds) -> Tensor:
    """Return a direction near d `(N,)` with Ct'd = 0 that uses no row without a bound on the side it points to."""
    for _ in range(SETTINGS.rounds):
        d = bounds.bounded_direction(d)
        d = torch.where(d.abs() > SETTINGS.rounding * d.abs().amax(), d, 0.0)
        used = d.nonzero()[:, 0]
        left, singular, _ = torch.linalg.svd(Ct[used], full_matrices=False)
        span = left[:, singular > SETTINGS.rank * singular.max()] if singular.numel() else left
        d = torch.zeros_like(d).index_copy(0, used, d[used] - span @ (span.T @ d[used]))
        if torch.equal(bounds.bounded_direction(d), d):
            break
    return d


def _separates(d: Tensor, Ct: Tensor, v0: Tensor, sets: Bounds | FeasibleSet) -> Tensor:
    """Return whether a unit direction d `(..., N)` is a proof, `(...)`."""
    norm = torch.linalg.vector_norm
    supports = sets.supports(d)
    most = supports.sum(-1)
    margin = (d * v0).sum(-1) - most
    size = norm(v0, dim=-1) + supports.abs().sum(-1)
    leak = norm(times(Ct.mT, d), dim=-1)
    return most.isfinite() & (margin > SETTINGS.margin * size) & (margin > SETTINGS.far * (1 + size) * leak)


def _unit(d: Tensor) -> Tensor:
    return d / torch.linalg.vector_norm(d, dim=-1, keepdim=True).clamp_min(torch.finfo(d.dtype).tiny)
