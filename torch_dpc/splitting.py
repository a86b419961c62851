"""The forward solve for any convex set: Douglas-Rachford splitting, polished by semismooth Newton.

A solution is a zero of  F(lam) = v - P(v + gamma lam),  v = v0 - G lam.  Newton's step solves the projected system of
:mod:`torch_dpc.projected_system` and is accepted where it shortens F; where the steps end far from a solution,
Douglas-Rachford (Lions and Mercier 1979), which converges from everywhere for every convex set, brings the multipliers
nearer, and Newton tries again.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .feasible_set import FeasibleSet
from .linear import times
from .projected_system import solve_system

#: Splitting steps before each attempt of Newton's; the first attempt is usually the last.
SPLITTING_STEPS = (20, 100, 400, 2000)
#: Newton's steps in one attempt, and how often a step is halved.
NEWTON_STEPS, HALVINGS = 25, 12
#: |F| relative to 1 + |v| at which a sample has converged.
CONVERGED = 1e-13
#: |F| above which, relative to 1 + |v|, a sample is not worth another look.
GOOD = 1e-10


@dataclass
class SplittingResult:
    """Multipliers `(..., N)`, the steps taken and |F| relative to 1 + |v|, each `(...)`."""

    lam: Tensor
    iterations: Tensor
    residual: Tensor


def scale_of(G: Tensor) -> float:
    """Return gamma, the displacement that a unit of multiplier makes, from the diagonal of G."""
    diagonal = G.diagonal(dim1=-2, dim2=-1)
    moved = diagonal[diagonal > 1e-12 * diagonal.amax()] if diagonal.numel() else diagonal
    return float(moved.mean()) if moved.numel() else 1.0


def solve_splitting(G: Tensor, v0: Tensor, sets: FeasibleSet, gamma: float) -> SplittingResult:
    """Solve every sample.

    Args:
        G: `(N, N)`, or one a sample.
        v0: unconstrained minimisers, `(..., N)`.
        sets: all sets, in part order like G and v0.
        gamma: the scale of the multipliers.
    """
    values, vectors = torch.linalg.eigh(G)
    shrink = 1 / (gamma + values.clamp_min(0.0))
    state = v0.clone()
    best = SplittingResult(torch.zeros_like(v0), torch.zeros(v0.shape[:-1], dtype=torch.int64, device=v0.device), None)  # type: ignore[arg-type]
    for steps in SPLITTING_STEPS:
        for _ in range(steps):
            nearest = sets.prox(state, gamma)
            behind = 2 * nearest - state
            # The affine map's resolvent: (G + gamma) lam = v0 - behind, and v = behind + gamma lam.
            lam = times(vectors, shrink * times(vectors.mT, v0 - behind))
            state = state + (behind + gamma * lam) - nearest
        lam, iterations, residual = _newton(G, v0, sets, gamma, (state - sets.prox(state, gamma)) / gamma)
        better = residual <= best.residual if best.residual is not None else torch.ones_like(residual, dtype=torch.bool)
        best.lam = torch.where(better[..., None], lam, best.lam)
        best.iterations = best.iterations + iterations + steps
        best.residual = residual if best.residual is None else torch.minimum(residual, best.residual)
        if bool((best.residual <= GOOD).all()):
            break
    return best


def _residual(G: Tensor, v0: Tensor, sets: FeasibleSet, gamma: float, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return F, v + gamma lam, and |F| relative to 1 + |v|."""
    v = v0 - times(G, lam)
    F = v - sets.prox(v + gamma * lam, gamma)
    norm = torch.linalg.vector_norm
    return F, v + gamma * lam, norm(F, dim=-1) / (1 + norm(v, dim=-1))


def _newton(G: Tensor, v0: Tensor, sets: FeasibleSet, gamma: float, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    F, x, size = _residual(G, v0, sets, gamma, lam)
    iterations = torch.zeros_like(size, dtype=torch.int64)
    for _ in range(NEWTON_STEPS):
        todo = size > CONVERGED
        if not bool(todo.any()):
            break
        step, _ = solve_system(G, sets, sets.jacobians(x, gamma), F, gamma)
        iterations = iterations + todo
        length = torch.where(todo, 1.0, 0.0)
        for _ in range(HALVINGS):
            trial = lam + length[..., None] * step
            F_trial, x_trial, size_trial = _residual(G, v0, sets, gamma, trial)
            longer = todo & ~(size_trial < (1 - 1e-4 * length) * size)
            if not bool(longer.any()):
                break
            length = torch.where(longer, length / 2, length)
        accept = (size_trial < size)[..., None]
        if not bool(accept.any()):
            break
        lam, F, x = (torch.where(accept, new, old) for new, old in ((trial, lam), (F_trial, F), (x_trial, x)))
        size = torch.where(accept[..., 0], size_trial, size)
    return lam, iterations, size
