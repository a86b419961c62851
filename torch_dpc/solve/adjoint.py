"""The linear system at a solution as an autograd Function, differentiable again and again."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from ..autodiff import is_grads_batched
from ..batching import lead_all, outer, times, unit_vectors
from ..problem.projected_kkt import FullSystem
from ..sets.blocks import Blocks
from .projected_system import ProjectedSystem


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


# See `derivative.py`.
setattr(Adjoint.forward, "__signature__", inspect.signature(Adjoint.forward))  # noqa: B010
