"""The derivative of a saddle-point solve, at a solution that is already known to full precision.

    K0 [a; mu] = [top; bottom],    K0 = [Psi  Eq';  Eq  0]

K0 is symmetric, so the cotangent is carried by the same solve, and a derivative of the derivative by the same again:
with (s, t) = K0^-1 (a_bar, 0),

    top_bar = s,   bottom_bar = t,   Psi_bar = -s a',   Eq_bar = -(mu s' + t a').

The solve itself uses the triangle T of the QR of the stacked cost, Z' Psi Z = T'T, so Psi is never factored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..autodiff import carries_derivative, constant, refuse_forward_twice
from ..batching import lead_all


@dataclass(frozen=True, eq=False)
class Saddle:
    """The factors of K0: T `(..., n_x, n_x)`, Z `(r, n_x)`, Eq_pinv `(r, n_eq)`."""

    T: Tensor
    Z: Tensor
    Eq_pinv: Tensor

    def solve(self, Psi: Tensor, top: Tensor, bottom: Tensor) -> Tensor:
        """Return a for right-hand sides `(..., r, k)` and `(..., n_eq, k)`."""
        particular = self.Eq_pinv @ bottom
        rhs = self.Z.mT @ (top - Psi @ particular)
        x = torch.linalg.solve_triangular(self.T.mT, rhs, upper=False)
        return particular + self.Z @ torch.linalg.solve_triangular(self.T, x, upper=True)

    def multipliers(self, Psi: Tensor, top: Tensor, a: Tensor) -> Tensor:
        """Return mu with Eq' mu = top - Psi a (least squares)."""
        return self.Eq_pinv.mT @ (top - Psi @ a)


def known_solution(Psi: Tensor, Eq: Tensor, top: Tensor, bottom: Tensor, a: Tensor, saddle: Saddle) -> Tensor:
    """Return the solution `a`, computed elsewhere to full precision, with the derivative of the solve attached."""
    refuse_forward_twice()
    # mu is seen by the cotangent of Eq alone, and costs as much as the rest.
    mu = saddle.multipliers(constant(Psi), constant(top), a) if carries_derivative((Eq,)) else torch.zeros_like(bottom)
    solved, _ = _SaddleSolve.apply(Psi, Eq, top, bottom, a, mu, saddle.T, saddle.Z, saddle.Eq_pinv)
    return solved


class _SaddleSolve(torch.autograd.Function):
    """Pass (a, mu) through and carry the derivative; both are outputs, so that it can be derived again."""

    @staticmethod
    def forward(
        Psi: Tensor, Eq: Tensor, top: Tensor, bottom: Tensor, a: Tensor, mu: Tensor, *factors: Tensor
    ) -> tuple[Tensor, Tensor]:
        return a.clone(), mu.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        Psi, Eq, _, _, _, _, *factors = inputs
        ctx.save_for_backward(Psi, Eq, *output, *factors)
        ctx.save_for_forward(Psi, Eq, *output, *factors)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        Psi, Eq, a, mu, *factors = ctx.saved_tensors
        saddle = Saddle(*factors)
        a_bar, mu_bar = cotangents
        # A derivative in Eq that an outer transform asks for is not among those needed here.
        moves = ctx.needs_input_grad[1] or ctx.needs_input_grad[3] or carries_derivative((Eq,))
        with torch.no_grad():
            s = saddle.solve(Psi, a_bar, mu_bar)
            t = saddle.multipliers(Psi, a_bar, s) if moves else torch.zeros_like(mu_bar)
        if torch.is_grad_enabled():
            s, t = _SaddleSolve.apply(Psi, Eq, a_bar, mu_bar, s, t, *factors)
        Psi_bar = -s @ a.mT
        Eq_bar = -(mu @ s.mT + t @ a.mT).sum_to_size(Eq.shape) if moves else None
        return Psi_bar.sum_to_size(Psi.shape), Eq_bar, s, t if moves else None, *(None,) * 5

    @staticmethod
    def jvp(
        ctx: Any, Psi_t: Tensor | None, Eq_t: Tensor | None, top_t: Tensor | None, bottom_t: Tensor | None, *_: Any
    ) -> tuple[Tensor, Tensor]:
        Psi, Eq, a, mu, *factors = ctx.saved_tensors
        saddle = Saddle(*factors)
        top = torch.zeros_like(a) if top_t is None else top_t
        bottom = torch.zeros_like(mu) if bottom_t is None else bottom_t
        if Psi_t is not None:
            top = top - Psi_t @ a
        if Eq_t is not None:
            top, bottom = top - Eq_t.mT @ mu, bottom - Eq_t @ a
        with torch.no_grad():
            a_t = saddle.solve(Psi, top, bottom)
            mu_t = saddle.multipliers(Psi, top, a_t)
        return _SaddleSolve.apply(Psi, Eq, top, bottom, a_t, mu_t, *factors)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Tensor) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        tensors, dims = list(args), list(in_dims)
        for place in (4, 5):  # a and mu are the outputs, which are mapped whichever input is
            if dims[place] is None:
                tensors[place], dims[place] = tensors[place].expand(info.batch_size, *tensors[place].shape), 0
        outputs = _SaddleSolve.apply(*lead_all(tuple(tensors), tuple(dims), (2,) * len(args), info.batch_size))
        return outputs, (0, 0)
