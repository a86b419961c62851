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
    # mu is seen by the cotangent of Eq alone, and costs as much as the rest.
    mu = saddle.multipliers(Psi.detach(), top.detach(), a) if Eq.requires_grad else torch.zeros_like(bottom)
    solved, _ = _SaddleSolve.apply(Psi, Eq, top, bottom, a, mu, saddle)
    return solved


class _SaddleSolve(torch.autograd.Function):
    """Pass (a, mu) through and carry the derivative; both are outputs, so that it can be derived again."""

    @staticmethod
    def forward(
        Psi: Tensor, Eq: Tensor, top: Tensor, bottom: Tensor, a: Tensor, mu: Tensor, saddle: Saddle
    ) -> tuple[Tensor, Tensor]:
        return a.clone(), mu.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        Psi, Eq, _, _, _, _, saddle = inputs
        ctx.save_for_backward(Psi, Eq, *output, saddle.T, saddle.Z, saddle.Eq_pinv)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        Psi, Eq, a, mu, T, Z, Eq_pinv = ctx.saved_tensors
        saddle = Saddle(T, Z, Eq_pinv)
        a_bar, mu_bar = cotangents
        moves = ctx.needs_input_grad[1] or ctx.needs_input_grad[3]
        with torch.no_grad():
            s = saddle.solve(Psi, a_bar, mu_bar)
            t = saddle.multipliers(Psi, a_bar, s) if moves else torch.zeros_like(mu_bar)
        if torch.is_grad_enabled():
            s, t = _SaddleSolve.apply(Psi, Eq, a_bar, mu_bar, s, t, saddle)
        Psi_bar = -s @ a.mT
        Eq_bar = -(mu @ s.mT + t @ a.mT).sum_to_size(Eq.shape) if moves else None
        return Psi_bar.sum_to_size(Psi.shape), Eq_bar, s, t if moves else None, None, None, None
