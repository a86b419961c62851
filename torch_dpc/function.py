"""The autograd Function of the reduced problem.

At a solution  v = v0 - G lam,  v0 = C A theta,  with A the active rows and b their bounds,

    lam_A = G_AA^-1 (v0 - b)_A,    lam = 0 elsewhere,

the projected Karush-Kuhn-Tucker system of the paper after the reduction. A cotangent (v_bar, lam_bar) goes back by
one system with the same symmetric matrix:

    s_A = G_AA^-1 (lam_bar - G v_bar)_A,     v0_bar = v_bar + s,     b_bar = -s_A,   G_bar = -v0_bar lam',
    a_bar = C' v0_bar,   theta_bar = A' a_bar,   A_bar = a_bar theta',   C_bar = v0_bar (A theta)'.

Everything in the backward is differentiable again, the system included, so derivatives of any order come out.
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .autodiff import apply_function, carries_derivative, is_grads_batched, is_plain
from .batching import flatten_batch, lead_all, outer, times, unit_vectors
from .errors import Status
from .problem.projected_kkt import FullAdjoint
from .problem.reduction import Reduction
from .sets.parameters import check_order
from .solve import kernels
from .solve.active_set import adjoint, solve_active
from .solve.solver import Planned, Solver


def solve_reduced(solver: Solver, theta: Tensor, reduction: Reduction, lower: Tensor, upper: Tensor) -> Planned:
    """Solve for every theta `(*batch, n_theta)`; differentiable in theta, the reduction and the bounds."""
    matrices: tuple[Tensor | None, ...] = (reduction.A_theta, reduction.rows.C, reduction.G)
    if not carries_derivative(matrices):
        if not carries_derivative((theta, lower, upper)) and all(map(is_plain, (theta, lower, upper))):
            return solver.solve(theta, lower, upper)  # a third of the time of a small call is the Function's
        matrices = (None, None, None)  # constants: those of the solver will do, and need not be saved
    return Planned(*apply_function(SolveReduced, theta, *matrices, lower, upper, solver))


class SolveReduced(torch.autograd.Function):
    """(theta, A, C, G, lower, upper) -> u, y, lam, active, info, as `Planned` describes them.

    A, C and G are None where no derivative is asked of them; their values are always those of the solver.
    """

    @staticmethod
    def forward(
        theta: Tensor,
        A: Tensor | None,
        C: Tensor | None,
        G: Tensor | None,
        lower: Tensor,
        upper: Tensor,
        solver: Solver,
    ) -> tuple[Tensor, ...]:
        return tuple(solver.solve(theta, lower, upper))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        theta, A, C, G, lower, upper, solver = inputs
        _, _, lam, active, info = output
        ctx.mark_non_differentiable(active, info)
        ctx.set_materialize_grads(False)
        ctx.solver = solver
        ctx.may_fail = solver.on_failure != "raise"
        ctx.bound_shapes = lower.shape, upper.shape
        saved = (lam, active, info) if A is None else (lam, active, info, theta, A, C, G)
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)

    @staticmethod
    def backward(
        ctx: Any, u_bar: Tensor | None, y_bar: Tensor | None, lam_bar: Tensor | None, *_: Any
    ) -> tuple[Tensor | None, ...]:
        bars = [bar for bar in (u_bar, y_bar, lam_bar) if bar is not None]
        if not bars:
            return (None,) * 7
        lam, active, info, *matrices = ctx.saved_tensors
        solver, need = ctx.solver, ctx.needs_input_grad
        at_last = not torch.is_grad_enabled() and all(map(is_plain, bars))  # nothing will be derived again
        if at_last and lam.ndim == 1 and not (ctx.may_fail or any(need[1:])):
            theta_bar = _of_one(solver, active, u_bar, y_bar, lam_bar)
            if theta_bar is not None:
                return theta_bar, *(None,) * 6
        v_bar = solver.sizes.join(u_bar, y_bar, lam)
        if ctx.may_fail:  # samples without a solution add nothing, whatever came back for their NaN
            solved = info[..., :1] == Status.SOLVED
            v_bar = torch.where(solved, v_bar, 0.0)
            lam_bar = None if lam_bar is None else torch.where(solved, lam_bar, 0.0)
        if solver.full is not None:
            return FullAdjoint.apply(v_bar, lam_bar, active, solver.full), *(None,) * 6
        theta, A, C, G = matrices or _constants(solver)
        if is_grads_batched(v_bar):
            rhs = -times(G, v_bar)
            v0_bar = v_bar + _on_active(rhs if lam_bar is None else rhs + lam_bar, active, G, solver.reduction.Ct)
        else:  # the Function only where something will be derived again
            adjoin = SolveAdjoint.forward if at_last else SolveAdjoint.apply
            v0_bar = adjoin(v_bar, lam_bar, active, G, solver.reduction.Ct)
        a_bar = times(C.mT, v0_bar)
        theta_bar = times(A.mT, a_bar) if need[0] else None
        A_bar = outer(a_bar, theta, A) if need[1] else None
        C_bar = outer(v0_bar, times(A, theta), C) if need[2] else None
        G_bar = outer(-v0_bar, lam, G) if need[3] else None
        lower_bar = upper_bar = None
        if need[4] or need[5]:
            b_bar = torch.where(active, v_bar - v0_bar, 0.0)
            lower_bar = torch.where(lam < 0, b_bar, 0.0).sum_to_size(ctx.bound_shapes[0])
            upper_bar = torch.where(lam < 0, 0.0, b_bar).sum_to_size(ctx.bound_shapes[1])
        return theta_bar, A_bar, C_bar, G_bar, lower_bar, upper_bar, None

    @staticmethod
    def jvp(
        ctx: Any,
        theta_t: Tensor | None,
        A_t: Tensor | None,
        C_t: Tensor | None,
        G_t: Tensor | None,
        lower_t: Tensor | None,
        upper_t: Tensor | None,
        _solver: Any,
    ) -> tuple[Tensor | None, ...]:
        lam, active, info, *matrices = ctx.saved_tensors
        theta, A, C, G = matrices or _constants(ctx.solver)
        solved = info[..., :1] == Status.SOLVED
        free = torch.zeros_like(lam)
        if theta_t is not None:
            free = free + times(C, times(A, theta_t))
        if A_t is not None:
            free = free + times(C, times(A_t, theta))
        if C_t is not None:
            free = free + times(C_t, times(A, theta))
        if G_t is not None:
            free = free - times(G_t, lam)
        rhs = free
        if lower_t is not None:
            rhs = rhs - torch.where(lam < 0, lower_t, 0.0)
        if upper_t is not None:
            rhs = rhs - torch.where(lam < 0, 0.0, upper_t)
        lam_t = _on_active(rhs * solved, active, G, ctx.solver.reduction.Ct)
        v_t = torch.where(solved, free - times(G, lam_t), 0.0)
        return *ctx.solver.sizes.split(v_t), lam_t, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        theta, A, C, G, lower, upper, solver = args
        if any(dim is not None for dim in in_dims[1:4]):
            raise NotImplementedError(
                "vmap over weights or data is not supported: give the layer weights with a leading batch dimension, "
                "which share one batched factorisation."
            )
        theta, lower, upper = lead_all(
            (theta, lower, upper), (in_dims[0], in_dims[4], in_dims[5]), (1, 1, 1), info.batch_size
        )
        if in_dims[4] is not None or in_dims[5] is not None:
            assert lower is not None and upper is not None
            check_order(lower, upper)  # the box could not look at them
        outputs = SolveReduced.apply(theta, A, C, G, lower, upper, solver)
        return outputs, (0,) * len(outputs)


def _constants(solver: Solver) -> tuple[Any, Tensor, Tensor, Tensor]:
    """Return A, C and G where they are constants; theta, which their derivatives alone need, stays out."""
    return None, solver.reduction.A_theta, solver.reduction.rows.C, solver.reduction.G


def _of_one(
    solver: Solver, active: Tensor, u_bar: Tensor | None, y_bar: Tensor | None, lam_bar: Tensor | None
) -> Tensor | None:
    """Return theta_bar of one sample by NumPy and the kernel; None where that does not do."""
    if solver.full is not None or solver.reduction.G.ndim > 2 or not kernels.serve(active):
        return None
    v_bar, n_u = np.zeros(len(active)), solver.sizes.u
    for bar, part in ((u_bar, v_bar[:n_u]), (y_bar, v_bar[n_u : n_u + solver.sizes.y])):
        if bar is not None:
            part[:] = bar.numpy().reshape(-1)
    lam_array = None if lam_bar is None else kernels.as_array(lam_bar)
    A, C, G = solver.arrays
    v0_bar = kernels.adjoint_of_one(G, active.numpy(), v_bar, lam_array)
    return None if v0_bar is None else torch.from_numpy(v0_bar.dot(C).dot(A))


class SolveAdjoint(torch.autograd.Function):
    """(v_bar, lam_bar, active, G, Ct) -> v0_bar = v_bar + S (lam_bar - G v_bar), S = E_A G_AA^-1 E_A'."""

    @staticmethod
    def forward(v_bar: Tensor, lam_bar: Tensor | None, active: Tensor, G: Tensor, Ct: Tensor) -> Tensor:
        batch, (G, Ct), (rows, v_bar, *rest) = flatten_batch((G, Ct), (active, v_bar, lam_bar))
        return adjoint(G, Ct, rows, v_bar, rest[0]).reshape(*batch, rows.shape[-1])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, _, active, G, Ct = inputs
        ctx.save_for_backward(active, G, Ct, output)
        ctx.save_for_forward(active, G, Ct, output)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        active, G, Ct, v0_bar = ctx.saved_tensors
        need = ctx.needs_input_grad
        s = _on_active(bar, active, G, Ct)
        v_bar_bar = bar - times(G, s) if need[0] else None
        G_bar = outer(-s, v0_bar, G) if need[3] else None
        return v_bar_bar, s if need[1] else None, None, G_bar, None

    @staticmethod
    def jvp(ctx: Any, v_t: Tensor | None, lam_t: Tensor | None, _active: Any, G_t: Tensor | None, _Ct: Any) -> Tensor:
        active, G, Ct, v0_bar = ctx.saved_tensors
        v_t = torch.zeros_like(v0_bar) if v_t is None else v_t
        if G_t is not None:
            lam_t = -times(G_t, v0_bar) + (0.0 if lam_t is None else lam_t)
        if is_grads_batched(v_t) or (lam_t is not None and is_grads_batched(lam_t)):
            rhs = -times(G, v_t)
            return v_t + _on_active(rhs if lam_t is None else rhs + lam_t, active, G, Ct)
        return SolveAdjoint.apply(v_t, lam_t, active, G, Ct)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        v_bar, lam_bar, *shared = args
        lifted = lead_all((v_bar, lam_bar, *shared), in_dims, (1, 1, 1, 2, 2), info.batch_size)
        return SolveAdjoint.apply(*lifted), 0


