"""Whole plans by the compiled kernel: one call for the multipliers, the plan and its judgement, one for the adjoint.

For one problem on the CPU that all samples share, with sets of the package. Samples that do not convince are left to
the general path, :class:`torch_dpc.solve.solver.Solver`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..problem.reduction import Reduction
from ..sets.bounds import Bounds
from ..sets.units import in_units
from ..sets.values import values_of
from . import kernels
from .engines import Sets

#: The kernel multiplies V by theta up to this many samples; a matrix product is faster for more.
FEW = 4
_NO_BLOCKS = np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int64), *[np.zeros(0)] * 2


@dataclass(frozen=True, eq=False)
class CompiledPlanner:
    """Plans and adjoints of one problem.

    Attributes:
        reduction: the problem, with rows of v in units of their own.
        unit: of the rows of v, `(N,)`, powers of two.
    """

    reduction: Reduction
    unit: Tensor
    _kept: list[tuple[Sets, kernels.SetArrays]] = field(default_factory=list)

    @staticmethod
    def of(in_units: Reduction, unit: Tensor) -> CompiledPlanner | None:
        """Return the planner; None for a batch of problems, one that needs a selection or an idle input, or a GPU."""
        simple = in_units.G.ndim == 2 and in_units.rows.Eq_range is None and not in_units.is_selection
        return CompiledPlanner(in_units, unit) if simple and kernels.has_kernels(in_units.G) else None

    @cached_property
    def map(self) -> kernels.Map:
        """The problem as the kernel reads it."""
        reduction = self.reduction
        of_theta, of_lam = reduction.error.amax(-2).tolist()
        diagonal = reduction.G.diagonal()
        vectors = (1 / reduction.rows.theta_scale, diagonal / reduction.scale, self.unit)
        per_theta, moved, unit = (x.contiguous().numpy() for x in vectors)
        errors = of_theta, of_lam, reduction.rounding
        return kernels.Map(reduction.G.numpy(), reduction.V.numpy(), per_theta, moved, unit, *errors)

    @cached_property
    def _per_unit(self) -> np.ndarray:
        return 1 / self.map.unit

    def solve(self, theta: Tensor, sets: Sets) -> kernels.PlannedArrays | None:
        """Return the plans, in the caller's units, with the batch dimensions of theta; `convinces` stays `(B,)`.

        Args:
            theta: `(*batch, n_theta)`.
            sets: with present parameters, in the caller's units.

        Returns:
            None if the kernel does not know the sets, or their batch dimensions are not those of theta.
        """
        batch = theta.shape[:-1]
        arrays = self.arrays(sets, batch, theta.device)
        if arrays is None:
            return None
        flat = kernels.as_array(theta).reshape(-1, theta.shape[-1])
        v0 = None if len(flat) <= FEW else (theta.reshape(flat.shape) @ self.reduction.V.mT).numpy()
        found = kernels.plan(self.map, arrays, flat, v0, torch.get_num_threads())
        if len(batch) == 1:
            return found
        v, lam, active, weak, info = (x.reshape(*batch, x.shape[-1]) for x in found[:5])
        return kernels.PlannedArrays(v, lam, active, weak, info, found.convinces)

    def adjoint(
        self, sets: Sets, at: tuple[Tensor, Tensor, Tensor, Tensor], v_bar: np.ndarray, lam_bar: Tensor | None
    ) -> Tensor | None:
        """Return theta_bar = V'(v_bar + S (lam_bar - G v_bar)), `(*batch, n_theta)`.

        Args:
            sets: those of the plan, in the caller's units.
            at: v, lam, active and weak rows of the plan, `(*batch, N)`; for boxes v and weak rows do not count.
            v_bar: cotangent of v, likewise.
            lam_bar: cotangent of lam, or None for zero.

        Returns:
            None if the kernel does not know the sets, or the held directions of a sample are dependent.
        """
        batch, n = v_bar.shape[:-1], v_bar.shape[-1]
        arrays = self.arrays(sets, torch.Size(batch), self.unit.device)
        if arrays is None:
            return None
        v, lam, active, weak = (kernels.as_array(x).reshape(-1, n) for x in at)
        bars = v_bar.reshape(-1, n), None if lam_bar is None else kernels.as_array(lam_bar).reshape(-1, n)
        few, threads = len(lam) <= FEW, torch.get_num_threads()
        found = kernels.plan_adjoint(self.map, arrays, (v, lam, active, weak), *bars, of_theta=few, threads=threads)
        if found is None:
            return None
        v0_bar, theta_bar = found
        if theta_bar is None:
            theta_bar = ((torch.from_numpy(v0_bar) * self.unit) @ self.reduction.V).numpy()
        return torch.from_numpy(theta_bar.reshape(*batch, theta_bar.shape[-1]))

    def arrays(self, sets: Sets, batch: torch.Size, device: torch.device) -> kernels.SetArrays | None:
        """Return the sets in units as the kernel reads them; None if it does not know them, or another batch."""
        if not kernels.has_kernels(self.unit):
            return None
        kept = self._kept[0] if self._kept else None
        if kept is not None and kept[0] is sets:
            return kept[1]
        if isinstance(sets, Bounds):
            if not all(bound.shape[:-1] in (torch.Size(), batch) for bound in sets.tensors):
                return None
            sides = (x.reshape(-1, x.shape[-1]) if x.ndim > 2 else x for x in sets.tensors)
            lower, upper = (side.detach().numpy() * self._per_unit for side in sides)
            return self._keep(sets, (lower, upper, None, *_NO_BLOCKS), sets.are_shared)
        if sets.batch_shape not in (torch.Size(), batch):
            return None
        values = values_of(in_units(sets, self.unit), batch, device)
        if values is None:
            return None
        return self._keep(sets, kernels.set_arrays(values), not sets.batch_shape)

    def _keep(self, sets: Sets, arrays: kernels.SetArrays, are_shared: bool) -> kernels.SetArrays:
        """Keep the arrays for the next call: a layer makes new sets if a parameter has changed."""
        if are_shared:
            self._kept[:] = [(sets, arrays)]
        return arrays
