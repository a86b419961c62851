"""The forward solve for any convex set with a projection.

A solution is a zero of  F(lam) = v - P(v + gamma lam),  v = v0 - G lam.  A few steps of Douglas-Rachford splitting
(Lions and Mercier 1979) give a start, and semismooth Newton on F, whose step is the projected system of
:mod:`torch_dpc.solve.projected_system`, solves most problems. Newton's system is singular if the rows that meet their
bounds are linearly dependent. Such problems go to the augmented Lagrangian of the least-distance form,

    minimise 1/2 |x|^2   subject to   v = v0 + Ct x in the set,          x = -Ct' lam,

each of whose subproblems is smooth and strongly convex: Newton with a line search solves it from every start, and the
multipliers converge for every convex set (Li, Sun, Toh 2018). Newton on F polishes the result.

gamma, one number for each group of rows that a set constrains, is the displacement that a unit of multiplier makes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..batching import times
from ..sets.feasible import FeasibleSet
from .projected_system import newton_step


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of Newton on F and of the splitting before it.

    Attributes:
        splitting_steps: Douglas-Rachford steps before Newton.
        steps: Newton steps in one attempt.
        halvings: how often a step is halved until |F| shrinks.
        decrease: fraction of |F| by which a step of length 1 must shrink it.
        converged: |F| relative to 1 + |v| at which a sample has converged.
        good: |F| relative to 1 + |v| above which the augmented Lagrangian has its turn.
        least_scale: gamma of a group, relative to the largest diagonal entry of G, at least.
    """

    splitting_steps: int = 20
    steps: int = 25
    halvings: int = 12
    decrease: float = 1e-4
    converged: float = 1e-13
    good: float = 1e-10
    least_scale: float = 1e-6


@dataclass(frozen=True)
class AugmentedLagrangianSettings:
    """Settings of the augmented Lagrangian method; penalties are in units of 1 / gamma.

    Attributes:
        rounds: updates of the multipliers.
        close: |F| relative to 1 + |v| at which Newton on F takes over.
        patience: rounds without halving |F| after which a sample is given up.
        penalty, largest_penalty, growth: the first penalty, the largest, and the factor from round to round.
        easy_steps: Newton steps of a round up to which the penalty may grow.
        inner_steps: Newton steps of one round.
        all_steps: Newton steps of all rounds after which a sample is given up, about a second.
        flat: slope at which a round is solved, relative to the first slope and |x|.
        slope_rounding: rounding of a slope, relative to its terms.
        near_rounding: a slope within this factor of its rounding counts as solved once it has stalled.
        stalled_steps: steps without halving the slope after which it has stalled.
        bisections: bisections of a line search.
        too_far, too_short: a step is too long (short) if the slope at its end exceeds this fraction of the slope at its
            start, with the other sign (the same sign).
    """

    rounds: int = 60
    close: float = 1e-11
    patience: int = 20
    penalty: float = 1.0
    largest_penalty: float = 1e9
    growth: float = 10.0
    easy_steps: int = 20
    inner_steps: int = 40
    all_steps: int = 200
    flat: float = 1e-12
    slope_rounding: float = 1e-16
    near_rounding: float = 100.0
    stalled_steps: int = 3
    bisections: int = 40
    too_far: float = 0.1
    too_short: float = 0.5


NEWTON = NewtonSettings()
LAGRANGIAN = AugmentedLagrangianSettings()


@dataclass
class Found:
    """Multipliers `(B, N)`, steps taken and |F| relative to 1 + |v|, each `(B,)`.

    `gap`, `(B, N)`, is an estimate of the shortest vector from the sets to the trajectories, from the last round of the
    augmented Lagrangian; it does not vanish if there is no solution.
    """

    lam: Tensor
    iterations: Tensor
    residual: Tensor
    gap: Tensor


def scale_of(G: Tensor, sets: FeasibleSet) -> Tensor:
    """Return gamma, `(N,)`, from the diagonal of G: the largest of each group, and of all problems."""
    diagonal = G.diagonal(dim1=-2, dim2=-1)
    diagonal = diagonal.reshape(-1, diagonal.shape[-1]).amax(0)
    largest = float(diagonal.amax())
    return sets.largest_of_group(diagonal).clamp_min(1e-6 * largest if largest > 0 else 1.0)


def resolvent_of(G: Tensor, gamma: Tensor) -> Tensor:
    """Return (G + diag gamma)^-1, which a step of the splitting needs, `(..., N, N)`."""
    root = gamma.sqrt()
    scaled = G / root[:, None] / root + torch.eye(len(root), dtype=G.dtype, device=G.device)
    return torch.cholesky_inverse(torch.linalg.cholesky(scaled)) / root[:, None] / root


