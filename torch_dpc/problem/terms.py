"""Which terms the problem has beyond the paper's, and how many entries its parts have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..data.hankel import HankelData
from ..data.hankel_batch import HankelBatch

#: What may be charged of g; see :mod:`torch_dpc.problem.regularizers`.
REGULARIZERS = ("projection", "identity", "spc", "gamma")


@dataclass(frozen=True)
class Terms:
    """Which terms the problem has beyond the paper's.

    Attributes:
        regularizer: what is charged of g, one of :data:`REGULARIZERS`.
        slack: lambda_u |Up g - u_ini|^2 in place of Up g = u_ini.
        rates: the changes of the input, u_t - u_(t-1), are constrained or charged.
        terminal_steps: so many last outputs equal their reference.
        affine: 1'g = 1, one more row of Up before the others.
        mismatch: Yp g - y_ini is constrained, or charged by a penalty that is not quadratic.
    """

    regularizer: str = "projection"
    slack: bool = False
    rates: bool = False
    terminal_steps: int = 0
    affine: bool = False
    mismatch: bool = False


@dataclass(frozen=True)
class Sizes:
    """How many entries the parts of theta = (u_ini, y_ini, u_ref, y_ref) and of v = (u, y, du, slack) have, and steps.

    For affine systems a 1 stands before u_ini in theta, for 1'g = 1.
    du, the changes of the input, and slack = Yp g - y_ini have entries only where the problem speaks of them.
    """

    u_ini: int
    y_ini: int
    u: int
    y: int
    horizon: int
    du: int = 0
    slack: int = 0

    @staticmethod
    def of(data: HankelData | HankelBatch, terms: Terms = Terms()) -> Sizes:  # noqa: B008
        """Read the sizes off the data."""
        past, future = data.t_ini, data.horizon
        n_u, n_y = data.n_u, data.n_y
        return Sizes(
            past * n_u + terms.affine,
            past * n_y,
            future * n_u,
            future * n_y,
            future,
            future * n_u if terms.rates else 0,
            past * n_y if terms.mismatch else 0,
        )

    @property
    def v(self) -> int:
        """The constrained rows, N."""
        return self.u + self.y + self.more

    @property
    def more(self) -> int:
        """The rows of v after u and y."""
        return self.du + self.slack

    @property
    def theta(self) -> tuple[int, int, int, int]:
        """The sizes of the four parts of theta."""
        return self.u_ini, self.y_ini, self.u, self.y

    def split(self, v: Any) -> tuple[Any, Any]:
        """Return u `(..., horizon, n_u)` and y `(..., horizon, n_y)` of v, a tensor or an array `(..., N)`."""
        batch = v.shape[:-1]
        u, y = v[..., : self.u], v[..., self.u : self.u + self.y]
        return (
            u.reshape((*batch, self.horizon, self.u // self.horizon)),
            y.reshape((*batch, self.horizon, self.y // self.horizon)),
        )

    def join(self, u: Tensor | None, y: Tensor | None, like: Tensor) -> Tensor:
        """Return v `(*batch, N)` of u and y, `(*batch, horizon, n)`, zero where they are None and shaped as `like`."""
        batch = like.shape[:-1]
        u = like.new_zeros(*batch, self.u) if u is None else u.reshape((*batch, self.u))
        y = like.new_zeros(*batch, self.y) if y is None else y.reshape((*batch, self.y))
        parts = [u, y, like.new_zeros(*batch, self.more)] if self.more else [u, y]
        return torch.cat(parts, dim=-1)
