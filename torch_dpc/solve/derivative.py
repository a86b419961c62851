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
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..autodiff import (
    apply_function,
    carries_derivative,
    is_grads_batched,
    is_plain,
    refuse_forward_twice,
)
from ..batching import lead_all, outer, times, unit_vectors
from ..errors import Status
from ..problem.projected_kkt import FullSystem
from ..problem.reduction import Reduction
from ..sets.bounds import Bounds
from ..sets.feasible import Blocks
from ..sets.parameters import check_order
from .engines import Sets
from .outcome import Planned, joined
from .projected_system import ProjectedSystem
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
            return solver.solve(theta, sets, on_failure)  # a third of the time of a small call is the Function's
        matrices = (None, None, None)  # constants: those of the solver will do, and need not be saved
    if not sets.is_piecewise_affine:
        refuse_forward_twice()
    return Planned(*apply_function(Plan, theta, *matrices, solver, sets, on_failure, *sets.tensors))


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
            return tuple(solver.solve(theta, sets.with_tensors(of_sets), on_failure)[:5])
        with torch.no_grad():
            planned = solver.solve(theta.detach(), sets.with_tensors(x.detach() for x in of_sets), on_failure)
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
        bars = [bar for bar in (u_bar, y_bar, lam_bar, du_bar) if bar is not None]
        if not bars:
            return (None,) * len(ctx.needs_input_grad)
        need, solver = ctx.needs_input_grad, ctx.solver
        saved = ctx.saved_tensors  # once: torch's checkpoints unpack them once
        is_final = not torch.is_grad_enabled() and all(map(is_plain, bars))  # nothing will be derived again
        if is_final and solver.single is not None and solver.full is None and not (ctx.may_fail or any(need[1:])):
            active = saved[1]
            theta_bar = solver.single.adjoint(active, u_bar, y_bar, lam_bar) if active.ndim == 1 else None
            if theta_bar is not None:
                return theta_bar, *(None,) * (len(need) - 1)
        at = _At(ctx, saved)
        v_bar = joined(solver.sizes, u_bar, y_bar, du_bar, at.lam)
        if ctx.may_fail:  # samples without a solution add nothing, whatever came back for their NaN
            solved = at.solved
            v_bar = torch.where(solved, v_bar, 0.0)
            lam_bar = None if lam_bar is None else torch.where(solved, lam_bar, 0.0)
        if solver.full is not None:
            return at.full_adjoint(v_bar, lam_bar)
        v0_bar, pulled = at.adjoint(v_bar, lam_bar, is_final, need[OF_SETS:])
        a_bar = times(at.C.mT, v0_bar)
        theta_bar = times(at.A.mT, a_bar) if need[0] else None
        A_bar = outer(a_bar, at.theta, at.A) if need[1] else None
        C_bar = outer(v0_bar, times(at.A, at.theta), at.C) if need[2] else None
        G_bar = outer(-v0_bar, at.lam, at.G) if need[3] else None
        return theta_bar, A_bar, C_bar, G_bar, None, None, None, *pulled

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
        at = _At(ctx, ctx.saved_tensors)
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
        return u_t, y_t, lam_t, None, None, v_t[..., v_t.shape[-1] - ctx.solver.sizes.du :], None

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


