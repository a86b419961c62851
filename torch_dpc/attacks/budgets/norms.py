"""Budgets with one size for the whole window, or one a channel: balls of several norms."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...checks import check_flag, check_type
from .base import Budget, NormBound, direction, euclidean, nonnegative, norm_bound, ratio, standard_normal


class NormBall(Budget):
    """|p| <= radius in a norm of the whole window, or |p| <= radius |y_ini| in the same norm.

    Args:
        radius: a number, or `(*batch,)`, one a sample, in the units of the outputs.
        relative: whether the radius is a fraction of |y_ini|.
    """

    _name = "radius"

    def __init__(self, radius: Any, *, relative: bool = False):
        self.radius = nonnegative(self._name, radius)
        self.relative = check_flag("relative", relative)

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return ratio(self._norm(p), self._reach(y_ini))[..., 0, 0] - 1

    def _reach(self, y_ini: Tensor) -> Tensor:
        """Return the largest size of p, `(*batch, 1, 1)`."""
        reach = self.radius.to(y_ini).reshape(*self.radius.shape, 1, 1)
        return reach * self._norm(y_ini) if self.relative else reach

    def _norm(self, p: Tensor) -> Tensor:
        """Return the norm that is bounded, `(*batch, 1, 1)`."""
        return euclidean(p)


class BallBudget(NormBall):
    """|p| <= radius, Euclidean over the whole window.

    Args:
        radius: a number, or `(*batch,)`, one a sample, in the units of the outputs.
        relative: |p| <= radius |y_ini| instead.

    Example:
        >>> BallBudget(2.0).minimize_linear(torch.tensor([[3.0], [4.0]]), torch.zeros(2, 1))
        tensor([[-1.2000], [-1.6000]])
    """

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return -self._reach(y_ini) * direction(c)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return p * _shrink(euclidean(p), self._reach(y_ini))

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        return norm_bound(self._reach(y_ini.double()).expand(y_ini.shape))


class RelativeBallBudget(BallBudget):
    """|p| <= rho |y_ini|, the paper's budget: `BallBudget(rho, relative=True)`."""

    _name = "rho"

    def __init__(self, rho: Any):
        super().__init__(rho, relative=True)
        self.rho = self.radius


class L1BallBudget(NormBall):
    """sum |p_ti| <= radius: few large entries cost as much as many small ones.

    The linear minimiser puts everything on one entry. The projection sorts the entries (Duchi, Shalev-Shwartz, Singer,
    Chandra 2008).

    Args:
        radius: a number, or `(*batch,)`, one a sample, in the units of the outputs.
        relative: sum |p_ti| <= radius sum |y_ti| instead.

    Example:
        >>> L1BallBudget(2.0).project(torch.tensor([[3.0], [2.0]]), torch.zeros(2, 1))
        tensor([[1.5000], [0.5000]])
    """

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        flat = c.flatten(-2)
        largest = flat.abs().argmax(-1, keepdim=True)
        vertex = torch.zeros_like(flat).scatter(-1, largest, -flat.gather(-1, largest).sign())
        return self._reach(y_ini) * vertex.reshape(c.shape)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        reach = self._reach(y_ini)
        size = p.flatten(-2).abs().sort(dim=-1, descending=True).values
        count = torch.arange(1, size.shape[-1] + 1, dtype=p.dtype, device=p.device)
        threshold = (size.cumsum(-1) - reach[..., 0]) / count  # if the `count` largest entries are the ones that stay
        stay = (size > threshold).sum(-1, keepdim=True).clamp_min(1)
        by = threshold.gather(-1, stay - 1)[..., None].clamp_min(0.0)
        shrunk = p.sign() * (p.abs() - by).clamp_min(0.0)
        return shrunk * _shrink(self._norm(shrunk), reach)  # the rounding of a long sum

    def random(self, y_ini: Tensor, generator: torch.Generator | None = None) -> Tensor:
        # Laplace numbers, each half the difference of two squared lengths in the plane: uniform on the surface
        x = standard_normal(y_ini.expand(4, *y_ini.shape), generator).square()
        p = x[0] + x[1] - x[2] - x[3]
        return p * self._reach(y_ini) / self._norm(p)

    def _norm(self, p: Tensor) -> Tensor:
        return p.abs().sum((-2, -1), keepdim=True)


