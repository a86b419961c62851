"""A few samples with boxes on the CPU without the compiled kernels: DAQP, one after the other, judged in NumPy.

NumPy's calls cost a third of torch's. A sample whose residual is not convincing sends the call to the batched path.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..errors import Status
from ..problem.reduction import Reduction
from ..problem.terms import Sizes
from ..sets.bounds import Bounds
from .daqp import SOLVED_FLAG, sense_of
from .engines import Engines
from .optimality import SINGLE, Optimality
from .outcome import ACCEPTANCE, Planned

#: Up to this many samples are taken one after the other.
FEW = 3


@dataclass(frozen=True, eq=False)
class SingleSolver:
    """Solves single samples of one problem that all of them share, on the CPU.

    Attributes:
        reduction: the reduced problem, without a graph.
        in_units: the same problem for v / unit.
        sizes: the parts of theta and of v.
        engines: of the problem in units: for the choice of the engine, and DAQP's workspace.
        unit: of each row of v, `(N,)`.
    """

    reduction: Reduction
    in_units: Reduction
    sizes: Sizes
    engines: Engines
    unit: Tensor

    @staticmethod
    def of(
        reduction: Reduction, in_units: Reduction, sizes: Sizes, engines: Engines, unit: Tensor
    ) -> SingleSolver | None:
        """Return the solver; None for a batch of problems, idle inputs, sets that are no boxes, or a GPU."""
        plain = reduction.G.ndim == 2 and reduction.rows.Eq_range is None and engines.structure is None
        plain = plain and not reduction.is_selection
        if not plain or reduction.G.device.type != "cpu":
            return None
        return SingleSolver(reduction, in_units, sizes, engines, unit)

    @cached_property
    def optimality(self) -> Optimality:
        """The judge of single samples."""
        return Optimality(self.in_units, SINGLE)

    @cached_property
    def _units(self) -> tuple[np.ndarray, np.ndarray]:
        """The units and their inverses, which are powers of two as well."""
        return self.unit.numpy(), (1 / self.unit).numpy()

    def solve(self, theta: Tensor, bounds: Bounds, chosen: str) -> Planned | None:
        """Return the plans; None if there are more samples than a few or one of them has no convincing solution.

        A value that is not finite has none: the batched path names it.
        """
        n_theta = theta.shape[-1]
        if theta.numel() > FEW * n_theta or not bounds.are_shared or theta.device.type != "cpu":
            return None
        if not self.engines.is_daqp_first(chosen, theta):
            return None
        batch, sample = theta.shape[:-1], theta.numpy()
        per_unit = self._units[1]
        lower, upper = bounds.lower.numpy() * per_unit, bounds.upper.numpy() * per_unit
        if not batch:
            one = self._one(sample, lower, upper)
            if one is None:
                return None
            v, *rest = one
        else:
            several = [self._one(row, lower, upper) for row in sample.reshape(-1, n_theta)]
            found = [one for one in several if one is not None]
            if not found or len(found) < len(several):
                return None
            v, *rest = (np.stack(x).reshape((*batch, -1)) for x in zip(*found, strict=True))
        return Planned(*map(torch.from_numpy, (*self.sizes.split(v), *rest)))

    def _one(self, theta: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, ...] | None:
        """Return v, lam, active and info of one sample, given bounds in units; None if its residual is too large."""
        v0 = self.optimality.unconstrained(theta)
        assert self.engines.workspace is not None
        lam, flag, iterations = self.engines.workspace.solve(lower - v0, upper - v0, sense_of(lower == upper))
        raw, error = self.optimality.displaced(v0, lam), self.optimality.error(theta, lam)
        v, residual, active, n_active, n_weak = self.optimality.judge(raw, lam, lower, upper, 0.0)
        if not (flag == SOLVED_FLAG and residual + error <= ACCEPTANCE.convincing):  # NaN is not either
            return None
        unit, per_unit = self._units
        info = np.array((Status.SOLVED, iterations, residual, n_active, n_weak), dtype=np.float64)
        return v * unit, lam * per_unit, active, info
