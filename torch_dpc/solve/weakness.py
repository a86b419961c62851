"""When is a constraint weakly active?  One rule, for the solve and for every derivative.

A row that touches its bound has a multiplier of zero or not, and rounding would decide which. So a multiplier counts as
zero if the displacement that it makes, G_ii lam_i, is at most :data:`WEAKLY_ACTIVE` relative to 1 + |v_i|, v in units
(:meth:`torch_dpc.problem.reduction.Reduction.in_units`). A row that
touches its bound with such a multiplier is *weakly active*, and counts as inactive (D1 = 1) in every derivative.
"""

from __future__ import annotations

from typing import Any

#: Distances and displacements up to this, relative to 1 + |v|, count as zero.
WEAKLY_ACTIVE = 1e-9


def reach_of(v: Any) -> Any:
    """Return the distance, for each row of v, up to which a row touches its bound; a tensor or an array like v."""
    return WEAKLY_ACTIVE * (1 + abs(v))


def is_without_multiplier(v: Any, lam: Any, diagonal: Any) -> Any:
    """Return which multipliers count as zero, boolean, shaped like v.

    Args:
        v: the constrained rows, `(..., N)`, a tensor or an array.
        lam: their multipliers, likewise.
        diagonal: the diagonal of G, `(N,)` or one a sample.
    """
    return abs(lam * diagonal) <= reach_of(v)