class SparseBallBudget(BallBudget):
    """|p| <= radius on at most `channels` of the n_y sensors: the attacker holds a few of them, and chooses which.

    The set is not convex, a union of balls, one for each choice. Both the linear minimiser and the projection are exact
    all the same: the sensors with the largest |c_i|, and those with the largest |p_i|, each over the window.

    Args:
        channels: how many sensors may be touched.
        radius: a number, or `(*batch,)`, one a sample, in the units of the outputs.
        relative: |p| <= radius |y_ini| instead, |y_ini| over all sensors.

    Example:
        >>> SparseBallBudget(1, 2.0).minimize_linear(torch.tensor([[3.0, 4.0]]), torch.zeros(1, 2))
        tensor([[-0., -2.]])
    """

    convex = False

    def __init__(self, channels: int, radius: Any, *, relative: bool = False):
        if not isinstance(channels, int) or isinstance(channels, bool) or channels < 1:
            raise ValueError(f"`channels` must be a positive integer, got {channels!r}.")
        super().__init__(radius, relative=relative)
        self.channels = channels

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return super().minimize_linear(self._keep_largest(c), y_ini)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return super().project(self._keep_largest(p), y_ini)

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        touched = (p != 0).any(-2).sum(-1)
        return torch.where(touched > self.channels, torch.inf, super().excess(p, y_ini))

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        return Budget.norm_bounds(self, y_ini)  # a union of balls is no intersection

    def _keep_largest(self, p: Tensor) -> Tensor:
        size = torch.linalg.vector_norm(p, dim=-2, keepdim=True)
        chosen = size.topk(min(self.channels, p.shape[-1]), dim=-1).indices
        return p * torch.zeros_like(size).scatter(-1, chosen, 1.0)


class PerChannelBudget(Budget):
    """A budget for each channel on its own.

    `PerChannelBudget(BallBudget([0.1, 0.2]))` is |p_i| <= radius_i over the window.

    Args:
        budget: a `BallBudget`, `RelativeBallBudget` or `L1BallBudget`, whose radius may be `(n_y,)`, one a channel. A
            relative one is relative to the channel's own part of y_ini.

    Example:
        >>> budget, y_ini = PerChannelBudget(RelativeBallBudget(0.1)), torch.tensor([[3.0, 0.0], [4.0, 20.0]])
        >>> budget.project(torch.ones(2, 2), y_ini)
        tensor([[0.3536, 1.0000], [0.3536, 1.0000]])
    """

    def __init__(self, budget: Budget):
        if not isinstance(budget, NormBall) or isinstance(budget, SparseBallBudget):
            raise ValueError(f"`budget` must be a Ball, RelativeBall or L1Ball, got {type(budget).__name__}.")
        self.budget = budget

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return _joined(self.budget.minimize_linear(_split(c), _split(y_ini)))

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return _joined(self.budget.project(_split(p), _split(y_ini)))

    def random(self, y_ini: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return _joined(self.budget.random(_split(y_ini), generator))

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return self.budget.excess(_split(p), _split(y_ini)).amax(-1)

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        if not isinstance(self.budget, BallBudget):
            return super().norm_bounds(y_ini)
        # The reach of each channel, `(n_y,)`; every channel is a ball over its own entries.
        reach = self.budget._reach(_split(y_ini.double())).flatten().expand(y_ini.shape[-1])
        pieces: list[NormBound] = []
        for channel in range(y_ini.shape[-1]):
            own = torch.zeros(y_ini.shape, dtype=torch.float64)
            own[:, channel] = 1.0
            rows = np.diag(own.flatten().numpy())[own.flatten().numpy() > 0]
            radius = float(reach[channel])
            if radius == 0.0:
                pieces += [NormBound(row[None], np.zeros(1), 0.0) for row in rows]
            else:
                pieces.append(NormBound(rows, np.zeros(len(rows)), radius))
        return pieces


class PerSampleBudget(Budget):
    """A budget for each sample of the window on its own: what a sensor may report at one time.

    Args:
        budget: any budget; each sample is a window of one row to it. A relative one is relative to that sample.

    Example:
        >>> budget, y_ini = PerSampleBudget(RelativeBallBudget(0.1)), torch.tensor([[3.0, 4.0], [0.0, 20.0]])
        >>> budget.project(torch.ones(2, 2), y_ini)
        tensor([[0.3536, 0.3536],
                [1.0000, 1.0000]])
    """

    def __init__(self, budget: Budget):
        check_type("budget", budget, Budget)
        self.budget = budget
        self.convex = budget.convex

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        return self.budget.minimize_linear(c[..., None, :], y_ini[..., None, :])[..., 0, :]

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return self.budget.project(p[..., None, :], y_ini[..., None, :])[..., 0, :]

    def random(self, y_ini: Tensor, generator: Any = None) -> Tensor:
        return self.budget.random(y_ini[..., None, :], generator)[..., 0, :]

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return self.budget.excess(p[..., None, :], y_ini[..., None, :]).amax(-1)


def _split(p: Tensor) -> Tensor:
    """Make one-channel windows of the channels, `(*batch, n_y, t_ini, 1)`."""
    return p.mT[..., None]


def _joined(p: Tensor) -> Tensor:
    return p[..., 0].mT


def _shrink(size: Tensor, reach: Tensor) -> Tensor:
    """Return the factor that brings a size within its reach."""
    return torch.where(size > reach, reach / torch.where(size > 0, size, 1.0), 1.0)
