"""The derivative of a saddle-point solve, at a solution that is already known to full precision.

    K0 [a; m] = [top; bottom],    K0 = [Psi  rows';  rows  -D]

The rows with a compliance D of zero are equalities, the others are fits: a term 1/2 |S a - b|^2 / D of the cost, whose
multiplier (S a - b) / D stands for its slope. K0 is symmetric, so the cotangent is carried by the same solve, and a
derivative of the derivative by the same again: with (s, t) = K0^-1 (a_bar, m_bar),

    top_bar = s,   bottom_bar = t,   Psi_bar = -s a',   rows_bar = -(m s' + t a'),   D_bar = the diagonal of t m'.

The solve itself uses the triangle T of the QR of the stacked cost, Z' (Psi + S'S / D) Z = T'T, which is never factored.
A stiff fit leaves S a - b near zero, where a difference has no digits left: its multipliers follow from the slope of
the other terms instead, rows'm = top - Psi a.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..autodiff import carries_derivative, constant, refuse_forward_twice
from ..batching import lead_all

#: Multipliers of fits that loose ones move by less than this do not decide them.
OPEN = 1e-6


@dataclass(frozen=True, eq=False)
class Saddle:
    """The factors of K0, without a graph.

    Attributes:
        T, Z: `(..., n_x, n_x)` and `(..., r, n_x)`, Z a basis of the kernel of the equalities Eq.
        Eq_pinv: `(..., r, n_eq)`; the equalities are the first rows.
        pinv: pseudo-inverse of all rows, `(..., r, n_rows)`.
        loose: multipliers that no slope sees, where rows depend on each other, `(..., n_rows, n_rows)`, and
        from_fits: which of them the multipliers of the fits ask for, `(..., n_rows, n_fits)`.
        is_stiff: whether the multipliers of fits follow from the other terms, `(..., 1, 1)`.
    """

    T: Tensor
    Z: Tensor
    Eq_pinv: Tensor
    pinv: Tensor
    loose: Tensor
    from_fits: Tensor
    is_stiff: Tensor

    @staticmethod
    def of(
        T: Tensor, Z: Tensor, Eq_pinv: Tensor, rows: Tensor, units: Tensor, Psi: Tensor, D: Tensor, tolerance: float
    ) -> Saddle:
        """Make the factors.

        Args:
            T, Z, Eq_pinv: as in the class.
            rows: `(..., n_rows, r)`, and
            units: of each of them, `(..., n_rows)`.
            Psi, D: of the system.
            tolerance: singular values of the rows in units below this fraction of the largest count as zero.
        """
        n_eq, units, norm = Eq_pinv.shape[-1], units[..., None], torch.linalg.matrix_norm
        G = rows / units
        left, singular, right_h = torch.linalg.svd(G, full_matrices=False)
        # More rows than columns, or dependent ones, leave multipliers open: what is across all of the range.
        kept = singular > tolerance * singular.amax(-1, keepdim=True)
        inverse = (right_h.mT * torch.where(kept, 1 / singular, 0.0)[..., None, :]) @ left.mT
        loose = torch.eye(G.shape[-2]).to(G) - (left * kept[..., None, :]) @ left.mT
        from_fits = torch.linalg.pinv(loose[..., n_eq:, :], rtol=OPEN)
        stiffness = (units.square() / D)[..., n_eq:, :]
        by_difference = (stiffness * G[..., n_eq:, :].square().sum(-1, keepdim=True)).sum((-2, -1))
        is_stiff = (by_difference > norm(inverse) * norm(Psi))[..., None, None]
        per_unit, of_fits = inverse / units.mT, from_fits * units[..., n_eq:, :].mT
        return Saddle(T, Z, Eq_pinv, per_unit, loose / units, of_fits, is_stiff)

    def solve(self, Psi: Tensor, rows: Tensor, D: Tensor, top: Tensor, bottom: Tensor) -> Tensor:
        """Return a for right-hand sides `(..., r, k)` and `(..., n_rows, k)`."""
        n = self.Eq_pinv.shape[-1]
        S, per_D = rows[..., n:, :], 1 / D[..., n:, :]
        particular = self.Eq_pinv @ bottom[..., :n, :]
        slope = top - Psi @ particular + S.mT @ (per_D * (bottom[..., n:, :] - S @ particular))
        x = torch.linalg.solve_triangular(self.T.mT, self.Z.mT @ slope, upper=False)
        return particular + self.Z @ torch.linalg.solve_triangular(self.T, x, upper=True)

    def multipliers(self, Psi: Tensor, rows: Tensor, D: Tensor, top: Tensor, bottom: Tensor, a: Tensor) -> Tensor:
        """Return m `(..., n_rows, k)` with rows'm = top - Psi a (least squares)."""
        n = self.Eq_pinv.shape[-1]
        left, S = top - Psi @ a, rows[..., n:, :]
        fits = (S @ a - bottom[..., n:, :]) / D[..., n:, :]
        by_difference = torch.cat([self.Eq_pinv.mT @ (left - S.mT @ fits), fits], dim=-2)
        by_slope = self.pinv.mT @ left
        by_slope = by_slope + self.loose @ (self.from_fits @ (fits - by_slope[..., n:, :]))
        return torch.where(self.is_stiff, by_slope, by_difference)


