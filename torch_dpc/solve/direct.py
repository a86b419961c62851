"""A single plan from its windows: one call of the compiled kernel, and one for its adjoint.

The autograd Function takes u_ini, y_ini, u_ref and y_ref themselves, so that joining them to theta is no part of the
graph. It serves float64 windows without a batch dimension on the CPU, for one problem whose weights, data and sets
carry no derivative. Whatever it does not serve, and derivatives of its derivative, go the general way of
:mod:`torch_dpc.solve.derivative`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..autodiff import is_plain
from ..errors import Status
from . import kernels, window_kernels
from .compiled import CompiledPlanner
from .derivative import OF_SETS, Plan, pulled_back
from .engines import Sets
from .linearization import saved_by
from .outcome import Planned
from .solver import Solver

#: u_ini, y_ini, u_ref and y_ref; a reference may be None, one step for all, or all steps.
Windows = tuple[Tensor, Tensor, Tensor | None, Tensor | None]
#: Address, count and places to fill of each window in turn, as the kernel reads them.
Addresses = tuple[int, ...]
#: `(steps, channels)` of each window.
Shapes = tuple[tuple[int, int], ...]


def addresses_of(windows: Windows, shapes: Shapes) -> Addresses | None:
    """Return where the windows lie; None if one of them is not a plain contiguous float64 tensor that fits.

    Args:
        windows: of one sample.
        shapes: `(steps, channels)` of each of them.
    """
    if not kernels.are_built() or getattr(windows[0], "ndim", 0) != 2:
        return None
    found: Addresses = ()
    for window, shape, may_repeat in zip(windows, shapes, (False, False, True, True), strict=True):
        size = shape[0] * shape[1]
        if window is None:
            if not may_repeat:
                return None
            found += (0, 0, size)
            continue
        if not (type(window) is Tensor and window.dtype is torch.float64 and window.is_cpu and is_plain(window)):
            return None
        given = window.shape
        if given != shape and not (may_repeat and given in (shape[1:], (1, shape[1]))):
            return None
        if not window.is_contiguous() or window.is_neg():
            return None
        found += (window.data_ptr(), window.numel(), size)
    return found


@dataclass(frozen=True, eq=False)
class Direct:
    """Single plans of one problem in sets whose parameters are constant.

    Attributes:
        solver: of the problem.
        sets: with their parameters.
        shapes: of the four windows, `(steps, channels)`.
        planner: the compiled kernel's.
        arrays: the sets as the kernel reads them.
        one: what stands before u_ini in theta, a 1 for affine systems.
    """

    solver: Solver
    sets: Sets
    shapes: Shapes
    planner: CompiledPlanner
    arrays: kernels.SetArrays
    one: np.ndarray

    @staticmethod
    def of(solver: Solver, sets: Sets, shapes: Shapes) -> Direct | None:
        """Return the direct way of a problem; None if the kernel does not take it as a whole."""
        planner = solver.compiled
        if planner is None or solver.engine == "daqp" or solver.full is not None or not solver.is_clear:
            return None
        arrays = planner.arrays(sets, torch.Size(), torch.device("cpu"))
        if arrays is None or any(x.ndim > 1 for x in arrays if x is not None):
            return None
        ones = np.ones(solver.reduction.rows.n_theta - sum(steps * channels for steps, channels in shapes))
        return Direct(solver, sets, shapes, planner, arrays, ones)

    @cached_property
    def _before(self) -> Addresses:
        return (self.one.ctypes.data, len(self.one), len(self.one)) if len(self.one) else ()

    def plan(self, windows: Windows, addresses: Addresses, on_failure: str) -> tuple[Tensor, Planned]:
        """Return theta and the plan, with their graph."""
        if torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in windows):
            apply = super(torch.autograd.Function, DirectPlan).apply  # without a search for transforms
            theta, *planned = apply(*windows, addresses, self, on_failure)
            return theta, Planned(*planned)
        return self.solve(addresses, on_failure)

    def solve(self, addresses: Addresses, on_failure: str) -> tuple[Tensor, Planned]:
        """Return theta and the plan, without a graph.

        Raises:
            ValueError: values that are not finite.
            InfeasibleError, SolveError: with `on_failure="raise"`, if there is no accepted solution.
        """
        found = window_kernels.plan_one(self.planner.map, self.arrays, self._before + addresses)
        theta, v, lam, active, weak, info, convinces = found
        joined = torch.from_numpy(theta)
        if convinces and not self.sets.is_box:
            convinces = bool(self.solver.screen.vouches(joined, torch.from_numpy(lam), torch.from_numpy(v)))
        if not convinces:
            return joined, self.solver.solve(joined, self.sets, on_failure)
        parts = [*self.solver.sizes.split(v), lam, active, info]
        if not self.sets.is_box:
            parts += [v[self.solver.sizes.u + self.solver.sizes.y :], weak]
        return joined, Planned(*map(torch.from_numpy, parts))

    def adjoint(self, saved: tuple[Tensor, ...], bars: tuple[Tensor | None, ...]) -> np.ndarray | None:
        """Return theta_bar, `(n_theta,)`; None if the held directions are dependent.

        Args:
            saved: lam, active, info; then u, y, du and weak for sets that are no boxes.
            bars: cotangents of u, y, what follows them in v, and lam, each of which may be None.
        """
        lam, active = saved[0].detach().numpy(), saved[1].numpy()
        v, weak = lam, active  # for boxes they do not count
        if not self.sets.is_box:
            v, weak = np.concatenate([x.detach().numpy().ravel() for x in saved[3:6]]), saved[6].numpy()
        sizes, kept = self.solver.sizes, []
        addresses: Addresses = ()
        for bar, size in zip(bars, (sizes.u, sizes.y, sizes.more, sizes.v), strict=True):
            given = size
            if bar is not None and (bar.is_neg() or not bar.is_contiguous()):
                if any(bar.stride()) or bar.is_neg():
                    bar = bar.resolve_neg().contiguous()
                    kept.append(bar)  # until the kernel has read it
                else:
                    given = 1  # of a sum: one number for all
            addresses += (0, 0, size) if bar is None or size == 0 else (bar.data_ptr(), given, size)
        return window_kernels.adjoint_one(self.planner.map, self.arrays, (v, lam, active, weak), addresses)

    def parts(self, theta_bar: Any, needed: tuple[bool, ...], shapes: list[torch.Size | None]) -> list[Any]:
        """Return the cotangents of the windows, of an array or a tensor; None for those that are not needed."""
        start, found = len(self.one), []
        for own, need, shape in zip(self.shapes, needed, shapes, strict=True):
            size = own[0] * own[1]
            part = None
            if need and shape is not None:
                part = theta_bar[start : start + size].reshape(own)
                part = part if shape == own else part.sum(0).reshape(tuple(shape))
            found.append(part)
            start += size
        return found


class DirectPlan(Plan):
    """(u_ini, y_ini, u_ref, y_ref, addresses, direct, on_failure) -> theta and the fields of `Planned`.

    The same derivative as `Plan`, whose general rule it falls back to.
    """

    setup_context = staticmethod(torch.autograd.Function.setup_context)  # `forward` takes ctx, which is faster

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        *windows, addresses, direct, on_failure = args
        theta, planned = direct.solve(addresses, on_failure)
        u, y, lam, active, info, *of_curved = (x for x in planned if x is not None)
        ctx.set_materialize_grads(False)
        ctx.direct, ctx.sets = direct, direct.sets
        ctx.is_solved = info.numpy()[0] == Status.SOLVED
        ctx.shapes = [None if x is None else x.shape for x in windows]
        saved = [lam, active, info]
        if of_curved:
            ctx.mark_non_differentiable(active, info, of_curved[1])
            ctx.versions = direct.sets.versions()
            saved += [u, y, *of_curved, *direct.sets.tensors]
        else:
            ctx.mark_non_differentiable(active, info)
        ctx.save_for_backward(*saved)
        return theta, u, y, lam, active, info, *of_curved

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> tuple[Tensor | None, ...]:
        theta_bar, u_bar, y_bar, lam_bar, _active, _info, *of_curved = cotangents
        du_bar = of_curved[0] if of_curved else None
        direct, needed = ctx.direct, ctx.needs_input_grad[:4]
        bars = (u_bar, y_bar, du_bar, lam_bar)
        given = [bar for bar in (theta_bar, *bars) if bar is not None]
        if theta_bar is None and not torch.is_grad_enabled() and all(map(is_plain, given)):
            if not given:
                return (None,) * 7
            found = direct.adjoint(saved_by(ctx), bars) if ctx.is_solved else None
            if found is not None:
                parts = direct.parts(found, needed, ctx.shapes)
                return *(None if part is None else torch.from_numpy(part) for part in parts), None, None, None
        total = _general(ctx, direct, (u_bar, y_bar, lam_bar, du_bar))
        if theta_bar is not None:
            total = theta_bar if total is None else total + theta_bar
        if total is None:
            return (None,) * 7
        return *direct.parts(total, needed, ctx.shapes), None, None, None


def _general(ctx: Any, direct: Direct, bars: tuple[Tensor | None, ...]) -> Tensor | None:
    """Return theta_bar the general way, which may be differentiated again and takes samples that failed."""
    ctx.solver, ctx.has_matrices, ctx.may_fail = direct.solver, False, True
    if direct.sets.is_box:
        ctx.bound_shapes = [bound.shape for bound in direct.sets.tensors]
    need = (True,) + (False,) * (OF_SETS - 1 + len(direct.sets.tensors))
    return pulled_back(ctx, bars, need)[0]
