"""Batched semismooth Newton for boxes.

With v = v0 - G lam, Newton's step on  v - Proj(v + lam) = 0  is an active-set step: rows outside their bounds are put
on them, rows whose multiplier has the wrong sign are let go, and

    lam_A = G[A, A]^-1 (v0 - bound)_A,    lam = 0 elsewhere

(the primal-dual active set method; Hintermueller, Ito, Kunisch 2002). It ends, exactly, when the set repeats.

On the CPU the compiled kernel solves sample by sample, from a first active set that a few sweeps of coordinate descent
on the multipliers find. Elsewhere torch steps all samples together. Their first set comes from a few accelerated
gradient steps in single precision, which are matrix products and cost less than one Newton step. Either start is nearly
the solution, so that one or two Newton steps finish.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from . import kernels
from .active_set import solve_active
from .kernels import HYSTERESIS
from .outcome import Found


@dataclass(frozen=True)
class PrimalDualSettings:
    """Settings of the primal-dual active set method in torch.

    Attributes:
        steps: steps after which a sample is left to the second engine; samples that converge need 2 to 7.
        near: rows within this fraction of the width of their bounds are in the system from the start.
        warm_start_steps: accelerated gradient steps before the first Newton step. On the masses, 15 leave 1.2 Newton
            steps a sample of 3.3.
    """

    steps: int = 20
    near: float = 0.2
    warm_start_steps: int = 15


SETTINGS = PrimalDualSettings()


def solve_newton(G: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> Found:
    """Solve the reduced problem of every sample.

    Args:
        G, Ct: `(N, N)` and `(N, n_x)`, or one a sample, `(B, N, N)` and `(B, N, n_x)`.
        v0: the unconstrained minimisers, `(B, N)`.
        lower, upper: `(N,)` or `(B, N)`.
    """
    if kernels.has_kernels(v0):
        return _by_kernel(G, v0, lower, upper)
    return _batched(G, Ct, v0, lower, upper)


def _by_kernel(G: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> Found:
    if lower.ndim != upper.ndim:
        lower, upper = lower.expand_as(v0), upper.expand_as(v0)
    G_array, centre, low, high = (kernels.as_array(x) for x in (G, v0, lower, upper))
    found = kernels.solve_boxes(G_array, centre, low, high, torch.get_num_threads())
    return Found(*map(torch.from_numpy, found))


def _batched(G: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> Found:
    result = Found(
        lam=torch.zeros_like(v0),
        iterations=torch.zeros(len(v0), dtype=torch.int64, device=v0.device),
        converged=torch.zeros(len(v0), dtype=torch.bool, device=v0.device),
    )
    todo = torch.arange(len(v0), device=v0.device)
    # Most rows never meet a bound: iterate on those that some sample violates or comes near, then look at all rows.
    near = torch.nan_to_num(SETTINGS.near * (upper - lower), posinf=0.0)
    working = ((v0 > upper - near) | (v0 < lower + near) | (lower == upper)).any(dim=0)
    slack_upper, slack_lower = upper + HYSTERESIS * (1 + upper.abs()), lower - HYSTERESIS * (1 + lower.abs())
    while len(todo):
        rows = working.nonzero()[:, 0]
        everyone = len(todo) == len(v0)
        samples = slice(None) if everyone else todo
        G_rows = _take(G, samples)[..., rows, :]
        problem = (G_rows[..., rows], _take(Ct, samples)[..., rows, :], v0[samples][:, rows])
        bounds = (_take_bound(lower, samples)[..., rows], _take_bound(upper, samples)[..., rows])
        lam, steps, converged = _iterate(*problem, *bounds)
        v = v0[samples] - _times(lam, G_rows)
        violated = (v > _take_bound(slack_upper, samples)) | (v < _take_bound(slack_lower, samples))
        violated[:, rows] = False
        finished = ~violated.any(dim=1)
        result.lam[todo[:, None], rows] = lam
        result.iterations[samples] += steps
        result.converged[samples] = converged & finished
        if bool(finished.all()):
            break
        working = working | violated.any(dim=0)
        todo = todo[~finished & converged]
    return result


def _iterate(G: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Run Newton on all rows given; samples that have converged leave the batch."""
    lam_out = torch.zeros_like(v0)
    steps = torch.zeros(len(v0), dtype=torch.int64, device=v0.device)
    converged = torch.zeros(len(v0), dtype=torch.bool, device=v0.device)
    if v0.shape[1] == 0:
        return lam_out, steps, ~converged
    # A row is active where v + lam passes its bound by the hysteresis, or where its bounds leave no choice.
    tight = lower == upper
    above = torch.where(tight, -torch.inf, upper + HYSTERESIS * (1 + upper.abs()))
    below = lower - HYSTERESIS * (1 + lower.abs())
    todo: Tensor | slice = slice(None)
    lam = _warm_start(G, v0, lower, upper)
    pushed = v0 - _times(lam, G) + lam
    active = (pushed > above) | (pushed < below)
    for step in range(1, SETTINGS.steps + 1):
        low, high = _take_bound(lower, todo), _take_bound(upper, todo)
        G_todo, v0_todo = _take(G, todo), v0[todo]
        target = torch.clamp(pushed, low, high)
        lam, independent = solve_active(G_todo, _take(Ct, todo), active, v0_todo - target)
        pushed = v0_todo - _times(lam, G_todo) + lam
        again = (pushed > _take_bound(above, todo)) | (pushed < _take_bound(below, todo))
        stay = (again != active).any(dim=1)
        if not bool(stay.any()):
            lam_out[todo], steps[todo], converged[todo] = lam, step, independent
            return lam_out, steps, converged
        left = torch.arange(len(v0), device=v0.device) if isinstance(todo, slice) else todo
        done, todo = left[~stay], left[stay]
        lam_out[done], steps[done], converged[done] = lam[~stay], step, independent[~stay]
        pushed, active = pushed[stay], again[stay]
    steps[todo] = SETTINGS.steps
    return lam_out, steps, converged


def _warm_start(G: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return rough multipliers: Nesterov's method with step 1/|G|, on multipliers in units of that step."""
    G, v0, lower, upper = (x.float() for x in (G, v0, lower, upper))
    size = G.abs().sum(-1).amax(-1)  # a norm that bounds the largest eigenvalue
    size = torch.where(size > 0, size, 1.0)[..., None]
    step = torch.eye(G.shape[-1], dtype=G.dtype, device=G.device) - G / size[..., None]
    lam = ahead = torch.zeros_like(v0)
    for k in range(SETTINGS.warm_start_steps):
        pushed = torch.addmm(v0, ahead, step) if G.ndim == 2 else v0 + _times(ahead, step)
        new = pushed - torch.clamp(pushed, lower, upper)
        ahead = torch.lerp(lam, new, 1 + k / (k + 3))
        lam = new
    return (lam / size).double()


def _times(lam: Tensor, G: Tensor) -> Tensor:
    return lam @ G if G.ndim == 2 else (lam[:, None, :] @ G)[:, 0]


def _take(matrix: Tensor, samples: Tensor | slice) -> Tensor:
    return matrix if matrix.ndim == 2 else matrix[samples]


def _take_bound(bound: Tensor, samples: Tensor | slice) -> Tensor:
    return bound if bound.ndim == 1 else bound[samples]
