"""Optima of a cost that leaves directions free: the optimum of the cost as posed first, then the least |g|.

Along the kernel of the cost the reduction charges 1/2 |w|^2 / gain, so that one plan is the optimum; that charge must
not buy a worse cost. The proximal point method (Rockafellar 1976) takes it away again: with the charge moved to the w
found last,

    v0 <- v0 + K w,      w <- w - gain K'lam,

the multipliers come to do no work along the kernel, K'lam = 0, and then the plan is optimal for the cost without any
charge. Quadratic problems take a few rounds. The first w, of the charged problem, is within the charge of the one of
least norm among the optima, and each further one is nearest to the one before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..batching import times
from ..problem.reduction import Reduction
from .outcome import Found


@dataclass(frozen=True)
class SelectionSettings:
    """When the charge counts as taken away.

    Attributes:
        work: of the multipliers along each direction of the kernel, relative to its terms;
        still: or the next move of a row along it, in its unit.
        rounds: the most there are.
    """

    work: float = 1e-12
    still: float = 1e-12
    rounds: int = 20


SETTINGS = SelectionSettings()


def uncharged(reduction: Reduction, v0: Tensor, run: Callable[..., Found]) -> tuple[Found, Tensor]:
    """Return what an engine finds for the cost without a charge on its kernel, and K w, `(*batch, N)`.

    The plan is v0 + K w - G lam.

    Args:
        reduction: in units, of a cost with a kernel.
        v0: unconstrained minimisers, `(*batch, N)`.
        run: the engine, and whether it completes what the compiled kernel leaves. It does so once: in further rounds
            that takes seconds, and a sample stays where it was.
    """
    found, moved = run(v0), torch.zeros_like(v0)
    lam, iterations, able = found.lam, found.iterations, found.converged
    for _ in range(SETTINGS.rounds):
        pull = times(reduction.kernel.mT, lam)
        along = times(reduction.kernel, pull) * reduction.gain[..., 0]
        works = (_work(reduction.kernel, lam, pull) > SETTINGS.work) & (along.abs().amax(-1) > SETTINGS.still) & able
        if not bool(works.any()):
            break
        trial = torch.where(works[..., None], moved - along, moved)
        again = run(v0 + trial, complete=False)
        able, better = able & again.converged, again.converged[..., None]
        lam, moved = torch.where(better, again.lam, lam), torch.where(better, trial, moved)
        iterations = iterations + again.iterations
    return Found(lam, iterations, found.converged, found.gap), moved


def _work(K: Tensor, lam: Tensor, pull: Tensor) -> Tensor:
    """Return the largest entry of pull = K'lam relative to its terms, `(*batch,)`."""
    terms = times(K.mT.abs(), lam.abs()).clamp_min(torch.finfo(lam.dtype).tiny)
    return (pull.abs() / terms).amax(-1)