class _At:
    """The solution that a derivative is taken at: what `Plan` saved, and the projected system there.

    Vectors are in the order of v. For sets that are no boxes the system works in part order.
    """

    def __init__(self, ctx: Any, saved: tuple[Tensor, ...]):
        solver: Solver = ctx.solver
        self.solver, self.is_box = solver, ctx.sets.is_box
        if not self.is_box and ctx.sets.versions() != ctx.versions:
            raise RuntimeError(
                "a parameter of a set (a bound, a radius, ...) was changed in place between the plan and its "
                "derivative: take the derivative first."
            )
        self.lam, active, self._info, *rest = saved
        reduction = solver.reduction
        self.A, self.C, self.G = reduction.A_theta, reduction.rows.C, reduction.G
        self.has_graph = ctx.has_matrices
        if ctx.has_matrices:
            self.theta, self.A, self.C, self.G, *rest = rest
        self.may_fail = ctx.may_fail
        self.active = active
        if self.is_box:
            self.bound_shapes = ctx.bound_shapes
            self.D: Blocks = [active]
            return
        u, y, du, weak, *self.of_sets = rest
        self.sets = ctx.sets
        v = torch.where(self.solved, joined(solver.sizes, u, y, du, self.lam), 0.0)
        # x carries the graph of v and lam: a derivative of the derivative knows how the point that is projected moves.
        self.v_in_parts, self.lam_in_parts = v[..., solver.engines.order], self.lam[..., solver.engines.order]
        self.x = self.v_in_parts + solver.engines.gamma * self.lam_in_parts
        sets = self.sets.with_tensors(self.of_sets)
        self.weak_in_parts = weak[..., solver.engines.order]
        self.D = sets.freed(sets.jacobians(self.x, solver.engines.gamma), self.weak_in_parts)

    @property
    def solved(self) -> Tensor:
        """Which samples have a solution, `(*batch, 1)`."""
        return self._info[..., :1] == Status.SOLVED

    def adjoint(
        self, v_bar: Tensor, lam_bar: Tensor | None, is_final: bool, need_of_sets: tuple[bool, ...]
    ) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        """Return v0_bar `(*batch, N)` and the cotangents of the sets' tensors."""
        engines = self.solver.engines
        if self.is_box:
            v0_bar = adjoint(v_bar, lam_bar, self.G, engines.system, self.D, is_final=is_final)
            if not any(need_of_sets):
                return v0_bar, (None, None)
            return v0_bar, self._of_bounds(v_bar - v0_bar)
        order, gamma, G = engines.order, engines.gamma, self._G_in_parts()
        v_bar, lam_bar = v_bar[..., order], None if lam_bar is None else lam_bar[..., order]
        v0_bar = adjoint(v_bar, lam_bar, G, engines.system, self.D, is_final=is_final)
        pulled: tuple[Tensor | None, ...] = (None,) * len(need_of_sets)
        if any(need_of_sets):
            left = -times(G, v0_bar) if lam_bar is None else lam_bar - times(G, v0_bar)
            pulled = _pull(self._project(gamma), self.of_sets, v_bar - v0_bar - left / gamma)
        return v0_bar[..., engines.inverse], pulled

    def tangent(self, free: Tensor, of_sets_t: tuple[Tensor | None, ...]) -> Tensor:
        """Return lam_t for a tangent of v0 - G lam at constant lam, and tangents of the sets' tensors."""
        engines, some = self.solver.engines, any(t is not None for t in of_sets_t)
        if self.is_box:
            for tangent, holds in zip(of_sets_t, (self.lam < 0, self.lam >= 0), strict=True):
                free = free if tangent is None else free - torch.where(holds, tangent, 0.0)
            return adjoint(None, free * self.solved, self.G, engines.system, self.D)
        order, gamma, G = engines.order, engines.gamma, self._G_in_parts()
        rhs = torch.where(self.solved, free, 0.0)[..., order]
        if not some:
            return adjoint(None, rhs, G, engines.system, self.D)[..., engines.inverse]
        tangents = tuple(torch.zeros_like(s) if t is None else t for s, t in zip(self.of_sets, of_sets_t, strict=True))
        moved = torch.func.jvp(self._project(gamma), tuple(self.of_sets), tangents)[1]
        moved = torch.where(self.solved, moved, 0.0)
        p = moved / gamma
        lam_t = adjoint(None, rhs - moved + times(G, p), G, engines.system, self.D) - p
        return lam_t[..., engines.inverse]

    def full_adjoint(self, v_bar: Tensor, lam_bar: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return the cotangents of all arguments of `Plan` by the paper's full system: of theta and of the sets."""
        system, engines = self.solver.full, self.solver.engines
        assert system is not None
        if self.is_box:
            D1 = self.active
        else:  # the paper's projection has gamma = 1
            self.x = self.v_in_parts + self.lam_in_parts
            sets = self.sets.with_tensors(self.of_sets)
            D1 = sets.dense(sets.freed(sets.jacobians(self.x, 1.0), self.weak_in_parts))
            D1 = D1[..., engines.inverse[:, None], engines.inverse]
        out: Tensor = Adjoint.apply(v_bar, lam_bar, self.G, system, D1)
        theta_bar, nu = out.split([out.shape[-1] - v_bar.shape[-1], v_bar.shape[-1]], dim=-1)
        if self.is_box:
            return theta_bar, *(None,) * (OF_SETS - 1), *self._of_bounds(nu)
        return theta_bar, *(None,) * (OF_SETS - 1), *_pull(self._project(1.0), self.of_sets, nu[..., engines.order])

    def _of_bounds(self, b_bar: Tensor) -> tuple[Tensor, Tensor]:
        """Return the cotangents of lower and upper for the one of the bound that each active row is held at."""
        b_bar, is_lower = torch.where(self.active, b_bar, 0.0), self.lam < 0
        lower_bar = torch.where(is_lower, b_bar, 0.0).sum_to_size(self.bound_shapes[0])
        return lower_bar, torch.where(is_lower, 0.0, b_bar).sum_to_size(self.bound_shapes[1])

    def _G_in_parts(self) -> Tensor:
        if not self.has_graph:
            return self.solver.engines.G_in_parts
        order = self.solver.engines.order
        return self.G[..., order[:, None], order]

    def _project(self, gamma: Tensor | float) -> Callable[..., Tensor]:
        """Return the projection of x as a function of the tensors that the sets are made of."""
        return lambda *of_sets: self.sets.with_tensors(of_sets).prox(self.x, gamma)


class Adjoint(torch.autograd.Function):
    """(v_bar, lam_bar, G, system, *D) -> v_bar + S (lam_bar - G v_bar); v_bar or lam_bar may be None for zero.

    With out the result, q = K'^-1 (lam_bar - G v_bar) = out - v_bar + (lam_bar - G out) / gamma, and likewise
    q_bar = K'^-1 bar = s + (bar - G s) / gamma for s = S bar:

        v_bar_bar = bar - G s,    lam_bar_bar = s,    G_bar = -s out',    D_bar = -gamma q_bar q'.
    """

    @staticmethod
    def forward(
        v_bar: Tensor | None, lam_bar: Tensor | None, G: Tensor, system: ProjectedSystem | FullSystem, *D: Tensor
    ) -> Tensor:
        return system.adjoint(v_bar, lam_bar, G, list(D))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        v_bar, lam_bar, G, ctx.system, *D = inputs
        saved = (output, G, *D) if ctx.system.sets is None else (output, G, v_bar, lam_bar, *D)
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)

    @staticmethod
    def _saved(ctx: Any) -> tuple[Tensor, Tensor, Tensor | None, list[Tensor]]:
        """Return the output, G, q, and D; q is None for boxes, whose D does not move."""
        out, G, *rest = ctx.saved_tensors
        if ctx.system.sets is None:
            return out, G, None, rest
        v_bar, lam_bar, *D = rest
        left = -times(G, out) if lam_bar is None else lam_bar - times(G, out)
        return out, G, (out if v_bar is None else out - v_bar) + left / ctx.system.gamma, D

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        ctx.system.check_second_derivative()
        out, G, q, D = Adjoint._saved(ctx)
        need, system = ctx.needs_input_grad, ctx.system
        s = adjoint(None, bar, G, system, D)
        free = bar - times(G, s)
        D_bar: list[Tensor | None] = [None] * len(D)
        if q is not None and any(need[4:]):
            D_bar = list(system.sets.outer(-system.gamma * s - free, q, D))
        G_bar = outer(-s, out, G) if need[2] else None
        return free if need[0] else None, s if need[1] else None, G_bar, None, *D_bar

    @staticmethod
    def jvp(ctx: Any, v_t: Tensor | None, lam_t: Tensor | None, G_t: Tensor | None, _: None, *D_t: Any) -> Tensor:
        ctx.system.check_second_derivative()
        out, G, q, D = Adjoint._saved(ctx)
        if G_t is not None:
            change = -times(G_t, out)
            lam_t = change if lam_t is None else lam_t + change
        if q is not None and any(t is not None for t in D_t):
            blocks = [torch.zeros_like(d) if t is None else t for d, t in zip(D, D_t, strict=True)]
            moved = ctx.system.sets.apply(blocks, q)
            v_t = -moved if v_t is None else v_t - moved
            lam_t = -ctx.system.gamma * moved if lam_t is None else lam_t - ctx.system.gamma * moved
        if v_t is None and lam_t is None:
            return torch.zeros_like(out)
        return adjoint(v_t, lam_t, G, ctx.system, D)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        v_bar, lam_bar, G, system, *D = args
        dims, tails = (*in_dims[:3], *in_dims[4:]), (1, 1, 2, *system.tails)
        present = [i for i, bar in enumerate((v_bar, lam_bar)) if bar is not None]
        places = [*present, *range(2, len(tails))]  # the first one is expanded where it is not mapped itself
        lifted: list[Any] = lead_all(
            tuple((v_bar, lam_bar, G, *D)[i] for i in places),
            tuple(dims[i] for i in places),
            tuple(tails[i] for i in places),
            info.batch_size,
        )
        bars: list[Tensor | None] = [None, None]
        for i, bar in zip(present, lifted, strict=False):
            bars[i] = bar
        G, *D = lifted[len(present) :]
        return Adjoint.apply(*bars, G, system, *D), 0


