"""Whether double precision vouches for the cost of a plan: a bound from a few products with matrices.

A plan v with multipliers lam has the coefficients a = A_theta theta - A_lam lam. It may cost more than the optimum,

- because v is not quite C a, which is worth |lam|'|v - C a|,
- because Eq a is not quite e, which is worth as much with the multipliers of the equalities,
- because a slope s of the Lagrangian is left at a, which is worth 1/2 |T^-T Z's|^2.

Where these are not next to nothing beside the cost, the plan is proven in extended precision
(:mod:`torch_dpc.solve.proof`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..batching import times
from ..problem.least_squares import gram_of_charged
from ..problem.reduction import Reduction
from ..problem.weights import psd_root
from ..shapes import broadcast_shapes
from .consistency import negligible_cost

#: What is next to nothing, as a share of the cost.
SHARE = 3e-8
#: A plan may be off its coefficients by this, relative to each channel: a ball projects to the accuracy of its largest.
FITS = 1e-9


@dataclass(frozen=True, eq=False)
class Screen:
    """The screen of one reduction, in the caller's units, without a graph.

    Attributes:
        reduction: of the problem.
        E, target: the cost is 1/2 |E a - target theta|^2.
        worth: T^-T Z'.
        negligible: a cost that is nothing.
    """

    reduction: Reduction
    E: Tensor
    target: Tensor
    worth: Tensor
    negligible: Tensor

    @staticmethod
    def of(reduction: Reduction) -> Screen:
        """Make the matrices of one reduction."""
        rows, weights = reduction.rows, reduction.weights
        root_g = (2 * weights.lambda_g).sqrt()[..., None, None]
        parts: list[tuple[Tensor, Tensor, int | None]] = [(root_g * gram_of_charged(rows), root_g, None)]
        for term in rows.tracking:
            if (weight := getattr(weights, term.weight)) is not None:
                root = psd_root(weight, term.channels)
                parts.append((root @ rows.C[..., term.rows, :], root, term.reference))
        for fit in rows.fits:
            root = (2 * getattr(weights, fit.weight)).sqrt()[..., None, None]
            parts.append((root * fit.rows, root * torch.eye(fit.rows.shape[-2]).to(fit.rows), fit.measured))
        batch = broadcast_shapes(*(block.shape[:-2] for block, _, _ in parts))
        E, target = [], []
        for block, root, start in parts:
            of_theta = block.new_zeros(*batch, block.shape[-2], rows.n_theta)
            if start is not None:
                of_theta[..., start : start + root.shape[-1]] = root
            E.append(block.expand(*batch, *block.shape[-2:]))
            target.append(of_theta)
        worth = torch.linalg.solve_triangular(reduction.T.mT, reduction.Z.mT, upper=False)
        return Screen(reduction, torch.cat(E, -2), torch.cat(target, -2), worth, negligible_cost(reduction))

    def vouches(self, theta: Tensor, lam: Tensor, v: Tensor) -> Tensor:
        """Return which plans convince, `(*batch,)`: theta, lam and v in the caller's units."""
        reduction, rows = self.reduction, self.reduction.rows
        a = times(reduction.A_theta, theta) - times(reduction.A_lam, lam)
        missed = times(self.E, a) - times(self.target, theta)
        slope = times(self.E.mT, missed) + times(rows.C.mT, lam)
        mu = times(rows.Eq_pinv.mT, slope)
        off = v - times(rows.C, a)
        first = (lam * off).abs().sum(-1)
        first = first + (mu * (times(rows.Eq, a) - theta[..., rows.Eq_theta])).abs().sum(-1)
        worth = times(self.worth, slope).square().sum(-1) / 2
        fits = (off.abs() <= FITS * (rows.scale + v.abs())).all(-1)
        return fits & (first + worth <= SHARE * missed.square().sum(-1) / 2 + self.negligible)