def solve_convex(G: Tensor, Ct: Tensor, resolvent: Tensor, v0: Tensor, sets: FeasibleSet, gamma: Tensor) -> Found:
    """Solve every sample.

    Args:
        G, Ct: `(N, N)` and `(N, n_x)`, or one a sample.
        resolvent: of G and gamma, likewise.
        v0: unconstrained minimisers, `(B, N)`; more batch dimensions where the sets have them.
        sets: all sets, in part order like G and v0.
        gamma: the scale of the multipliers, `(N,)`.
    """
    lam = _split(resolvent, v0, sets, gamma)
    lam, iterations, residual = _newton(G, v0, sets, gamma, lam)
    found = Found(lam, iterations + NEWTON.splitting_steps, residual, torch.zeros_like(v0))
    bad = residual > NEWTON.good
    if not bool(bad.any()):
        return found
    some = bad.nonzero()[:, 0] if v0.ndim == 2 and not sets.batch_shape else slice(None)
    G_bad, Ct_bad = (m if m.ndim == 2 else m[some] for m in (G, Ct))
    lam, steps, gap = _augmented_lagrangian(G_bad, Ct_bad, v0[some], sets, gamma)
    polished, more, size = _newton(G_bad, v0[some], sets, gamma, lam)
    better = size < found.residual[some]
    found.lam[some] = torch.where(better[..., None], polished, found.lam[some])
    found.residual[some] = torch.where(better, size, found.residual[some])
    found.iterations[some] += steps + more
    found.gap[some] = gap
    return found


def _split(resolvent: Tensor, v0: Tensor, sets: FeasibleSet, gamma: Tensor) -> Tensor:
    """Return multipliers after a few steps of Douglas-Rachford splitting."""
    state = v0
    for _ in range(NEWTON.splitting_steps):
        nearest = sets.prox(state, gamma)
        behind = 2 * nearest - state
        # The affine map's resolvent: (G + gamma) lam = v0 - behind, and v = behind + gamma lam.
        state = nearest + gamma * times(resolvent, v0 - behind)
    return (state - sets.prox(state, gamma)) / gamma


