"""The projected Karush-Kuhn-Tucker system of any convex set, after the reduction, and its derivative.

A solution satisfies  v = v0 - G lam,  v = P(v + gamma lam),  P the projection onto the set (the proximal map of a
penalty). With D the Jacobian of P there,

    K dlam = (I - D) (dv0 - dG lam) - dP,      K = (I - D) G + gamma D,

dP what the parameters of the set do to P. K becomes symmetric and positive definite in the eigenvectors of D: where an
eigenvalue d is 1 the multiplier is free of the others, and on the remaining directions A

    (G_AA + diag kappa) y = right-hand side,      kappa = gamma d / (1 - d),

is the active system of a box (kappa = 0) with the curvature of the set's boundary added.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..autodiff import is_grads_batched
from ..batching import lead_all, outer, times, unit_vectors
from ..sets.feasible import Blocks, FeasibleSet

#: Directions whose eigenvalue of D is within this of 1 are free.
FREE = 1e-12
#: A Cholesky factor is trusted where every pivot is above this fraction of its diagonal entry; a pseudo-inverse that
#: drops singular values below the second number takes the others.
TRUSTED, DEPENDENT = 1e-10, 1e-13


def solve_system(
    G: Tensor, sets: FeasibleSet, blocks: Blocks, rhs: Tensor, gamma: Tensor, *, transposed: bool = False
) -> tuple[Tensor, Tensor]:
    """Return K^-1 rhs, or K'^-1 rhs, `(..., N)`, and whether K was nonsingular, `(...)`; minimum norm where it was not.

    Args:
        G: `(N, N)`, or one a sample.
        sets: the structure of D.
        blocks: D.
        rhs: `(..., N)`.
        gamma: the scale of the multipliers, `(N,)`, equal within each block.
        transposed: solve with K'.
    """
    d, vectors = sets.spectral(blocks)
    b = sets.rotate(vectors, rhs)
    held = d < 1 - FREE
    rows = held.reshape(-1, held.shape[-1]).any(0).nonzero()[:, 0]
    turned = sets.rotate_matrix(vectors, G)
    free = torch.where(held, 0.0, b / gamma)  # gamma is one number in each block, so that it needs no turning
    if len(rows) == 0:
        return sets.rotate(vectors, free, back=True), torch.ones(b.shape[:-1], dtype=torch.bool, device=b.device)
    on = held[..., rows]
    lack = torch.where(on, 1 - d[..., rows], 1.0)
    curvature = torch.where(on, gamma[rows] * d[..., rows] / lack, 1.0)
    # D has the dimensions of the samples; those that rhs has before them are many right-hand sides of one system.
    matrix = turned[..., rows[:, None], rows] * (on[..., :, None] & on[..., None, :]) + torch.diag_embed(curvature)
    right = b[..., rows] if transposed else b[..., rows] / lack - times(turned[..., rows, :], free)
    y, regular = _symmetric_solve(matrix, torch.where(on, right, 0.0))
    x = free.clone()
    if transposed:
        whole = torch.zeros_like(x)
        whole[..., rows] = y
        x = torch.where(held, x, (b - times(turned, whole)) / gamma)
        x[..., rows] = torch.where(on, y / lack, x[..., rows])
    else:
        x[..., rows] = torch.where(on, y, x[..., rows])
    return sets.rotate(vectors, x, back=True), regular


def _symmetric_solve(matrix: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Solve positive semidefinite systems `(..., k, k)`; say which were nonsingular, `(...)`.

    Dimensions that rhs `(..., k)` has before those of the matrices are many right-hand sides of each.
    """
    batch, k = rhs.shape[:-1], rhs.shape[-1]
    own = batch[len(batch) - (matrix.ndim - 2) :]
    flat = matrix.expand(*own, k, k).reshape(-1, k, k)
    many = batch[: len(batch) - len(own)].numel()
    right = rhs.reshape(many, len(flat), k).permute(1, 2, 0)  # (systems, k, right-hand sides)
    scale = flat.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(flat.dtype).tiny).rsqrt()[..., None]
    unit = flat * scale * scale.mT
    L, info = torch.linalg.cholesky_ex(unit)
    y = torch.cholesky_solve(right * scale, L) * scale
    regular = (info == 0) & (L.diagonal(dim1=-2, dim2=-1).square().amin(-1) > TRUSTED)
    bad = (~regular).nonzero()[:, 0]
    if len(bad):
        inverse = torch.linalg.pinv(unit[bad], hermitian=True, rtol=DEPENDENT)
        y[bad] = inverse @ (right[bad] * scale[bad]) * scale[bad]
    return y.permute(2, 0, 1).reshape(*batch, k), regular.reshape(own).expand(batch)


