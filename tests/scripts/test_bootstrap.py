"""Intervals over seeds: against Student's interval, their coverage, and the cases in which nothing varies."""

import numpy as np
import pytest
from scipy import stats

from scripts.shared import bootstrap

N = 40
NEAR_STUDENT = 0.10  # of the width: both are 95 % intervals of a mean of normal numbers


def pairs(seed, n=N, shift=1.0, spread=0.2):
    """Two samples that share most of what varies from seed to seed."""
    source = np.random.default_rng(seed)
    common = source.normal(10.0, 3.0, n)
    return common + source.normal(0.0, spread, n) + shift, common


def test_the_interval_of_a_difference_is_students():
    values, base = pairs(0)
    found = bootstrap.difference(values, base)
    d = values - base
    low, high = stats.t.interval(0.95, N - 1, d.mean(), d.std(ddof=1) / np.sqrt(N))
    assert found.value == pytest.approx(d.mean()) and found.seeds == N
    assert abs(found.low - low) < NEAR_STUDENT * (high - low) > abs(found.high - high)


def test_what_pairs_share_does_not_widen_the_interval():
    values, base = pairs(0)
    shuffled = np.random.default_rng(1).permutation(base)
    widths = [f.high - f.low for f in (bootstrap.difference(values, b) for b in (base, shuffled))]
    assert 5 * widths[0] < widths[1]


def test_intervals_cover_the_truth_as_often_as_they_say(monkeypatch):
    monkeypatch.setattr(bootstrap, "SETTINGS", bootstrap.Settings(resamples=999))
    found = [bootstrap.ratio(*pairs(seed, 20, shift=5.0, spread=1.0)) for seed in range(300)]
    covered = np.mean([f.low <= 1.5 <= f.high for f in found])  # (10 + 5) / 10
    assert 0.90 < covered < 0.98  # 95 %, less what 20 seeds cost, and 300 trials


def test_added_ratio_is_what_it_says():
    nominal = np.array([1.0, 2.0, 3.0])
    found = bootstrap.added_ratio(nominal + 6.0, nominal + 2.0, nominal)
    assert tuple(found) == (3.0, 3.0, 3.0, 3) and f"{found:.1f}" == "3.0 (3.0 to 3.0)"


def test_where_nothing_varies_the_interval_is_a_point():
    assert tuple(bootstrap.mean(np.full(5, 0.1))) == (pytest.approx(0.1),) * 3 + (5,)
    assert tuple(bootstrap.difference(np.arange(4.0), np.arange(4.0))) == (0.0, 0.0, 0.0, 4)


def test_the_same_rows_give_the_same_interval():
    assert bootstrap.ratio(*pairs(3)) == bootstrap.ratio(*pairs(3))


@pytest.mark.parametrize("samples", [([1.0],), ([1.0, 2.0], [1.0, 2.0, 3.0])], ids=["one seed", "unpaired"])
def test_samples_that_are_no_pairs_are_refused(samples):
    with pytest.raises(ValueError, match="`samples` must have one length of at least 2 seeds"):
        bootstrap.interval(np.mean, *map(np.array, samples))
