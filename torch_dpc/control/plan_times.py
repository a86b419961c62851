"""How long plans take, against a deadline."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Durations that are kept for the statistics, the newest; a million plans take 8 MB.
KEPT = 1_000_000


class PlanTimes:
    """Durations of planning, in seconds.

    Args:
        deadline: a plan that takes longer is late [s]; None for no deadline.

    Attributes:
        count: plans so far.
        late: plans that took longer than the deadline.

    Example:
        >>> times = PlanTimes(deadline=0.02)
        >>> for seconds in (0.001, 0.002, 0.030):
        ...     times.add(seconds)
        >>> times
        PlanTimes(3 plans: median 2.00 ms, p99 29.44 ms, worst 30.00 ms; 1 later than 20 ms)
    """

    def __init__(self, deadline: float | None = None):
        if deadline is not None and not deadline > 0:
            raise ValueError(f"`deadline` must be a positive time [s] or None, got {deadline!r}.")
        self.deadline = deadline
        self.clear()

    def clear(self) -> None:
        """Forget all durations."""
        self._seconds: deque[float] = deque(maxlen=KEPT)
        self.count = self.late = 0

    def add(self, seconds: float) -> None:
        """Count one plan."""
        self._seconds.append(seconds)
        self.count += 1
        self.late += self.deadline is not None and seconds > self.deadline

    @property
    def median(self) -> float:
        """The median duration [s]; NaN before the first plan."""
        return self.quantile(0.5)

    @property
    def p99(self) -> float:
        """The duration that one plan in a hundred exceeds [s]; NaN before the first plan."""
        return self.quantile(0.99)

    @property
    def worst(self) -> float:
        """The longest duration [s]; NaN before the first plan."""
        return self.quantile(1.0)

    def quantile(self, q: float) -> float:
        """Return a quantile of the durations [s]; NaN before the first plan."""
        return float(np.quantile(self._seconds, q)) if self._seconds else float("nan")

    def __repr__(self) -> str:
        late = "" if self.deadline is None else f"; {self.late} later than {1e3 * self.deadline:g} ms"
        if not self.count:
            return f"PlanTimes(no plans{late})"
        times = f"median {1e3 * self.median:.2f} ms, p99 {1e3 * self.p99:.2f} ms, worst {1e3 * self.worst:.2f} ms"
        return f"PlanTimes({self.count} plans: {times}{late})"
