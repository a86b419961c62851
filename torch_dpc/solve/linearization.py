"""The problem linearised at its solution, for the derivatives of :mod:`torch_dpc.solve.derivative`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..autodiff import are_transforms_active, is_grads_batched
from ..batching import flatten_batch, times
from ..errors import Status
from ..sets.blocks import Blocks
from ..sets.values import values_of
from . import kernels
from .adjoint import Adjoint, adjoint
from .outcome import joined
from .solver import Solver


def saved_by(ctx: Any) -> tuple[Tensor, ...]:
    """Return what `Plan` saved.

    Raises:
        RuntimeError: a parameter of a set has changed since.
    """
    if not ctx.sets.is_box and ctx.sets.versions() != ctx.versions:
        raise RuntimeError(
            "a parameter of a set (a bound, a radius, ...) was changed in place between the plan and its "
            "derivative: take the derivative first."
        )
    saved: tuple[Tensor, ...] = ctx.saved_tensors
    return saved


class Linearization:
    """The solution that a derivative is taken at: what `Plan` saved, and the projected system there.

    Vectors are in the order of v. For sets that are no boxes the system works in part order.
    """

    def __init__(self, ctx: Any, saved: tuple[Tensor, ...]):
        solver: Solver = ctx.solver
        self.solver, self.is_box = solver, ctx.sets.is_box
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
        self._weak, self.weak_in_parts = weak, weak[..., solver.engines.order]
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
        compiled = self._compiled_adjoint(v_bar, lam_bar) if is_final else None
        order, gamma, G = engines.order, engines.gamma, self._G_in_parts()
        v_bar, lam_bar = v_bar[..., order], None if lam_bar is None else lam_bar[..., order]
        if compiled is None:
            v0_bar = adjoint(v_bar, lam_bar, G, engines.system, self.D, is_final=is_final)
        else:
            v0_bar = compiled[..., order]
        pulled: tuple[Tensor | None, ...] = (None,) * len(need_of_sets)
        if any(need_of_sets):
            left = -times(G, v0_bar) if lam_bar is None else lam_bar - times(G, v0_bar)
            pulled = _pull(self._project(gamma), self.of_sets, v_bar - v0_bar - left / gamma)
        return v0_bar[..., engines.inverse], pulled

    def _compiled_adjoint(self, v_bar: Tensor, lam_bar: Tensor | None) -> Tensor | None:
        """Return v_bar + S (lam_bar - G v_bar) by the kernel; None if it does not know the sets or trust a system."""
        batch, inverse = self.lam.shape[:-1], self.solver.engines.inverse
        values = values_of(self.sets.with_tensors(self.of_sets), batch, self.lam.device)
        if values is None or not kernels.has_kernel_for(self.lam, values):
            return None
        rhs = -times(self.G, v_bar) if lam_bar is None else lam_bar - times(self.G, v_bar)
        _, (G,), flat = flatten_batch((self.G,), (self.v_in_parts[..., inverse], self.lam, self._weak, rhs))
        v, lam, weak, right = flat
        out, trusted = kernels.adjoint_sets(G, v, lam, weak, values, right)
        return v_bar + out.reshape(v_bar.shape) if bool(trusted.all()) else None

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
        moved = _push(self._project(gamma), self.of_sets, of_sets_t)
        moved = torch.where(self.solved, moved, 0.0)
        p = moved / gamma
        lam_t = adjoint(None, rhs - moved + times(G, p), G, engines.system, self.D) - p
        return lam_t[..., engines.inverse]

    def full_adjoint(self, v_bar: Tensor, lam_bar: Tensor | None) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        """Return the cotangents of theta and of the sets' tensors by the paper's full system."""
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
            return theta_bar, self._of_bounds(nu)
        return theta_bar, _pull(self._project(1.0), self.of_sets, nu[..., engines.order])

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


def _push(function: Callable[..., Tensor], at: list[Tensor], tangents: tuple[Tensor | None, ...]) -> Tensor:
    """Return the tangent of a function's value.

    Forward derivatives of torch.autograd do not nest, as those of torch.func do: within one the product is taken as the
    derivative of w -> (pullback of w), which is linear.
    """
    if are_transforms_active():
        whole = tuple(torch.zeros_like(s) if t is None else t for s, t in zip(at, tangents, strict=True))
        pushed: Tensor = torch.func.jvp(function, tuple(at), whole)[1]
        return pushed
    creates_graph = torch.is_grad_enabled()
    with torch.enable_grad():
        arguments = [x.view_as(x) if x.requires_grad else x.detach().requires_grad_() for x in at]
        value = function(*arguments)
        w = torch.zeros_like(value).requires_grad_()
        bars = torch.autograd.grad(value, arguments, w, create_graph=True, allow_unused=True)
        pairs = [(bar, t) for bar, t in zip(bars, tangents, strict=True) if bar is not None and t is not None]
        if not pairs:
            return torch.zeros_like(value)
        (pushed,) = torch.autograd.grad(
            [bar for bar, _ in pairs], w, [t for _, t in pairs], create_graph=creates_graph, materialize_grads=True
        )
    return pushed


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
