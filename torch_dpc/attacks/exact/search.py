"""Best-first branch and bound over the states of the rows."""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..budgets.base import NormBound
from .complementarity import FREE, HIGH, LOW, Array, Rows, allowed_states, is_open
from .relaxation import Linear, Quadratic, Relaxed, relax

#: A row whose multiplier times its distance from the bound is below this, relative to psi, is complementary.
COMPLEMENTARY = 1e-9


@dataclass(eq=False)
class Search:
    """What a search has found.

    Attributes:
        s: the best perturbation seen, in the variables of the budget.
        value: its cost, replayed.
        bound: no perturbation costs less.
        nodes: convex programs solved.
    """

    s: Array
    value: float
    bound: float
    nodes: int = 0


def search(
    rows: Rows,
    budget: list[NormBound],
    cost: Quadratic | Linear,
    replay: Callable[[Array], float],
    found: Search,
    tolerance: float,
    deadline: float,
    stops_at_leaf: bool = False,
) -> Search:
    """Minimise a cost over the budget until bound and value agree.

    Args:
        rows: the rows, with their intervals.
        budget: pieces in s.
        cost: of s and the multipliers.
        replay: s -> the cost of the plan that the layer makes; infinity where there is none.
        found: the best so far; it is improved in place.
        tolerance: stop where the bound is within this fraction of the value.
        deadline: of `time.monotonic`.
        stops_at_leaf: whether one plan that costs less than the value is answer enough.

    Returns:
        `found`.
    """
    order = itertools.count()
    root = relax(rows, budget, allowed_states(rows), cost)
    found.nodes += 1
    heap: list[tuple[float, int, Rows, Relaxed]] = [(root.bound, next(order), rows, root)]
    closed = np.inf  # the least bound of nodes that need no further branching
    while heap and time.monotonic() < deadline:
        bound, _, here, node = heap[0]
        if bound >= _target(found.value, tolerance):
            break
        heapq.heappop(heap)
        _improve(found, node.s, replay)
        states = allowed_states(here)
        row = _least_complementary(here, states, node, found.value)
        if row is None:
            closed = min(closed, bound)
            if stops_at_leaf:
                break
            continue
        for state in (FREE, HIGH, LOW):
            child = here.copy()
            child.decide(row, state)
            if not states[row] & state or not child.propagate():
                continue
            relaxed = relax(child, budget, allowed_states(child), cost)
            found.nodes += 1
            least = max(relaxed.bound, bound)
            if least >= _target(found.value, tolerance):
                closed = min(closed, least)
            else:
                heapq.heappush(heap, (least, next(order), child, relaxed))
    found.bound = min(found.value, closed, heap[0][0] if heap else np.inf)
    return found


def reaches(rows: Rows, budget: list[NormBound], minus_v: Linear, room: float, deadline: float) -> bool:
    """Return whether a plan of these rows may raise another row by `room`; True where the deadline passes undecided.

    Args:
        rows: the rows, with their intervals.
        budget: pieces in s.
        minus_v: minus the rise of the other row.
        room: to its bound.
        deadline: of `time.monotonic`.
    """
    if time.monotonic() > deadline:
        return True
    nothing = Search(np.zeros(rows.A.shape[1]), value=-room, bound=-np.inf)
    found = search(rows, budget, minus_v, lambda s: np.inf, nothing, 0.0, deadline, stops_at_leaf=True)
    return found.bound < -room


def _target(value: float, tolerance: float) -> float:
    return value - tolerance * abs(value)


def _improve(found: Search, s: Array, replay: Callable[[Array], float]) -> None:
    value = replay(s)
    if value < found.value:
        found.s, found.value = s, value


def _least_complementary(rows: Rows, allowed: NDArray[np.int8], node: Relaxed, value: float) -> int | None:
    """Return the row that violates its complementarity most, None where none does."""
    with np.errstate(invalid="ignore"):  # infinite bounds are met by multipliers of zero
        high = np.clip(node.lam, 0.0, None) * (rows.upper - node.v)
        low = np.clip(-node.lam, 0.0, None) * (node.v - rows.lower)
    violation = np.where(is_open(allowed), np.fmax(np.nan_to_num(high), np.nan_to_num(low)), 0.0)
    row = int(violation.argmax()) if len(violation) else 0
    return row if len(violation) and violation[row] > COMPLEMENTARY * (1.0 + abs(value)) else None
