"""The autograd Function of the reduced problem.

At a solution  v = v0 - G lam,  v0 = V theta,  with A the active rows and b their bounds,

    lam_A = G_AA^-1 (v0 - b)_A,    lam = 0 elsewhere,

the projected Karush-Kuhn-Tucker system of the paper after the reduction. A cotangent (v_bar, lam_bar) goes back by
one system with the same symmetric matrix:

    s_A = G_AA^-1 (lam_bar - G v_bar)_A,     v0_bar = v_bar + s,     b_bar = -s,     G_bar = -v0_bar lam',
    theta_bar = V' v0_bar,                   V_bar = v0_bar theta'.

Everything in the backward is differentiable again, the system included, so derivatives of any order come out.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .active_set import solve_active
from .errors import Status
from .linear import outer, times
from .solve import Solver


class SolveReduced(torch.autograd.Function):
    """(theta, V, G, Ct, lower, upper) -> v, lam, active, info, as `Solved` describes them."""

    @staticmethod
    def forward(
        theta: Tensor, V: Tensor, G: Tensor, Ct: Tensor, lower: Tensor, upper: Tensor, solver: Solver
    ) -> tuple[Tensor, ...]:
        batch = theta.shape[:-1]

        def flat(x: Tensor, tail: int) -> Tensor:
            # Shared matrices and bounds stay shared; others get one leading dimension, as theta does.
            return x if x.ndim == tail else x.expand(*batch, *x.shape[-tail:]).reshape(-1, *x.shape[-tail:])

        solved = solver.solve(theta.reshape(-1, theta.shape[-1]), flat(lower, 1), flat(upper, 1), batch)
        return tuple(x.reshape((*batch, *x.shape[1:])) for x in solved)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        theta, V, G, Ct, lower, upper, _ = inputs
        _, lam, active, info = output
        ctx.mark_non_differentiable(active, info)
        ctx.set_materialize_grads(False)
        saved = (theta, V, G, Ct, lower, upper, lam, active, info)
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)

    @staticmethod
    def backward(ctx: Any, v_bar: Tensor | None, lam_bar: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
        theta, V, G, Ct, lower, upper, lam, active, info = ctx.saved_tensors
        if v_bar is None and lam_bar is None:
            return (None,) * 7
        failed = info[..., :1] != Status.SOLVED
        v_bar = torch.zeros_like(lam) if v_bar is None else torch.where(failed, 0.0, v_bar)
        rhs = -times(G, v_bar)
        if lam_bar is not None:
            rhs = rhs + torch.where(failed, 0.0, lam_bar)
        s = SolveActive.apply(rhs, active, G, Ct)
        v0_bar = v_bar + s
        need = ctx.needs_input_grad
        theta_bar = times(V.mT, v0_bar) if need[0] else None
        V_bar = outer(v0_bar, theta, V) if need[1] else None
        G_bar = outer(-v0_bar, lam, G) if need[2] else None
        lower_bar = torch.where(lam < 0, -s, 0.0).sum_to_size(lower.shape) if need[4] else None
        upper_bar = torch.where(lam < 0, 0.0, -s).sum_to_size(upper.shape) if need[5] else None
        return theta_bar, V_bar, G_bar, None, lower_bar, upper_bar, None

    @staticmethod
    def jvp(
        ctx: Any,
        theta_t: Tensor | None,
        V_t: Tensor | None,
        G_t: Tensor | None,
        _Ct: Any,
        lower_t: Tensor | None,
        upper_t: Tensor | None,
        _solver: Any,
    ) -> tuple[Tensor | None, ...]:
        theta, V, G, Ct, lower, upper, lam, active, info = ctx.saved_tensors
        solved = info[..., :1] == Status.SOLVED
        free = torch.zeros_like(lam)
        if theta_t is not None:
            free = free + times(V, theta_t)
        if V_t is not None:
            free = free + times(V_t, theta)
        if G_t is not None:
            free = free - times(G_t, lam)
        rhs = free
        if lower_t is not None:
            rhs = rhs - torch.where(lam < 0, lower_t, 0.0)
        if upper_t is not None:
            rhs = rhs - torch.where(lam < 0, 0.0, upper_t)
        lam_t = SolveActive.apply(rhs * solved, active, G, Ct)
        return (torch.where(solved, free - times(G, lam_t), 0.0), lam_t, None, None)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        theta, V, G, Ct, lower, upper, solver = args
        if any(dim is not None for dim in in_dims[1:4]):
            raise NotImplementedError(
                "vmap over weights or data is not supported: give the layer weights with a leading batch dimension, "
                "which share one batched factorisation."
            )
        theta = _lead(theta, in_dims[0], info.batch_size, None, 1)
        depth = theta.ndim - 1
        lower = _lead(lower, in_dims[4], None, depth, 1)
        upper = _lead(upper, in_dims[5], None, depth, 1)
        outputs = SolveReduced.apply(theta, V, G, Ct, lower, upper, solver)
        return outputs, (0,) * len(outputs)


class SolveActive(torch.autograd.Function):
    """(rhs, active, G, Ct) -> s with s_A = G_AA^-1 rhs_A and zero elsewhere: linear in rhs, symmetric, its own adjoint."""

    @staticmethod
    def forward(rhs: Tensor, active: Tensor, G: Tensor, Ct: Tensor) -> Tensor:
        n = rhs.shape[-1]
        batch = rhs.shape[:-1]

        def flat(x: Tensor) -> Tensor:
            return x if x.ndim == 2 else x.expand(*batch, *x.shape[-2:]).reshape(-1, *x.shape[-2:])

        rows = active.expand(*batch, n).reshape(-1, n)
        s, _ = solve_active(flat(G), flat(Ct), rows, rhs.reshape(-1, n))
        return s.reshape(rhs.shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        _, active, G, Ct = inputs
        ctx.save_for_backward(active, G, Ct, output)
        ctx.save_for_forward(active, G, Ct, output)

    @staticmethod
    def backward(ctx: Any, s_bar: Tensor) -> tuple[Tensor | None, ...]:
        active, G, Ct, s = ctx.saved_tensors
        rhs_bar = SolveActive.apply(s_bar, active, G, Ct)
        G_bar = outer(-rhs_bar, s, G) if ctx.needs_input_grad[2] else None
        return rhs_bar, None, G_bar, None

    @staticmethod
    def jvp(ctx: Any, rhs_t: Tensor | None, _active: Any, G_t: Tensor | None, _Ct: Any) -> Tensor:
        active, G, Ct, s = ctx.saved_tensors
        rhs_t = torch.zeros_like(s) if rhs_t is None else rhs_t
        if G_t is not None:
            rhs_t = rhs_t - times(G_t, s)
        return SolveActive.apply(rhs_t, active, G, Ct)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Tensor) -> tuple[Tensor, int]:
        rhs, active, G, Ct = args
        depth = max(
            x.ndim - (dim is not None) - 1 for x, dim in ((rhs, in_dims[0]), (active, in_dims[1]))
        )  # batch dimensions without the mapped one
        rhs = _lead(rhs, in_dims[0], info.batch_size, depth + 1, 1)
        active = _lead(active, in_dims[1], None, depth + 1, 1)
        G = _lead(G, in_dims[2], None, depth + 1, 2)
        Ct = _lead(Ct, in_dims[3], None, depth + 1, 2)
        return SolveActive.apply(rhs, active, G, Ct), 0


def _lead(x: Tensor, dim: int | None, size: int | None, depth: int | None, tail: int) -> Tensor:
    """Bring a mapped dimension to the front, ahead of `depth - 1` batch dimensions and `tail` of its own.

    A tensor that is not mapped broadcasts as it is, or is expanded to `size` where one is given.
    """
    if dim is None:
        return x if size is None else x.expand(size, *x.shape)
    x = x.movedim(dim, 0)
    missing = 0 if depth is None else depth + tail - x.ndim
    return x.reshape(x.shape[0], *(1,) * missing, *x.shape[1:])
