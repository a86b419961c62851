"""What an attacker wants: costs psi of the planned trajectory, to be made small."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data
from ..solution import DPCSolution

#: A cost of a plan, `(*batch,)`; any callable will do.
Cost = Callable[[DPCSolution], Tensor]


class TargetInput:
    """psi(u) = 1/2 |u - u_target|^2: make the controller apply the attacker's input (the paper's cost).

    Args:
        u_target: `(n_u,)` or `(horizon, n_u)`, in the units of the inputs.
        trajectory: instead, a target for the whole run, `(>= steps, n_u)`: the plan of step k is compared with its rows
            k, ..., k + horizon - 1, the last row held beyond its end.
    """

    def __init__(self, u_target: Any = None, *, trajectory: Any = None):
        if (u_target is None) == (trajectory is None):
            raise ValueError("give either `u_target` or `trajectory=`.")
        name, value = ("u_target", u_target) if trajectory is None else ("trajectory", trajectory)
        self.target = as_data(name, value)
        self.moves = trajectory is not None
        if self.target.ndim not in ((2,) if self.moves else (1, 2)):
            raise ValueError(f"`{name}` has {self.target.ndim} dimensions, which is not among those it may have.")

    def at(self, step: int) -> Cost:
        """Return the cost of a plan made at a step of the run."""

        def psi(solution: DPCSolution) -> Tensor:
            target = self.target.to(solution.u)
            if self.moves:
                rows = torch.arange(step, step + solution.u.shape[-2], device=target.device)
                target = target[rows.clamp_max(len(target) - 1)]
            return 0.5 * (solution.u - target).square().sum((-2, -1))

        return psi

    def __call__(self, solution: DPCSolution) -> Tensor:
        """Return psi of a plan made at step 0, `(*batch,)`."""
        return self.at(0)(solution)


def at_step(cost: Any, step: int) -> Cost:
    """Return the cost of a plan made at a step; a cost without `at` is the same at every step."""
    return cost.at(step) if hasattr(cost, "at") else cost
