"""The paper's map F at a solution, evaluated block by block in the coordinates of the row space.

    F = [z - Proj_D(z - P z - q - H'w);  H z - b],        z = (u, y, g),  w = (w_p, w_u, w_y)

The multipliers of u = Uf g and y = Yf g follow from lam: w_u = R (u - u_ref) + lam_u, w_y = Q (y - y_ref) + lam_y, so
that the first blocks read v - Proj(v + lam). w_p, of Up g = u_ini, is the least-squares choice, which leaves in the
block of g its part in the kernel of Up. B is orthonormal: norms in its coordinates are those of the n_g entries of g.

The code runs on batches of torch tensors `(B, n)` and on single samples as NumPy arrays `(n,)`, whose calls cost a
third of torch's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from ..problem.reduction import Reduction
from ..problem.rows import Tracking
from .weakness import is_without_multiplier, reach_of

#: Where every term of the stationarity of g vanishes at the optimum (the plan meets its reference), what is left is the
#: rounding of R (u - u_ref) and Q (y - y_ref): this fraction of |C| |(R, Q)| (|v| + |v_ref|) counts as a term too.
CANCELLATION = 1e-3
#: 2 lambda_s Yp'Yp a cannot be evaluated to better than a few units in the last place of lambda_s |Yp|^2 |a|; relative
#: to the accepted residual, 1e-8, that is this fraction. The same holds for G lam in v, up to a few times |v|:
#: multipliers that run away, because there is no solution, must not cover for a v outside its set.
ROUNDING, MOST_DISPLACED = 1e-6, 10.0


@dataclass(frozen=True)
class Arithmetic:
    """What torch and NumPy do not spell alike.

    Attributes:
        array: turns a tensor into an array of its kind.
        norm: Euclidean norm of the last dimension.
        clip: (x, lower, upper) -> the nearest point between the bounds.
        combine: (lam, rows) -> lam' rows, where most of lam is zero.
        count: how many entries of the last dimension are true.
        join: parts of vectors -> the vectors.
    """

    array: Callable[[torch.Tensor], Any]
    norm: Callable[[Any], Any]
    clip: Callable[[Any, Any, Any], Any]
    combine: Callable[[Any, Any], Any]
    count: Callable[[Any], Any]
    join: Callable[[list[Any]], Any]


BATCHED = Arithmetic(
    array=lambda tensor: tensor,
    norm=lambda x: torch.linalg.vector_norm(x, dim=-1),
    clip=torch.clamp,
    combine=lambda lam, rows: _times(rows.mT, lam),
    count=lambda flags: flags.sum(-1),
    join=lambda parts: torch.cat(parts, dim=-1),
)
SINGLE = Arithmetic(
    array=lambda tensor: tensor.numpy(),
    norm=lambda x: math.sqrt(x.dot(x)),  # half the time of (x @ x) ** 0.5
    clip=lambda x, lower, upper: np.minimum(np.maximum(x, lower), upper),
    combine=lambda lam, rows: lam[held := lam.nonzero()[0]].dot(rows[held]),
    count=np.count_nonzero,
    join=np.concatenate,
)


class Judged(NamedTuple):
    """A point as its optimality conditions see it.

    Attributes:
        v: the constrained rows (u, y), within their bounds.
        residual: the sum over the blocks of |F| relative to its terms.
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
        reduction: the reduced problem.
        arithmetic: BATCHED, for tensors `(B, n)`, or SINGLE, for NumPy arrays `(n,)`.
    """

    def __init__(self, reduction: Reduction, arithmetic: Arithmetic):
        rows, weights = reduction.rows, reduction.weights
        array = arithmetic.array
        self._norm, self._clip, self._combine = arithmetic.norm, arithmetic.clip, arithmetic.combine
        self._count, self._join = arithmetic.count, arithmetic.join
        self._A_theta, self._A_lam = array(reduction.A_theta), array(reduction.A_lam.mT.contiguous())
        self._diagonal = array(reduction.G.diagonal(dim1=-2, dim2=-1).contiguous())
        self._Eq, self._C, self._Z = (array(m) for m in (rows.Eq, rows.C, rows.Z))
        self._Eq_theta = _as_slice(rows.Eq_theta)
        alike = rows.charged.ndim == 1  # the same entries for every sample: the last ones
        self._charged = slice(int((rows.charged == 0).sum()), None) if alike else slice(None)
        self._weight_g = array(2 * weights.lambda_g[..., None] * (1.0 if alike else rows.charged))
        self._fits = [
            (
                array(fit.rows),
                array(2 * getattr(weights, fit.weight)[..., None]),
                slice(fit.measured, fit.measured + fit.rows.shape[-2]),
            )
            for fit in rows.fits
        ]
        tracking = [(term, getattr(weights, term.weight)) for term in rows.tracking]
        self._tracking = [
            (term.rows, None if weight is None else array(weight), _reference_of(term)) for term, weight in tracking
        ]
        self._size_Eq, self._size_G = float(rows.Eq.norm()), ROUNDING * float(reduction.G.norm())
        largest = max(float(w.abs().sum(-1).max()) for _, w in tracking if w is not None)  # bounds the norm
        self._floor = CANCELLATION * largest * float(rows.C.norm())
        self._rounding = ROUNDING * sum(
            float(getattr(weights, fit.weight).max()) * float(fit.rows.norm()) ** 2 for fit in rows.fits
        )

    def unconstrained(self, theta: Any) -> tuple[Any, Any]:
        """Return the unconstrained minimiser, as a and as v = C a."""
        a = _times(self._A_theta, theta)
        return a, _times(self._C, a)

    def judge(self, theta: Any, a0: Any, v0: Any, lam: Any, lower: Any, upper: Any) -> Judged:
        """Return what the conditions say of multipliers lam; bounds are `(N,)` or one a sample."""
        a = a0 - self._combine(lam, self._A_lam)
        raw = _times(self._C, a)
        v = self._clip(raw + lam, lower, upper)  # at a solution this is raw, and a row that lam holds is on its bound
        residual = self.residual(theta, a, a0, raw, v, v0, lam)
        reach = reach_of(v)
        # A difference to an infinite bound is infinite, and so never within reach.
        touching = (upper - v <= reach) | (v - lower <= reach)
        tight = lower == upper  # its projection is constant, whatever the multiplier
        active = touching & (~is_without_multiplier(v, lam, self._diagonal) | tight)
        n_active = self._count(active)
        return Judged(v, residual, active, n_active, self._count(touching) - n_active)

    def residual(self, theta: Any, a: Any, a0: Any, v: Any, projected: Any, v0: Any, lam: Any) -> Any:
        """Return the sum over the blocks of |F| relative to its terms, given v = C a and Proj(v + lam)."""
        norm = self._norm
        size_a = norm(a) + norm(a0)  # a is their difference: where it vanishes, what is left is their rounding
        # z - Proj_D(z - P z - q - H'w), the rows of u and y; u = Uf g and y = Yf g hold because v is C a
        size_v = norm(v)
        displaced = self._size_G * norm(lam)
        displaced = displaced * MOST_DISPLACED * size_v / (displaced + MOST_DISPLACED * size_v + _TINY)  # below both
        in_set = norm(v - projected) / (size_v + norm(v0) + displaced + _TINY)
        # Up g = u_ini, and what else is held
        wanted = theta[..., self._Eq_theta]
        held = norm(_times(self._Eq, a) - wanted) / (norm(wanted) + self._size_Eq * size_a + _TINY)
        # 2 lambda_g M g + 2 lambda_s Yp'(Yp g - y_ini) + Uf'w_u + Yf'w_y, on the kernel of Up
        total, size_refs = self._tracked(theta, v, lam)
        terms = norm(total) + self._floor * (size_v + size_refs) + self._rounding * size_a
        for S, weight, measured in self._fits:
            of_rows, of_measured = _back(weight * _times(S, a), S), _back(weight * theta[..., measured], S)
            total = total + (of_rows - of_measured)
            terms = terms + norm(of_rows) + norm(of_measured)
        of_M = self._weight_g * a[..., self._charged]
        total[..., self._charged] += of_M
        stationary = norm(_back(total, self._Z)) / (terms + norm(of_M) + _TINY)
        return in_set + held + stationary

    def _tracked(self, theta: Any, v: Any, lam: Any) -> tuple[Any, Any]:
        """Return C'(W (v - v_ref) + lam) and the size of v_ref."""
        w, size = [], 0.0
        for rows, weight, reference in self._tracking:
            part = v[..., rows]
            if reference is not None:
                part = part - theta[..., reference]
                size = size + self._norm(theta[..., reference])
            w.append(lam[..., rows] if weight is None else lam[..., rows] + _times(weight, part))
        return _back(self._join(w), self._C), size


def _as_slice(places: torch.Tensor) -> Any:
    """Return the places as a slice where they are one: a view costs less than a copy."""
    start = int(places[0]) if len(places) else 0
    one_run = torch.equal(places.cpu(), torch.arange(start, start + len(places)))
    return slice(start, start + len(places)) if one_run else places


def _reference_of(term: Tracking) -> slice | None:
    if term.reference is None:
        return None
    return slice(term.reference, term.reference + term.rows.stop - term.rows.start)


#: Keeps 0 / 0 at 0.
_TINY = 1e-300


def _back(x: Any, matrix: Any) -> Any:
    return x @ matrix if matrix.ndim == 2 else (x[..., None, :] @ matrix)[..., 0, :]


def _times(matrix: Any, x: Any) -> Any:
    if x.ndim == 1:
        return matrix.dot(x)
    return x @ matrix.mT if matrix.ndim == 2 else (matrix @ x[..., None])[..., 0]
