"""A second look, in extended precision, at samples whose verdict hangs on rounding.

V theta - G lam is evaluated in extended precision, less the errors of V and G that the verification of the map found
(:mod:`torch_dpc.problem.verification`), and the multipliers are polished with it: each round is one Newton step, and
what rounding takes of them is carried along. Multipliers of 1e6 then leave no more in v than those of 1 do.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..problem.reduction import Reduction

#: Equalities that are missed by more than this, for theta or a displacement of one unit, are not held.
LEAK = 1e-7
#: Rounds of polishing; each gains the digits that the system on the active rows has in double precision.
ROUNDS = 3


class SecondLook:
    """The extended map of one reduction.

    Args:
        reduction: the reduced problem, in units; one, or one a sample of a flattened batch.
    """

    def __init__(self, reduction: Reduction):
        self._reduction = reduction

    @cached_property
    def _map(self) -> np.ndarray:
        """[V, -G] without its errors, `(N, n_theta + N)` or one a sample."""
        r = self._reduction
        values = torch.cat([r.V, -r.G], dim=-1).cpu().numpy().astype(np.longdouble)
        return values if r.excess is None else values - r.excess.cpu().numpy()

    def polished(
        self, theta: Tensor, lam: Tensor, moved: Tensor, step: Callable[[Tensor, Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return multipliers and their V theta + moved - G lam, rounded once, `(*batch, N)` each.

        Args:
            theta, lam: of the samples.
            moved: along the kernel of the cost, `(*batch, N)` or a zero.
            step: (V theta + moved - G lam, lam) -> Newton's step on the multipliers.
        """
        rest = torch.zeros_like(lam)
        raw = self._raw(theta, lam, rest) + moved
        for _ in range(ROUNDS):
            change = rest + step(raw, lam)
            new = lam + change
            lam, rest = new, change - (new - lam)
            raw = self._raw(theta, lam, rest) + moved
        return lam, raw

    def missed_equalities(self, theta: Tensor, lam: Tensor) -> Tensor:
        """Return a bound on how far the plan is from Up g = u_ini, and what else is held, in units, `(*batch,)`.

        Rounding does not count: it is taken off g where g is made.
        """
        r = self._reduction
        found = r.error[..., r.V.shape[-2] :, :]
        leak = torch.where(found > LEAK, found, 0.0).sum(-2)
        moved = lam.abs() * r.G.diagonal(dim1=-2, dim2=-1) / r.scale
        return leak[..., 0] * (theta / r.rows.theta_scale).abs().amax(-1) + leak[..., 1] * moved.sum(-1)

    def _raw(self, theta: Tensor, lam: Tensor, rest: Tensor) -> Tensor:
        """Return V theta - G (lam + rest)."""
        theta = theta.expand(*lam.shape[:-1], theta.shape[-1])
        multipliers = lam.cpu().numpy().astype(np.longdouble) + rest.cpu().numpy()
        x = np.concatenate([theta.cpu().numpy().astype(np.longdouble), multipliers], axis=-1)
        exact = x @ self._map.T if self._map.ndim == 2 else (self._map @ x[..., None])[..., 0]
        return torch.from_numpy(exact.astype(float)).to(lam.device)
