"""The engines of one reduced problem behind one signature: `(v0, sets) -> Found`, rows in the order of v.

newton  semismooth Newton: for boxes the primal-dual active set method, compiled where the kernels were built; for
        other sets Newton on the projected system, globalised by an augmented Lagrangian
daqp    the dual active-set solver DAQP, for boxes
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..autodiff import untransformed
from ..problem.reduction import Reduction
from ..sets.bounds import Bounds
from ..sets.feasible import FeasibleSet
from ..sets.values import values_of
from . import kernels
from .daqp import Daqp, solve_daqp
from .newton import solve_newton
from .outcome import Found
from .projected_system import ProjectedSystem
from .splitting import resolvent_of, scale_of, solve_convex

Sets = Bounds | FeasibleSet


@dataclass(frozen=True)
class Choice:
    """When which engine comes first.

    Attributes:
        daqp_batch: without the compiled kernels, DAQP takes batches of boxes up to this size on the CPU.
        chunk: samples that the torch engine for general sets takes at once; each needs some N^2 numbers.
    """

    daqp_batch: int = 16
    chunk: int = 256


CHOICE = Choice()


@dataclass(frozen=True, eq=False)
class Engines:
    """The engines of one reduced problem, and what they share.

    Attributes:
        reduction: the reduced problem, without a graph; one, or one a sample of a flattened batch.
        structure: the sets, which parts they have and of which rows; their parameters are not read. None for boxes.
    """

    reduction: Reduction
    structure: FeasibleSet | None

    @cached_property
    def gamma(self) -> Tensor:
        """The scale of the multipliers of sets that are no boxes, `(N,)`, in part order."""
        assert self.structure is not None
        with untransformed():  # the first call may be within a transform, the next one outside of it
            return scale_of(self.G_in_parts, self.structure)

    @cached_property
    def order(self) -> Tensor:
        """The rows of v in part order, `(N,)`."""
        assert self.structure is not None
        return self.structure.order.to(self.reduction.G.device)

    @cached_property
    def inverse(self) -> Tensor:
        """The place in part order of each row of v, `(N,)`."""
        return self.order.argsort()

    @cached_property
    def G_in_parts(self) -> Tensor:
        """G in part order."""
        return self.reduction.G[..., self.order[:, None], self.order]

    @cached_property
    def system(self) -> ProjectedSystem:
        """The projected system of derivatives."""
        if self.structure is None:
            return ProjectedSystem(self.reduction.Ct)
        return ProjectedSystem(self._Ct_in_parts, self.structure, self.gamma)

    @cached_property
    def workspace(self) -> Daqp | None:
        """DAQP's workspace of a matrix that all samples share."""
        return Daqp(self.reduction.Ct) if self.reduction.Ct.ndim == 2 else None

    @cached_property
    def _Ct_in_parts(self) -> Tensor:
        return self.reduction.Ct[..., self.order, :]

    @cached_property
    def _resolvent(self) -> Tensor:
        return resolvent_of(self.G_in_parts, self.gamma)

    def in_order(self, chosen: str, v0: Tensor, sets: Sets) -> tuple[str, ...]:
        """Return the names of the engines that may solve, the first one first.

        Args:
            chosen: "auto", "newton" or "daqp".
            v0: the unconstrained minimisers, `(B, N)`.
            sets: with present parameters.
        """
        if not sets.is_box:
            return ("newton",)
        return ("daqp", "newton") if self.is_daqp_first(chosen, v0) else ("newton", "daqp")

    def run(self, name: str, v0: Tensor, sets: Sets, complete: bool = True) -> Found:
        """Solve by the engine of that name; curved sets complete or as the compiled kernel leaves them."""
        return self.daqp(v0, sets) if name == "daqp" else self.newton(v0, sets, complete)

    def is_daqp_first(self, chosen: str, v0: Tensor) -> bool:
        """Return whether DAQP solves boxes first: Newton is faster, except without its kernel for a few samples."""
        if chosen != "auto":
            return chosen == "daqp"
        few = v0.device.type == "cpu" and v0.numel() <= CHOICE.daqp_batch * v0.shape[-1]
        return few and self.reduction.Ct.ndim == 2 and not kernels.has_kernels(v0)

    def daqp(self, v0: Tensor, sets: Sets) -> Found:
        """Solve boxes by DAQP."""
        assert isinstance(sets, Bounds)
        return solve_daqp(self.reduction.G, self.reduction.Ct, v0, sets.lower, sets.upper, self.workspace)

    def newton(self, v0: Tensor, sets: Sets, complete: bool = True) -> Found:
        """Solve by semismooth Newton: compiled if there is a kernel for the sets, in torch what that leaves."""
        if isinstance(sets, Bounds):
            return solve_newton(self.reduction.G, self.reduction.Ct, v0, sets.lower, sets.upper)
        batch = v0.shape[:-1]
        values = values_of(sets, batch, v0.device)
        if values is None or not kernels.has_kernel_for(v0, values):
            return self._newton_in_torch(v0, sets)
        G = self.reduction.G
        flat_G = G if G.ndim == 2 else G.expand(*batch, *G.shape[-2:]).reshape(-1, *G.shape[-2:])
        found = kernels.solve_sets(flat_G, v0.reshape(-1, v0.shape[-1]), values)
        found = Found(found.lam.reshape(v0.shape), found.iterations.reshape(batch), found.converged.reshape(batch))
        return self._completed(found, v0, sets) if complete and not bool(found.converged.all()) else found

    def _completed(self, found: Found, v0: Tensor, sets: FeasibleSet) -> Found:
        """Return what was found, with the torch engine's answer for the samples that had not converged."""
        failed, gap = ~found.converged, torch.zeros_like(v0)
        may_leave = self.reduction.G.ndim == v0.ndim == 2 and not sets.batch_shape  # then samples are taken one by one
        retried = self._newton_in_torch(v0[failed] if may_leave else v0, sets)
        pairs = ((found.lam, retried.lam), (found.iterations, retried.iterations), (found.converged, retried.converged))
        for whole, part in (*pairs, (gap, retried.gap)):
            assert part is not None
            whole[failed] = part if may_leave else part[failed]
        return Found(found.lam, found.iterations, found.converged, gap)

    def _newton_in_torch(self, v0: Tensor, sets: FeasibleSet) -> Found:
        v0, inverse = v0[..., self.order], self.inverse
        may_split = self.reduction.G.ndim == v0.ndim == 2 and not sets.batch_shape
        parts = v0.split(CHOICE.chunk) if may_split else [v0]
        problem = (self.G_in_parts, self._Ct_in_parts, self._resolvent)
        found = [solve_convex(*problem, part, sets, self.gamma) for part in parts]
        return Found(
            lam=torch.cat([f.lam for f in found])[..., inverse],
            iterations=torch.cat([f.iterations for f in found]),
            converged=torch.cat([f.residual.isfinite() for f in found]),
            gap=torch.cat([f.gap for f in found])[..., inverse],
        )