def _residual(G: Tensor, v0: Tensor, sets: FeasibleSet, gamma: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return F, v + gamma lam, and |F| relative to 1 + |v|."""
    v = v0 - times(G, lam)
    x = v + gamma * lam
    F = v - sets.prox(x, gamma)
    norm = torch.linalg.vector_norm
    return F, x, norm(F, dim=-1) / (1 + norm(v, dim=-1))


def _newton(G: Tensor, v0: Tensor, sets: FeasibleSet, gamma: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Newton on F, steps halved until |F| shrinks; return multipliers, steps, and |F| relative to 1 + |v|."""
    F, x, size = _residual(G, v0, sets, gamma, lam)
    iterations = torch.zeros_like(size, dtype=torch.int64)
    for _ in range(NEWTON.steps):
        todo = size > NEWTON.converged
        if not bool(todo.any()):
            break
        step = newton_step(G, sets, sets.jacobians(x, gamma), F, gamma)
        iterations = iterations + todo
        length = todo.to(size)
        for _ in range(NEWTON.halvings):
            trial = lam + length[..., None] * step
            F_trial, x_trial, size_trial = _residual(G, v0, sets, gamma, trial)
            longer = todo & ~(size_trial < (1 - NEWTON.decrease * length) * size)
            if not bool(longer.any()):
                break
            length = torch.where(longer, length / 2, length)
        accept = (size_trial < size)[..., None]
        if not bool(accept.any()):
            break
        lam, F, x = (torch.where(accept, new, old) for new, old in ((trial, lam), (F_trial, F), (x_trial, x)))
        size = torch.where(accept[..., 0], size_trial, size)
    return lam, iterations, size


def _augmented_lagrangian(
    G: Tensor, Ct: Tensor, v0: Tensor, sets: FeasibleSet, gamma: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the best multipliers of any round, Newton steps, and the way from the sets to the trajectories."""
    best, gap = torch.zeros_like(v0), torch.zeros_like(v0)
    steps = torch.zeros(v0.shape[:-1], dtype=torch.int64, device=v0.device)
    least = torch.full(v0.shape[:-1], torch.inf, dtype=v0.dtype, device=v0.device)
    may_leave = v0.ndim == 2 and not sets.batch_shape
    rest: Tensor | slice = torch.arange(len(v0), device=v0.device) if may_leave else slice(None)
    lam, x = torch.zeros_like(v0), v0.new_zeros(*v0.shape[:-1], Ct.shape[-1])
    penalty, idle = torch.full_like(least, LAGRANGIAN.penalty)[..., None], torch.zeros_like(steps)
    for _ in range(LAGRANGIAN.rounds):
        centre, C, H = v0[rest], *(m if m.ndim == 2 else m[rest] for m in (Ct, G))
        reach = gamma / penalty  # the gamma of this round: w - P(w), over it, is the new multiplier
        x, spent = _minimise(C, centre + reach * lam, sets, reach, x)
        w = centre + times(C, x) + reach * lam
        new = (w - sets.prox(w, reach)) / reach
        gap[rest], steps[rest] = reach * (new - lam), steps[rest] + spent
        lam = new
        size = _residual(H, centre, sets, gamma, lam)[2]
        better = size < least[rest]
        best[rest] = torch.where(better[..., None], lam, best[rest])
        idle = torch.where(size < 0.5 * least[rest], 0, idle + 1)
        least[rest] = torch.where(better, size, least[rest])
        stay = (size > LAGRANGIAN.close) & (idle < LAGRANGIAN.patience) & (steps[rest] < LAGRANGIAN.all_steps)
        if not bool(stay.any()):
            break
        # The penalty does not grow after a round of many steps: better multipliers make the next one easier.
        grown = (LAGRANGIAN.growth * penalty).clamp_max(LAGRANGIAN.largest_penalty)
        penalty = torch.where(spent[..., None] < LAGRANGIAN.easy_steps, grown, penalty)
        penalty = torch.where(spent[..., None] == LAGRANGIAN.inner_steps, penalty / LAGRANGIAN.growth, penalty)
        if may_leave:
            rest, lam, x, penalty, idle = rest[stay], lam[stay], x[stay], penalty[stay], idle[stay]  # type: ignore[index]
    return best, steps, gap


def _minimise(Ct: Tensor, shift: Tensor, sets: FeasibleSet, reach: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Minimise 1/2 |x|^2 + 1/2 |w - P(w)|^2 / reach, w = shift + Ct x: slope and curvature come from P and D alone."""

    def slope(x: Tensor) -> tuple[Tensor, Tensor]:
        w = shift + times(Ct, x)
        return x + times(Ct.mT, (w - sets.prox(w, reach)) / reach), w

    gradient, w = slope(x)
    steps = torch.zeros(x.shape[:-1], dtype=torch.int64, device=x.device)
    norm = torch.linalg.vector_norm
    may_leave = x.ndim == 2 and not sets.batch_shape
    size = left = norm(gradient, dim=-1)
    rounding, stalled = LAGRANGIAN.slope_rounding * torch.linalg.matrix_norm(Ct), torch.zeros_like(steps)
    for _ in range(LAGRANGIAN.inner_steps):
        floor = LAGRANGIAN.flat * (size + norm(x, dim=-1)) + rounding * norm(w / reach, dim=-1)
        now = norm(gradient, dim=-1)
        stalled = torch.where(now < 0.5 * left, 0, stalled + 1)
        left = torch.minimum(left, now)
        todo = (now > floor) & ((stalled < LAGRANGIAN.stalled_steps) | (now > LAGRANGIAN.near_rounding * floor))
        if not bool(todo.any()):
            break
        some = todo.nonzero()[:, 0] if may_leave else slice(None)
        scale, C = (part if part.ndim == own else part[some] for part, own in ((reach, 1), (Ct, 2)))
        step = torch.zeros_like(x)
        step[some] = _newton_step(C, w[some], gradient[some], sets, scale)
        step = step * todo[..., None]
        steps = steps + todo
        # The slope along the step increases from a negative value; the minimum is its zero. Length 1 is tried first.
        low, high = torch.zeros_like(steps, dtype=x.dtype), torch.ones_like(steps, dtype=x.dtype)
        start, length = (gradient * step).sum(-1), high
        for _ in range(LAGRANGIAN.bisections):
            trial = x + length[..., None] * step
            gradient_trial, w_trial = slope(trial)
            along = (gradient_trial * step).sum(-1)
            too_far = along > LAGRANGIAN.too_far * start.abs()
            too_short = (along < -LAGRANGIAN.too_short * start.abs()) & (length < 1)
            if not bool((todo & (too_far | too_short)).any()):
                break
            high, low = torch.where(too_far, length, high), torch.where(too_short, length, low)
            length = torch.where(too_far | too_short, (low + high) / 2, length)
        x, gradient, w = trial, gradient_trial, w_trial
    return x, steps


def _newton_step(Ct: Tensor, w: Tensor, gradient: Tensor, sets: FeasibleSet, reach: Tensor) -> Tensor:
    """Return -(I + Ct' (I - D) Ct / reach)^-1 gradient."""
    curved = sets.complement_times(sets.jacobians(w, reach), Ct) / reach[..., None]
    rows = curved.abs().amax(-1).reshape(-1, curved.shape[-2]).amax(0).nonzero()[:, 0]  # few rows meet their bounds
    eye = torch.eye(Ct.shape[-1], dtype=Ct.dtype, device=Ct.device)
    L, _ = torch.linalg.cholesky_ex(eye + Ct[..., rows, :].mT @ curved[..., rows, :])
    return -torch.cholesky_solve(gradient[..., None], L)[..., 0]
