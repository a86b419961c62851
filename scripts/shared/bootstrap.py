"""Paired bootstrap: every comparison over seeds with an interval.

The seeds are the sample. Runs of one seed share the recording, the start and the noise, so seeds are resampled as a
whole, all their runs together (`scipy.stats.bootstrap`, bias-corrected and accelerated, paired).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from scripts.shared.rows import Array


@dataclass(frozen=True)
class Settings:
    """How intervals are made."""

    resamples: int = 9999  # the ends of a 95 % interval move by about 1 % of its width from run to run
    level: float = 0.95  # of confidence
    seed: int = 0  # of the resampling: the same rows give the same interval
    same: float = 1e-12  # relative: resampled values closer than this are equal, and the interval is a point


SETTINGS = Settings()


class Interval(NamedTuple):
    """A statistic over seeds, the ends of its confidence interval, and the number of seeds."""

    value: float
    low: float
    high: float
    seeds: int

    def __format__(self, spec: str) -> str:
        """Return `value (low to high)`, each in the given format."""
        return "{} ({} to {})".format(*(format(number, spec or ".3g") for number in self[:3]))

    def __str__(self) -> str:
        return format(self, "")

    def times(self, factor: float) -> Interval:
        """Return the interval in another unit, such as percent."""
        return Interval(factor * self.value, factor * self.low, factor * self.high, self.seeds)


def interval(statistic: Callable[..., Array], *samples: Array) -> Interval:
    """Return a statistic of paired samples, `(seeds,)` each, with its interval.

    Args:
        statistic: maps the samples to a number; it must reduce the last axis, given as `axis`.
        samples: one value a seed, the seeds in the same order.

    Raises:
        ValueError: the samples have different lengths or fewer than two seeds.
    """
    lengths = {len(sample) for sample in samples}
    if len(lengths) != 1 or min(lengths) < 2:
        raise ValueError(f"`samples` must have one length of at least 2 seeds, got {sorted(lengths)}.")
    value = float(statistic(*samples, axis=-1))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        found = stats.bootstrap(
            samples,
            statistic,
            paired=len(samples) > 1,
            vectorized=True,
            n_resamples=SETTINGS.resamples,
            confidence_level=SETTINGS.level,
            method="BCa",
            rng=np.random.default_rng(SETTINGS.seed),
        )
    drawn = found.bootstrap_distribution
    low, high = float(found.confidence_interval.low), float(found.confidence_interval.high)
    if np.ptp(drawn) <= SETTINGS.same * abs(value):
        low = high = value
    elif not np.isfinite([low, high]).all():  # the acceleration is undefined: plain percentiles
        tail = 50 * (1 - SETTINGS.level)
        low, high = (float(end) for end in np.percentile(drawn, (tail, 100 - tail)))
    return Interval(value, low, high, len(samples[0]))


def mean(values: Array) -> Interval:
    """Return the mean over the seeds."""
    return interval(np.mean, values)


def difference(values: Array, base: Array) -> Interval:
    """Return the mean of values - base, seed by seed: wholly above or below 0, the two differ."""
    return interval(lambda a, b, axis: (a - b).mean(axis=axis), values, base)


def ratio(values: Array, base: Array) -> Interval:
    """Return mean(values) / mean(base)."""
    return interval(lambda a, b, axis: a.mean(axis=axis) / b.mean(axis=axis), values, base)


def added_ratio(values: Array, base: Array, nominal: Array) -> Interval:
    """Return how many times as much error `values` add to the nominal one as `base` adds."""

    def statistic(a: Array, b: Array, n: Array, axis: int) -> Array:
        return (a - n).mean(axis=axis) / (b - n).mean(axis=axis)

    return interval(statistic, values, base, nominal)
