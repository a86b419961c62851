"""Statistics over seeds: bands, spreads, and how attacks compare."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from scripts.shared import bootstrap
from scripts.shared.rows import Array, Rows, grid

NOMINAL, RANDOM, POISON = "nominal", "random", "algorithm1"
BAND = (10, 90)  # percentiles over the seeds


def band(values: Array) -> tuple[Array, Array, Array]:
    """Return the median over the seeds, the first axis, and the ends of the band around it."""
    low, median, high = np.percentile(values, (BAND[0], 50, BAND[1]), axis=0)
    return median, low, high


def spread(values: Array) -> dict[str, float]:
    """Return the mean, the median and the extremes over the seeds."""
    return {name: float(getattr(np, name)(values)) for name in ("mean", "median", "min", "max")}


def summarise(rows: Rows, rhos: Sequence[float]) -> dict[str, Any]:
    """Return the error of each run, averaged over its time, over the seeds, and how the attacks compare at each rho.

    The ratios are those of the means over the seeds, with paired bootstrap intervals. What an attack adds is its error
    less the nominal one; the ratio of what they add is None where random noise adds nothing.
    """
    nominal = grid(rows, "error", NOMINAL, 0.0).mean(axis=1)
    levels = []
    for rho in rhos:
        random, poison = (grid(rows, "error", attack, rho).mean(axis=1) for attack in (RANDOM, POISON))
        added = {"random": random - nominal, "poison": poison - nominal}
        adds = added["random"] > 1e-3 * nominal
        levels.append(
            {
                "rho": rho,
                "seeds": len(nominal),
                "random": spread(random),
                "poison": spread(poison),
                "ratio": float(poison.mean() / random.mean()),
                "ratio_interval": _interval(bootstrap.ratio, poison, random),
                "ratio_by_seed": spread(poison / random),
                "added_random": spread(added["random"]),
                "added_poison": spread(added["poison"]),
                "added_ratio": float(added["poison"].mean() / added["random"].mean())
                if added["random"].mean() > 1e-3 * nominal.mean()
                else None,
                "added_ratio_interval": _interval(bootstrap.added_ratio, poison, random, nominal)
                if added["random"].mean() > 1e-3 * nominal.mean()
                else None,
                "added_ratio_by_seed": spread(added["poison"][adds] / added["random"][adds]) if adds.any() else None,
                "seeds_where_random_adds": int(adds.sum()),
            }
        )
    return {"seeds": len(nominal), "nominal": spread(nominal), "levels": levels}


def _interval(statistic: Callable[..., bootstrap.Interval], *samples: Array) -> list[float] | None:
    """Return the ends of an interval over the seeds; None for a single seed."""
    return [*statistic(*samples)[1:3]] if len(samples[0]) > 1 else None
