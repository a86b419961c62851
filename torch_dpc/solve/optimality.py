"""The optimality conditions of a sample, each row in its own unit: v, lam and G are those in units throughout.

The plan that belongs to multipliers lam is v = V theta - G lam. That this map solves the problem as posed (Up g =
u_ini, u = Uf g, y = Yf g, and stationarity with the weights as given) was verified once, with errors
(:mod:`torch_dpc.problem.verification`). What is left for each sample is

    v_i = Proj(v + d lam)_i      relative to  1 + |v_i|,      d_i = G_ii (equal within the group of a set),

and, where the cost has a kernel, that lam does no work along it: otherwise a plan of lower cost lies that way. The
residual is the worst row, and the errors of the map at this theta and lam on top. Where that does not convince, the
sample gets a second look in extended precision (:mod:`torch_dpc.solve.second_look`).

The code runs on batches of torch tensors `(B, n)` and on single samples as NumPy arrays `(n,)`, whose calls cost a
third of torch's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..problem.reduction import Reduction
from .weakness import is_without_multiplier, reach_of

#: Keeps 0 / 0 at 0.
_TINY = 1e-300


@dataclass(frozen=True)
class Arithmetic:
    """What torch and NumPy do not spell alike.

    Attributes:
        array: turns a tensor into an array of its kind.
        clip: (x, lower, upper) -> the nearest point between the bounds.
        combine: (lam, rows) -> lam' rows, where most of lam is zero.
        count: how many entries of the last dimension are true.
        largest: the largest entry of the last dimension, 0 if there is none.
    """

    array: Callable[[Tensor], Any]
    clip: Callable[[Any, Any, Any], Any]
    combine: Callable[[Any, Any], Any]
    count: Callable[[Any], Any]
    largest: Callable[[Any], Any]


BATCHED = Arithmetic(
    array=lambda tensor: tensor,
    clip=torch.clamp,
    combine=lambda lam, rows: _times(rows.mT, lam),
    count=lambda flags: flags.sum(-1),
    largest=lambda x: x.amax(-1) if x.shape[-1] else x.sum(-1),
)
SINGLE = Arithmetic(
    array=lambda tensor: tensor.contiguous().numpy(),
    clip=lambda x, lower, upper: np.minimum(np.maximum(x, lower), upper),
    combine=lambda lam, rows: lam[held := lam.nonzero()[0]].dot(rows[held]),
    count=np.count_nonzero,
    largest=lambda x: x.max(initial=0.0),
)


class Judged(NamedTuple):
    """A point as its optimality conditions see it.

    Attributes:
        v: the constrained rows (u, y, du), within their bounds.
        residual: the worst row's violation, errors of the map included, relative to the rows' units.
        active: the rows that count as active in derivatives, boolean.
        n_active: how many.
        n_weakly_active: rows that touch their bound and count as inactive.
    """

    v: Any
    residual: Any
    active: Any
    n_active: Any
    n_weakly_active: Any


class Optimality:
    """The conditions of one reduction.

    Args:
        reduction: the reduced problem, in units.
        arithmetic: BATCHED, for tensors `(B, n)`, or SINGLE, for NumPy arrays `(n,)`.
    """

    def __init__(self, reduction: Reduction, arithmetic: Arithmetic):
        array = arithmetic.array
        self._clip, self._combine, self._count = arithmetic.clip, arithmetic.combine, arithmetic.count
        self._largest = arithmetic.largest
        diagonal = reduction.G.diagonal(dim1=-2, dim2=-1).contiguous()
        self._V, self._G, self.diagonal = array(reduction.V), array(reduction.G), array(diagonal)
        self._kernel = array(reduction.kernel) if reduction.is_selection else None
        self._pull = array(reduction.gain[..., 0] * reduction.kernel.abs().amax(-2))  # of lam's work, on v
        self._per_theta, self._moved = array(1 / reduction.rows.theta_scale), array(diagonal / reduction.scale)
        worst = reduction.error.amax(-2)
        self._error = (float(worst[0]), float(worst[1])) if worst.ndim == 1 else worst.unbind(-1)

    def unconstrained(self, theta: Any) -> Any:
        """Return the unconstrained minimiser V theta."""
        return _times(self._V, theta)

    def displaced(self, v0: Any, lam: Any) -> Any:
        """Return v0 - G lam."""
        return v0 - self._combine(lam, self._G)

    def error(self, theta: Any, lam: Any) -> Any:
        """Return a bound on what the errors of the map, and rounding, do to a row of V theta - G lam."""
        of_theta, of_lam = self._error
        return of_theta * self._largest(abs(theta * self._per_theta)) + of_lam * (abs(lam) * self._moved).sum(-1)

    def judge(self, raw: Any, lam: Any, lower: Any, upper: Any, error: Any) -> Judged:
        """Return what the conditions say of multipliers lam.

        Args:
            raw: V theta - G lam, and
            error: the error of that.
            lam: the multipliers.
            lower, upper: bounds, `(N,)` or one a sample.
        """
        # At a solution v is raw, and on its bound where a multiplier holds the row.
        v = self._clip(raw + lam * self.diagonal, lower, upper)
        residual = self.residual(lam, abs(raw - v) / (1 + abs(v)), error)
        reach = reach_of(v)
        # A difference to an infinite bound is infinite, and so never within reach.
        touching = (upper - v <= reach) | (v - lower <= reach)
        tight = lower == upper  # its projection is constant, whatever the multiplier
        active = touching & (~is_without_multiplier(v, lam, self.diagonal) | tight)
        n_active = self._count(active)
        return Judged(v, residual, active, n_active, self._count(touching) - n_active)

    def residual(self, lam: Any, missed: Any, error: Any) -> Any:
        """Return the residual, given how far each row is from its set, relative to 1 + |v|, and the map's error."""
        residual = self._largest(missed) + error
        if self._kernel is None:
            return residual
        # None, relative to its terms; or so little that taking the charge away would not move a row.
        work, terms = abs(self._combine(lam, self._kernel)), self._combine(abs(lam), abs(self._kernel))
        relative, pull = self._largest(work / (terms + _TINY)), self._largest(work * self._pull)
        return residual + relative * (pull >= relative) + pull * (pull < relative)


def _times(matrix: Any, x: Any) -> Any:
    if x.ndim == 1:
        return matrix.dot(x)
    return x @ matrix.mT if matrix.ndim == 2 else (matrix @ x[..., None])[..., 0]
