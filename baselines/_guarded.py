"""Run a peer's own graph under a process-wide setting that its forward or its backward needs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Guard = Callable[[], contextlib.AbstractContextManager[None]]


class Guarded(torch.autograd.Function):
    """(guard, run, *inputs) -> run(*inputs), with run and its backward inside guard().

    `run` always sees inputs that require a gradient, so that peers which tell their multipliers and status through the
    graph alone tell them here too. Its graph is kept by `ctx`; the backward can run any number of times.
    """

    @staticmethod
    def forward(ctx: Any, guard: Guard, run: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
        with torch.enable_grad(), guard():
            leaves = [x.detach().requires_grad_(x.numel() > 0) for x in inputs]
            out = run(*leaves)
        ctx.guard, ctx.inner = guard, (out, leaves)
        return out.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        out, leaves = ctx.inner
        wanted = [leaf for leaf in leaves if leaf.requires_grad]
        with ctx.guard():
            grads = iter(torch.autograd.grad(out, wanted, bar, retain_graph=True))
        return None, None, *(next(grads) if leaf.requires_grad else None for leaf in leaves)


@contextlib.contextmanager
def double_default() -> Iterator[None]:
    """Make float64 torch's default dtype for a while."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