def adjoint(
    v_bar: Tensor | None,
    lam_bar: Tensor | None,
    G: Tensor,
    system: ProjectedSystem,
    D: Blocks,
    *,
    is_final: bool = False,
) -> Tensor:
    """Return what `Adjoint` does; without the Function where nothing will be derived again.

    For the many cotangents of `is_grads_batched=True`, an older `vmap` that does not look for the rules of a Function,
    S is formed as a matrix.
    """
    bars = [bar for bar in (v_bar, lam_bar) if bar is not None]
    if any(map(is_grads_batched, bars)):
        S = Adjoint.apply(None, unit_vectors(bars[0]), G, system, *D).movedim(0, -1)
        if v_bar is None:
            return times(S, bars[0])
        rhs = -times(G, v_bar)
        return v_bar + times(S, rhs if lam_bar is None else rhs + lam_bar)
    if is_final:
        return system.adjoint(v_bar, lam_bar, G, D)
    result: Tensor = Adjoint.apply(v_bar, lam_bar, G, system, *D)
    return result


def _pull(function: Callable[..., Tensor], at: list[Tensor], cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """Return the cotangents of a function's arguments; also for the many cotangents of the older `vmap`."""
    if not is_grads_batched(cotangent):
        bars: tuple[Tensor, ...] = torch.func.vjp(function, *at)[1](cotangent)
        return bars
    with torch.enable_grad():
        # Views, because one tensor may have been made of another: its cotangent would be counted twice.
        arguments = [x.view_as(x) if x.requires_grad else x.detach().requires_grad_() for x in at]
        value = function(*arguments)
    return torch.autograd.grad(value, arguments, cotangent, allow_unused=True)


# `apply` binds its arguments by the signature of `forward` at every call; finding it anew each time costs 15 us.
for _function in (Plan, Adjoint):
    setattr(_function.forward, "__signature__", inspect.signature(_function.forward))  # noqa: B010