def known_solution(
    Psi: Tensor, rows: Tensor, D: Tensor, top: Tensor, bottom: Tensor, a: Tensor, saddle: Saddle
) -> Tensor:
    """Return the solution `a`, computed elsewhere to full precision, with the derivative of the solve attached."""
    refuse_forward_twice()
    m = torch.zeros_like(bottom) + 0 * a[..., :1, :]
    if carries_derivative((rows, D)):  # their cotangents alone see m, which costs as much as the rest
        Psi_, rows_, D_, top_, bottom_ = map(constant, (Psi, rows, D, top, bottom))
        m = saddle.multipliers(Psi_, rows_, D_, top_, bottom_, a)
    solved, _ = _SaddleSolve.apply(Psi, rows, D, top, bottom, a, m, saddle)
    return solved


class _SaddleSolve(torch.autograd.Function):
    """Pass (a, m) through and carry the derivative; both are outputs, so that it can be derived again."""

    @staticmethod
    def forward(
        Psi: Tensor, rows: Tensor, D: Tensor, top: Tensor, bottom: Tensor, a: Tensor, m: Tensor, saddle: Saddle
    ) -> tuple[Tensor, Tensor]:
        return a.clone(), m.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        Psi, rows, D, _, _, _, _, ctx.saddle = inputs
        ctx.save_for_backward(Psi, rows, D, *output)
        ctx.save_for_forward(Psi, rows, D, *output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        Psi, rows, D, a, m = ctx.saved_tensors
        a_bar, m_bar = cotangents
        need = ctx.needs_input_grad
        # A derivative in the rows that an outer transform asks for is not among those needed here.
        moves = need[1] or need[2] or need[4] or carries_derivative((rows, D))
        with torch.no_grad():
            s = ctx.saddle.solve(Psi, rows, D, a_bar, m_bar)
            t = ctx.saddle.multipliers(Psi, rows, D, a_bar, m_bar, s) if moves else torch.zeros_like(m_bar)
        if torch.is_grad_enabled():
            s, t = _SaddleSolve.apply(Psi, rows, D, a_bar, m_bar, s, t, ctx.saddle)
        Psi_bar = (-s @ a.mT).sum_to_size(Psi.shape)
        if not moves:
            return Psi_bar, None, None, s, *(None,) * 4
        rows_bar = -(m @ s.mT + t @ a.mT).sum_to_size(rows.shape)
        D_bar = (t * m).sum(-1, keepdim=True).sum_to_size(D.shape)
        return Psi_bar, rows_bar, D_bar, s, t, *(None,) * 3

    @staticmethod
    def jvp(
        ctx: Any,
        Psi_t: Tensor | None,
        rows_t: Tensor | None,
        D_t: Tensor | None,
        top_t: Tensor | None,
        bottom_t: Tensor | None,
        *_: Any,
    ) -> tuple[Tensor, Tensor]:
        Psi, rows, D, a, m = ctx.saved_tensors
        top = torch.zeros_like(a) if top_t is None else top_t
        bottom = torch.zeros_like(m) if bottom_t is None else bottom_t
        if Psi_t is not None:
            top = top - Psi_t @ a
        if rows_t is not None:
            top, bottom = top - rows_t.mT @ m, bottom - rows_t @ a
        if D_t is not None:
            bottom = bottom + D_t * m
        with torch.no_grad():
            a_t = ctx.saddle.solve(Psi, rows, D, top, bottom)
            m_t = ctx.saddle.multipliers(Psi, rows, D, top, bottom, a_t)
        return _SaddleSolve.apply(Psi, rows, D, top, bottom, a_t, m_t, ctx.saddle)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        *tensors, saddle = args
        dims = list(in_dims[:-1])
        for place in (5, 6):  # a and m are the outputs, which are mapped whichever input is
            if dims[place] is None:
                tensors[place], dims[place] = tensors[place].expand(info.batch_size, *tensors[place].shape), 0
        mapped = lead_all(tuple(tensors), tuple(dims), (2,) * len(tensors), info.batch_size)
        return _SaddleSolve.apply(*mapped, saddle), (0, 0)