class SolveActive(torch.autograd.Function):
    """(rhs, active, G, Ct) -> s with s_A = G_AA^-1 rhs_A, zero elsewhere: linear in rhs and its own adjoint."""

    @staticmethod
    def forward(rhs: Tensor, active: Tensor, G: Tensor, Ct: Tensor) -> Tensor:
        batch, (G, Ct), (rows, rhs) = flatten_batch((G, Ct), (active, rhs))
        return solve_active(G, Ct, rows, rhs)[0].reshape(*batch, rhs.shape[-1])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        _, active, G, Ct = inputs
        ctx.save_for_backward(active, G, Ct, output)
        ctx.save_for_forward(active, G, Ct, output)

    @staticmethod
    def backward(ctx: Any, s_bar: Tensor) -> tuple[Tensor | None, ...]:
        active, G, Ct, s = ctx.saved_tensors
        rhs_bar = _on_active(s_bar, active, G, Ct)
        G_bar = outer(-rhs_bar, s, G) if ctx.needs_input_grad[2] else None
        return rhs_bar, None, G_bar, None

    @staticmethod
    def jvp(ctx: Any, rhs_t: Tensor | None, _active: Any, G_t: Tensor | None, _Ct: Any) -> Tensor:
        active, G, Ct, s = ctx.saved_tensors
        rhs_t = torch.zeros_like(s) if rhs_t is None else rhs_t
        if G_t is not None:
            rhs_t = rhs_t - times(G_t, s)
        return _on_active(rhs_t, active, G, Ct)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Tensor) -> tuple[Tensor, int]:
        return SolveActive.apply(*lead_all(args, in_dims, (1, 1, 2, 2), info.batch_size)), 0


def _on_active(rhs: Tensor, active: Tensor, G: Tensor, Ct: Tensor) -> Tensor:
    """Return what `SolveActive` does, also for the many right-hand sides of the older `vmap`: by the inverse."""
    if not is_grads_batched(rhs):
        return SolveActive.apply(rhs, active, G, Ct)
    return times(SolveActive.apply(unit_vectors(rhs), active, G, Ct).movedim(0, -1), rhs)


# `apply` binds its arguments by the signature of `forward` at every call; finding it anew each time costs 15 us.
for _function in (SolveReduced, SolveAdjoint, SolveActive):
    setattr(_function.forward, "__signature__", inspect.signature(_function.forward))  # noqa: B010
