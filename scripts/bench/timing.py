"""Repeated calls, their summary, and the memory they took."""

from __future__ import annotations

import contextlib
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scripts.shared.rows import Array

#: Seconds of repeats for each time, and the most of them.
BUDGET, MOST_REPEATS = {"full": 1.0, "quick": 0.5}, 500
#: The least repeats for a call that takes up to so many seconds; a longer one is made once.
LEAST_REPEATS = ((0.5, 5), (3.0, 3))
WARM_UP = 0.2  # [s]
#: Of the machine's memory, so that a peer that asks for too much is told so, instead of being killed with others.
MEMORY_SHARE = 0.75


def least_repeats(seconds: float) -> int:
    """Return how often a call is made at least."""
    return next((repeats for longest, repeats in LEAST_REPEATS if seconds <= longest), 1)


def repeat(call: Callable[[int], Any], budget: float, first: float) -> Array:
    """Return the times of the calls [ms], `(repeats, 2)`: the whole call, and its part after the moment it returned.

    Args:
        call: takes the repeat's number; may return a moment of `time.perf_counter`.
        budget: seconds to spend.
        first: seconds that a call takes, roughly.
    """
    i, end = 0, time.perf_counter() + min(WARM_UP, budget)
    while first < WARM_UP and time.perf_counter() < end:
        call(i)
        i += 1
    times: list[tuple[float, float]] = []
    end = time.perf_counter() + budget
    while len(times) < least_repeats(first) or (time.perf_counter() < end and len(times) < MOST_REPEATS):
        began = time.perf_counter()
        middle = call(i)
        done = time.perf_counter()
        times.append((1e3 * (done - began), 1e3 * (done - middle) if isinstance(middle, float) else np.nan))
        i += 1
    return np.array(times)


def summary(name: str, times: Array) -> dict[str, float]:
    """Return the median, the quartiles and the number of the times."""
    low, median, high = np.percentile(times, (25, 50, 75))
    return {f"{name}_ms": median, f"{name}_q1": low, f"{name}_q3": high, "repeats": len(times)}


def peak() -> float:
    """Return the largest memory this process has held [MB]."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss of a new process starts at what its parent held
        return next(float(line.split()[1]) for line in status.open() if line.startswith("VmHWM")) / 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def forget_peak() -> None:
    """Let the peak start at what is held now, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def limit_memory() -> None:
    """Keep this process to `MEMORY_SHARE` of the machine."""
    limit = int(MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
