"""What a call of the layer returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from .errors import Status


class SolveInfo:
    """How the solve of each sample went; every tensor has the batch's shape.

    Attributes:
        is_selection: the cost does not fix g; u, y and g are those of the minimum-norm g.
    """

    def __init__(self, table: Tensor, is_selection: bool, make_nonsingular: Callable[[], Tensor]):
        self.table = table
        self.is_selection = is_selection
        self._make_nonsingular = make_nonsingular

    @property
    def status(self) -> Tensor:
        """A :class:`torch_dpc.Status`, int64."""
        return self.table[..., 0].long()

    @property
    def iterations(self) -> Tensor:
        """Steps of the engine that found the solution, int64."""
        return self.table[..., 1].long()

    @property
    def residual(self) -> Tensor:
        """The paper's F at the solution, relative to its terms, Up g = u_ini included; float64."""
        return self.table[..., 2]

    @property
    def n_active(self) -> Tensor:
        """Rows of (u, y) held at a bound, int64."""
        return self.table[..., 3].long()

    @property
    def n_weakly_active(self) -> Tensor:
        """Rows that touch their bound without a multiplier, int64; derivatives treat them as free."""
        return self.table[..., 4].long()

    @cached_property
    def nonsingular(self) -> Tensor:
        """Whether the paper's J is nonsingular at the solution, boolean: Proposition 1 holds as it stands.

        Where it is not, some multipliers or g are one choice of many, and derivatives are those of minimum norm.
        Computed when first asked for.
        """
        return self._make_nonsingular() & (self.status == Status.SOLVED)

    def __repr__(self) -> str:
        names = ("status", "iterations", "residual", "n_active", "n_weakly_active", "is_selection")
        return f"SolveInfo({', '.join(f'{name}={getattr(self, name)}' for name in names)})"


@dataclass(frozen=True, eq=False)
class DPCSolution:
    """The planned trajectory.

    Attributes:
        u: planned inputs, `(*batch, horizon, n_u)`, in the units of the data.
        y: predicted outputs, `(*batch, horizon, n_y)`, in the units of the data.
        info: how the solve went.
        lam: multipliers of the sets, of u then y, `(*batch, horizon (n_u + n_y))`, float64.
    """

    u: Tensor
    y: Tensor
    info: SolveInfo
    lam: Tensor
    _make_g: Callable[[], Tensor]

    @cached_property
    def g(self) -> Tensor:
        """The combination of the recorded windows, `(*batch, n_g)`; computed when first asked for."""
        return self._make_g()

    def sample(self, i: int) -> DPCSolution:
        """Return one sample of a batch."""
        info = SolveInfo(self.info.table[i], self.info.is_selection, lambda: self.info.nonsingular[i])
        return DPCSolution(self.u[i], self.y[i], info, self.lam[i], lambda: self.g[i])
