"""The projected Karush-Kuhn-Tucker system at a solution: one symmetric operator for every set and both directions.

A solution satisfies  v = v0 - G lam,  v = P(v + gamma lam),  P the projection onto the sets (the proximal map of a
penalty). Let D be the Jacobian of P there, W_A its eigenvectors with an eigenvalue d < 1 (the *held* directions), and

    S = W_A (W_A' G W_A + diag kappa)^-1 W_A',      kappa = gamma d / (1 - d),

kappa the curvature of the sets' boundary. For a box d is 0 or 1, W_A picks the active rows A, and S is G_AA^-1 on them.
S is symmetric, so that it serves the forward and the backward derivative (:mod:`torch_dpc.solve.derivative`), and
Newton's step on F (:mod:`torch_dpc.solve.newton`) too: with K = (I - D) G + gamma D,

    K^-1 b = b / gamma + S (b - G b / gamma).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..batching import flatten_batch, times
from ..sets.blocks import Blocks
from ..sets.feasible import FeasibleSet
from .active_set import adjoint, solve_active


@dataclass(frozen=True)
class SystemTolerances:
    """Tolerances of the system.

    Attributes:
        free: directions whose eigenvalue of D is within this of 1 are free.
        pivot: a Cholesky factor is trusted if the square of every pivot exceeds this, relative to its diagonal entry.
        pseudo_inverse: singular values below this fraction of the largest are dropped where the factor is not trusted.
    """

    free: float = 1e-12
    pivot: float = 1e-10
    pseudo_inverse: float = 1e-13


TOLERANCES = SystemTolerances()


@dataclass(frozen=True, eq=False)
class ProjectedSystem:
    """The constants of the operator S.

    Vectors and G are in the order of v for boxes, in part order for other sets.

    Attributes:
        Ct: the factor of G, `(N, n_x)` or one a sample.
        sets: the structure of D; None for boxes, where D is one boolean tensor: the active rows.
        gamma: the scale of the multipliers, `(N,)`, equal within each block; None for boxes.
    """

    Ct: Tensor
    sets: FeasibleSet | None = None
    gamma: Tensor | None = None

    @property
    def tails(self) -> tuple[int, ...]:
        """How many dimensions of each block of D are its own."""
        return (1,) if self.sets is None else self.sets.tails

    def check_second_derivative(self) -> None:
        """Do nothing: the system is differentiable again."""

    def adjoint(self, v_bar: Tensor | None, lam_bar: Tensor | None, G: Tensor, D: Blocks) -> Tensor:
        """Return v_bar + S (lam_bar - G v_bar), `(*batch, N)`.

        Where G_AA + diag kappa is singular S is its pseudo-inverse; for a box, dependent rows are left out.

        Args:
            v_bar, lam_bar: `(*batch, N)`; None for zero, not both.
            G: `(N, N)` or one a sample.
            D: the Jacobian of the projection, block by block.
        """
        if self.sets is None:
            batch, (G, Ct), (active, *bars) = flatten_batch((G, self.Ct), (D[0], v_bar, lam_bar))
            found = solve_active(G, Ct, active, bars[1])[0] if v_bar is None else adjoint(G, Ct, active, *bars)
            return found.reshape(*batch, active.shape[-1])
        if v_bar is None:
            assert lam_bar is not None
            return self._solve(G, D, lam_bar)[0]
        rhs = -times(G, v_bar) if lam_bar is None else lam_bar - times(G, v_bar)
        return v_bar + self._solve(G, D, rhs)[0]

    def is_regular(self, G: Tensor, D: Blocks, lam: Tensor) -> Tensor:
        """Return whether G_AA + diag kappa is nonsingular at multipliers lam `(*batch, N)`, `(*batch,)`."""
        if self.sets is None:
            batch, (G, Ct), (active, zero) = flatten_batch((G, self.Ct), (D[0], torch.zeros_like(lam)))
            return solve_active(G, Ct, active, zero)[1].reshape(batch)
        return self._solve(G, D, torch.zeros_like(lam))[1]

    def _solve(self, G: Tensor, D: Blocks, rhs: Tensor) -> tuple[Tensor, Tensor]:
        assert self.sets is not None and self.gamma is not None
        return solve_system(G, self.sets, D, rhs, self.gamma)


def solve_system(G: Tensor, sets: FeasibleSet, D: Blocks, rhs: Tensor, gamma: Tensor) -> tuple[Tensor, Tensor]:
    """Return S rhs, `(..., N)`, and whether G_AA + diag kappa was nonsingular, `(...)`; all in part order.

    Args:
        G: `(N, N)`, or one a sample.
        sets: the structure of D.
        D: the Jacobian of the projection, block by block.
        rhs: `(..., N)`; it may have batch dimensions before those of D, which are many right-hand sides of one system.
        gamma: the scale of the multipliers, `(N,)`, equal within each block.
    """
    d, vectors = sets.spectral(D)
    b = sets.rotate(vectors, rhs)
    held = d < 1 - TOLERANCES.free
    rows = held.reshape(-1, held.shape[-1]).any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return torch.zeros_like(b), torch.ones(b.shape[:-1], dtype=torch.bool, device=b.device)
    on = held[..., rows]
    curvature = torch.where(on, gamma[rows] * d[..., rows] / torch.where(on, 1 - d[..., rows], 1.0), 1.0)
    turned = sets.rotate_matrix(vectors, G)[..., rows[:, None], rows]
    matrix = turned * (on[..., :, None] & on[..., None, :]) + torch.diag_embed(curvature)
    y, regular = _solve_semidefinite(matrix, torch.where(on, b[..., rows], 0.0))
    x = torch.zeros_like(b)
    x[..., rows] = torch.where(on, y, 0.0)
    return sets.rotate(vectors, x, back=True), regular


def newton_step(G: Tensor, sets: FeasibleSet, D: Blocks, F: Tensor, gamma: Tensor) -> Tensor:
    """Return K^-1 F, Newton's step on F(lam) = v - P(v + gamma lam); the arguments are those of `solve_system`."""
    scaled = F / gamma
    return scaled + solve_system(G, sets, D, F - times(G, scaled), gamma)[0]


def _solve_semidefinite(matrix: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Solve positive semidefinite systems `(..., k, k)`; return also which were nonsingular, `(...)`.

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
    regular = (info == 0) & (L.diagonal(dim1=-2, dim2=-1).square().amin(-1) > TOLERANCES.pivot)
    bad = (~regular).nonzero()[:, 0]
    if len(bad):
        inverse = torch.linalg.pinv(unit[bad], hermitian=True, rtol=TOLERANCES.pseudo_inverse)
        y[bad] = inverse @ (right[bad] * scale[bad]) * scale[bad]
    return y.permute(2, 0, 1).reshape(*batch, k), regular.reshape(own).expand(batch)