class SolveSystem(torch.autograd.Function):
    """(rhs, G, sets, gamma, transposed, *D) -> K^-1 rhs or K'^-1 rhs, differentiable in rhs, G and D, again and again.

    With x = K^-1 rhs and s = K'^-1 x_bar:  rhs_bar = s,  K_bar = -s x',  and so D_bar = s (G x - gamma x)',
    G_bar = -((I - D) s) x'. For K' the roles of x and s are exchanged in K_bar.
    """

    @staticmethod
    def forward(rhs: Tensor, G: Tensor, sets: FeasibleSet, gamma: Tensor, transposed: bool, *blocks: Tensor) -> Tensor:
        return solve_system(G, sets, list(blocks), rhs, gamma, transposed=transposed)[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, G, ctx.sets, ctx.gamma, ctx.transposed, *blocks = inputs
        ctx.save_for_backward(output, G, *blocks)
        ctx.save_for_forward(output, G, *blocks)

    @staticmethod
    def backward(ctx: Any, x_bar: Tensor) -> tuple[Tensor | None, ...]:
        x, G, *blocks = ctx.saved_tensors
        sets, gamma = ctx.sets, ctx.gamma
        s = _solve(x_bar, G, sets, gamma, not ctx.transposed, blocks)
        left, right = (x, s) if ctx.transposed else (s, x)  # K_bar = -left right'
        G_bar = outer(sets.apply(blocks, left) - left, right, G) if ctx.needs_input_grad[1] else None
        D_bar: Blocks = [None] * len(blocks)  # type: ignore[list-item]
        if any(ctx.needs_input_grad[5:]):
            D_bar = sets.outer(left, times(G, right) - gamma * right, blocks)
        return s, G_bar, None, None, None, *D_bar

    @staticmethod
    def jvp(ctx: Any, rhs_t: Tensor | None, G_t: Tensor | None, *rest: Any) -> Tensor:
        x, G, *blocks = ctx.saved_tensors
        sets, gamma, transposed = ctx.sets, ctx.gamma, ctx.transposed
        change = torch.zeros_like(x) if rhs_t is None else rhs_t
        if G_t is not None:  # dK = (I - D) dG
            moved = x - sets.apply(blocks, x) if transposed else times(G_t, x)
            change = change - (times(G_t, moved) if transposed else moved - sets.apply(blocks, moved))
        D_t = [torch.zeros_like(D) if t is None else t for D, t in zip(blocks, rest[3:], strict=True)]
        if any(t is not None for t in rest[3:]):  # dK = -dD G + gamma dD
            if transposed:
                moved = sets.apply(D_t, x)
                change = change - (gamma * moved - times(G, moved))
            else:
                change = change - sets.apply(D_t, gamma * x - times(G, x))
        return _solve(change, G, sets, gamma, transposed, blocks)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        rhs, G, sets, gamma, transposed, *blocks = args
        dims = (in_dims[0], in_dims[1], *in_dims[5:])
        tails = (1, 2, *(sets.tails))
        rhs, G, *blocks = lead_all((rhs, G, *blocks), dims, tails, info.batch_size)
        return SolveSystem.apply(rhs, G, sets, gamma, transposed, *blocks), 0


def _solve(rhs: Tensor, G: Tensor, sets: FeasibleSet, gamma: Tensor, transposed: bool, blocks: Blocks) -> Tensor:
    """Return what `SolveSystem` does, also for the many right-hand sides of the older `vmap`: by the inverse."""
    if not is_grads_batched(rhs):
        return SolveSystem.apply(rhs, G, sets, gamma, transposed, *blocks)
    columns = SolveSystem.apply(unit_vectors(rhs), G, sets, gamma, transposed, *blocks)
    return times(columns.movedim(0, -1), rhs)


class Implicit(torch.autograd.Function):
    """(v0, G, v, lam, solved, weak, sets, gamma, *sets.tensors) -> v, lam at a solution found elsewhere.

    A cotangent (v_bar, lam_bar) goes back by  w = K'^-1 (lam_bar - G v_bar):

        v0_bar = v_bar + (I - D) w,     G_bar = -v0_bar lam',     set_bar = -(dP/dset)' w at x = v + gamma lam,

    for the tensors that the sets are made of. All of it is computed from the outputs, which carry the graph that leads
    here, so that a derivative of the derivative knows how x moves.
    """

    @staticmethod
    def forward(
        v0: Tensor, G: Tensor, v: Tensor, lam: Tensor, solved: Tensor, weak: Tensor, sets: FeasibleSet,
        gamma: Tensor, *of_sets: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        return torch.where(solved, v, torch.nan), lam.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        _, G, _, _, solved, weak, ctx.sets, ctx.gamma, *of_sets = inputs
        ctx.versions = ctx.sets.versions()
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*output, G, solved, weak, *of_sets)
        ctx.save_for_forward(*output, G, solved, weak, *of_sets)

    @staticmethod
    def _saved(ctx: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, list[Tensor], Blocks]:
        """Return x, lam, G, which samples have a solution, the tensors of the sets, and D at x."""
        if ctx.sets.versions() != ctx.versions:
            raise RuntimeError(
                "a parameter of a set (a bound, a radius, ...) was changed in place between the plan and its "
                "derivative: take the derivative first."
            )
        v, lam, G, solved, weak, *of_sets = ctx.saved_tensors
        sets = ctx.sets.with_tensors(of_sets)
        x = torch.where(solved, v, 0.0) + ctx.gamma * lam
        return x, lam, G, solved, of_sets, sets.freed(sets.jacobians(x, ctx.gamma), weak)

    @staticmethod
    def _project(ctx: Any, x: Tensor) -> Callable[..., Tensor]:
        """Return the projection of x as a function of the tensors that the sets are made of."""
        return lambda *of_sets: ctx.sets.with_tensors(of_sets).prox(x, ctx.gamma)

    @staticmethod
    def backward(ctx: Any, v_bar: Tensor | None, lam_bar: Tensor | None) -> tuple[Tensor | None, ...]:
        if v_bar is None and lam_bar is None:
            return (None,) * len(ctx.needs_input_grad)
        x, lam, G, solved, of_sets, blocks = Implicit._saved(ctx)
        # Samples without a solution add nothing, whatever came back for their NaN.
        v_bar = torch.zeros_like(lam) if v_bar is None else torch.where(solved, v_bar, 0.0)
        rhs = -times(G, v_bar)
        rhs = rhs if lam_bar is None else rhs + torch.where(solved, lam_bar, 0.0)
        w = _solve(rhs, G, ctx.sets, ctx.gamma, True, blocks)
        v0_bar = v_bar + w - ctx.sets.apply(blocks, w)
        G_bar = outer(-v0_bar, lam, G) if ctx.needs_input_grad[1] else None
        of_sets_bar: tuple[Tensor | None, ...] = (None,) * len(of_sets)
        if any(ctx.needs_input_grad[SET_TENSORS:]):
            of_sets_bar = _pull(Implicit._project(ctx, x), of_sets, -w)
        return v0_bar, G_bar, *(None,) * (SET_TENSORS - 2), *of_sets_bar

    @staticmethod
    def jvp(ctx: Any, v0_t: Tensor | None, G_t: Tensor | None, *rest: Any) -> tuple[Tensor, Tensor]:
        x, lam, G, solved, of_sets, blocks = Implicit._saved(ctx)
        free = torch.zeros_like(lam) if v0_t is None else v0_t
        if G_t is not None:
            free = free - times(G_t, lam)
        rhs = free - ctx.sets.apply(blocks, free)
        of_sets_t = rest[SET_TENSORS - 2 :]
        if any(t is not None for t in of_sets_t):
            tangents = tuple(torch.zeros_like(s) if t is None else t for s, t in zip(of_sets, of_sets_t, strict=True))
            rhs = rhs - torch.func.jvp(Implicit._project(ctx, x), tuple(of_sets), tangents)[1]
        lam_t = _solve(torch.where(solved, rhs, 0.0), G, ctx.sets, ctx.gamma, False, blocks)
        return torch.where(solved, free - times(G, lam_t), 0.0), lam_t

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        lifted = lead_all(args[:6], in_dims[:6], (1, 2, 1, 1, 1, 1), info.batch_size)
        outputs = Implicit.apply(*lifted, *args[6:])
        return outputs, (0,) * len(outputs)


#: Where among the arguments of `Implicit` the tensors of the sets begin.
SET_TENSORS = 8


def _pull(function: Callable[..., Tensor], at: list[Tensor], cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """Return the cotangents of a function's arguments; also for the many cotangents of the older `vmap`."""
    if not is_grads_batched(cotangent):
        bars: tuple[Tensor, ...] = torch.func.vjp(function, *at)[1](cotangent)
        return bars
    with torch.enable_grad():
        # Views: one tensor may have been made of another, and what reaches it is not to be counted twice.
        arguments = [x.view_as(x) if x.requires_grad else x.detach().requires_grad_() for x in at]
        value = function(*arguments)
    return torch.autograd.grad(value, arguments, cotangent, allow_unused=True)


# `apply` binds its arguments by the signature of `forward` at every call; finding it anew each time costs 15 us.
for _function in (SolveSystem, Implicit):
    setattr(_function.forward, "__signature__", inspect.signature(_function.forward))  # noqa: B010
