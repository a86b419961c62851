"""The autograd Function of the plan: one for every set.

A solution satisfies  v = v0 - G lam,  v = P(v + gamma lam),  with v0 = C A theta and P the projection onto the sets.
With D the Jacobian of P and S the operator of :mod:`torch_dpc.solve.projected_system`, a cotangent (v_bar, lam_bar)
goes back by one system:

    v0_bar = v_bar + S (lam_bar - G v_bar),      G_bar = -v0_bar lam',
    a_bar = C' v0_bar,   theta_bar = A' a_bar,   A_bar = a_bar theta',   C_bar = v0_bar (A theta)',
    set_bar = -(dP/dset)' w,                     w = v0_bar - v_bar + (lam_bar - G v0_bar) / gamma,

and a tangent goes forward by the same one, with p = (dP/dset) set_t / gamma:

    lam_t = S (v0_t - G_t lam - gamma p + G p) - p,      v_t = v0_t - G_t lam - G lam_t.

A box is the case in which D is diagonal, 0 on the active rows and 1 elsewhere. Everything in the backward is
differentiable again, the system included, so derivatives of any order come out.
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..autodiff import apply_function, carries_derivative, is_plain, refuse_forward_twice
from ..batching import lead_all, outer, times
from ..checks import is_finite
from ..errors import Status
from ..problem.reduction import Reduction
from ..problem.terms import Sizes
from ..sets.bounds import Bounds
from ..sets.parameters import check_order
from .engines import Sets
from .linearization import Linearization, saved_by
from .outcome import Planned, joined
from .solver import Solver

#: Where among the arguments of `Plan` the tensors of the sets begin.
OF_SETS = 7


def plan(solver: Solver, theta: Tensor, reduction: Reduction, sets: Sets, on_failure: str) -> Planned:
    """Solve for every theta `(*batch, n_theta)`; differentiable in theta, the reduction and the sets' tensors.

    Args:
        solver: of this reduction.
        theta: (u_ini, y_ini, u_ref, y_ref), float64.
        reduction: with its graph.
        sets: with their present parameters and their graph.
        on_failure: "raise" or "nan".

    Raises:
        ValueError: values that are not finite.
        InfeasibleError, SolveError: with `on_failure="raise"`, if a sample has no accepted solution.
    """
    matrices: tuple[Tensor | None, ...] = (reduction.A_theta, reduction.rows.C, reduction.G)
    if not carries_derivative(matrices):
        if not carries_derivative((theta, *sets.tensors)) and all(map(is_plain, (theta, *sets.tensors))):
            return _solve(solver, theta, sets, on_failure)  # a third of the time of a small call is the Function's
        matrices = (None, None, None)  # constants: those of the solver will do, and need not be saved
    if not sets.is_piecewise_affine:
        refuse_forward_twice()
    return Planned(*apply_function(Plan, theta, *matrices, solver, sets, on_failure, *sets.tensors))


def _solve(solver: Solver, theta: Tensor, sets: Sets, on_failure: str) -> Planned:
    """Solve without a graph.

    With `on_failure="nan"` a value that is not finite marks its sample of a batch as failed; where it spoils every
    sample, as in a reference that all share, it is an error all the same.
    """
    if on_failure == "raise" or theta.ndim == 1 or is_finite(theta):
        return solver.solve(theta, sets, on_failure)
    spoilt = ~theta.isfinite().all(-1)
    if bool(spoilt.all()):
        return solver.solve(theta, sets, on_failure)
    return solver.solve(torch.where(spoilt[..., None], 0.0, theta), sets, on_failure).without(spoilt)


class Plan(torch.autograd.Function):
    """(theta, A, C, G, solver, sets, on_failure, *tensors of the sets) -> the fields of `Planned`.

    A, C and G are None if no derivative is asked of them; their values are always those of the solver.
    """

    @staticmethod
    def forward(
        theta: Tensor,
        A: Tensor | None,
        C: Tensor | None,
        G: Tensor | None,
        solver: Solver,
        sets: Sets,
        on_failure: str,
        *of_sets: Tensor,
    ) -> tuple[Tensor, ...]:
        if sets.is_box:
            return tuple(_solve(solver, theta, sets.with_tensors(of_sets), on_failure)[:5])
        with torch.no_grad():
            constants = [x.detach() if x.requires_grad else x for x in of_sets]
            planned = _solve(solver, theta.detach(), sets.with_tensors(constants), on_failure)
        return tuple(x for x in planned if x is not None)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        theta, A, C, G, ctx.solver, ctx.sets, on_failure, *of_sets = inputs
        u, y, lam, active, info, *of_curved = output
        ctx.mark_non_differentiable(active, info, *of_curved[1:])
        ctx.set_materialize_grads(False)
        ctx.may_fail = on_failure != "raise"
        ctx.has_matrices = A is not None
        saved = (lam, active, info) if A is None else (lam, active, info, theta, A, C, G)
        if of_curved:
            ctx.versions = ctx.sets.versions()
            saved = (*saved, u, y, *of_curved, *of_sets)
        else:
            ctx.bound_shapes = [bound.shape for bound in of_sets]
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)

    @staticmethod
    def backward(
        ctx: Any,
        u_bar: Tensor | None,
        y_bar: Tensor | None,
        lam_bar: Tensor | None,
        _active: None,
        _info: None,
        du_bar: Tensor | None = None,
        _weak: None = None,
    ) -> tuple[Tensor | None, ...]:
        return pulled_back(ctx, (u_bar, y_bar, lam_bar, du_bar), ctx.needs_input_grad)

    @staticmethod
    def jvp(
        ctx: Any,
        theta_t: Tensor | None,
        A_t: Tensor | None,
        C_t: Tensor | None,
        G_t: Tensor | None,
        _solver: None,
        _sets: None,
        _on_failure: None,
        *of_sets_t: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        at = Linearization(ctx, saved_by(ctx))
        free = torch.zeros_like(at.lam)
        if theta_t is not None:
            free = free + times(at.C, times(at.A, theta_t))
        if A_t is not None:
            free = free + times(at.C, times(A_t, at.theta))
        if C_t is not None:
            free = free + times(C_t, times(at.A, at.theta))
        if G_t is not None:
            free = free - times(G_t, at.lam)
        lam_t = at.tangent(free, of_sets_t)
        v_t = torch.where(at.solved, free - times(at.G, lam_t), 0.0)
        u_t, y_t = ctx.solver.sizes.split(v_t)
        if at.is_box:
            return u_t, y_t, lam_t, None, None
        return u_t, y_t, lam_t, None, None, v_t[..., v_t.shape[-1] - ctx.solver.sizes.more :], None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        theta, A, C, G, solver, sets, on_failure, *of_sets = args
        of_sets_dims = in_dims[OF_SETS:]
        if any(dim is not None for dim in in_dims[1:4]):
            raise NotImplementedError(
                "vmap over weights or data is not supported: give the layer weights with a leading batch dimension, "
                "which share one batched factorisation."
            )
        tensors: list[Any]
        if isinstance(sets, Bounds):
            mapped = in_dims[0], *of_sets_dims
            tensors = list(lead_all((theta, *of_sets), mapped, (1, 1, 1), info.batch_size))
            if any(dim is not None for dim in of_sets_dims):
                check_order(tensors[1], tensors[2])  # the box could not look at them
        else:  # the parameters of other sets are not mapped: `FeasibleSet.check_values` refuses that
            tensors = [*lead_all((theta,), in_dims[:1], (1,), info.batch_size), *of_sets]
        outputs = Plan.apply(tensors[0], A, C, G, solver, sets, on_failure, *tensors[1:])
        return outputs, (0,) * len(outputs)


def pulled_back(ctx: Any, bars: tuple[Tensor | None, ...], need: tuple[bool, ...]) -> tuple[Tensor | None, ...]:
    """Return the cotangents of the arguments of `Plan`.

    Args:
        ctx: what `Plan.setup_context` leaves.
        bars: cotangents of u, y, lam and du, each of which may be None.
        need: which of the arguments need one.
    """
    given = [bar for bar in bars if bar is not None]
    if not given:
        return (None,) * len(need)
    u_bar, y_bar, lam_bar, du_bar = bars
    solver = ctx.solver
    is_final = not torch.is_grad_enabled() and all(map(is_plain, given))  # nothing will be derived again
    saved = saved_by(ctx)  # once: checkpoints of the graph refuse a second look
    if is_final and solver.full is None and not (ctx.has_matrices or any(need[1:])):
        theta_bar = _compiled_adjoint(ctx, saved, u_bar, y_bar, lam_bar, du_bar)
        if theta_bar is not None:
            return theta_bar, *(None,) * (len(need) - 1)
    at = Linearization(ctx, saved)
    v_bar = joined(solver.sizes, u_bar, y_bar, du_bar, at.lam)
    if ctx.may_fail:  # samples without a solution add nothing, whatever came back for their NaN
        solved = at.solved
        v_bar = torch.where(solved, v_bar, 0.0)
        lam_bar = None if lam_bar is None else torch.where(solved, lam_bar, 0.0)
    if solver.full is not None:
        theta_bar, pulled = at.full_adjoint(v_bar, lam_bar)
        return theta_bar, *(None,) * (OF_SETS - 1), *pulled
    v0_bar, pulled = at.adjoint(v_bar, lam_bar, is_final, need[OF_SETS:])
    a_bar = times(at.C.mT, v0_bar)
    theta_bar = times(at.A.mT, a_bar) if need[0] else None
    A_bar = outer(a_bar, at.theta, at.A) if need[1] else None
    C_bar = outer(v0_bar, times(at.A, at.theta), at.C) if need[2] else None
    G_bar = outer(-v0_bar, at.lam, at.G) if need[3] else None
    return theta_bar, A_bar, C_bar, G_bar, None, None, None, *pulled


def _compiled_adjoint(
    ctx: Any,
    saved: tuple[Tensor, ...],
    u_bar: Tensor | None,
    y_bar: Tensor | None,
    lam_bar: Tensor | None,
    du_bar: Tensor | None,
) -> Tensor | None:
    """Return theta_bar by the compiled kernel; None if it does not take the sets, or does not trust its system."""
    planner, sizes = ctx.solver.compiled, ctx.solver.sizes
    if planner is None:
        return None
    lam, active, info, *of_curved = saved
    v, weak = lam, active  # for boxes they do not count
    if not ctx.sets.is_box:
        u, y, du, weak, *_ = of_curved
        v = joined(sizes, u, y, du, lam)
    v_bar = _as_rows(sizes, u_bar, y_bar, du_bar, lam.shape)
    if ctx.may_fail:  # samples without a solution add nothing, whatever came back for their NaN
        solved = info[..., :1] == Status.SOLVED
        v_bar, v = np.where(solved.numpy(), v_bar, 0.0), torch.where(solved, v, 0.0)
        lam_bar = None if lam_bar is None else torch.where(solved, lam_bar, 0.0)
    return planner.adjoint(ctx.sets, (v, lam, active, weak), v_bar, lam_bar)


def _as_rows(
    sizes: Sizes, u_bar: Tensor | None, y_bar: Tensor | None, du_bar: Tensor | None, shape: torch.Size
) -> np.ndarray:
    """Return the cotangents of u, y and du as one of v, an array `(*batch, N)`; zero for None."""
    v_bar, start = np.zeros(shape), 0
    for bar, size in ((u_bar, sizes.u), (y_bar, sizes.y), (du_bar, sizes.more)):
        if bar is not None and size:
            v_bar[..., start : start + size] = bar.numpy().reshape(*shape[:-1], size)
        start += size
    return v_bar


# `apply` binds its arguments by the signature of `forward` at every call; finding it anew each time costs 15 us.
setattr(Plan.forward, "__signature__", inspect.signature(Plan.forward))  # noqa: B010
