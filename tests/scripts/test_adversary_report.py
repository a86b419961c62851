"""The report on trained adversaries: training seeds apart from held-out seeds, and both in the tables."""

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")

from scripts.adversary import report
from scripts.adversary.judge import CLOSED_LOOP, HELD_OUT_WINDOWS, UNTRAINED
from scripts.shared.statistics import NOMINAL, POISON

RHOS, SEEDS, TRAINED = (0.1, 0.2), (7000, 7001, 7002), (0, 1)


def rows():
    """A policy with 2 and 3 times Algorithm 1's error, whose runs come in no order."""
    lines = [
        {"setting": "at rest", "seed": seed, "trained": trained, "attack": name, "rho": rho}
        | {"mean_error": factor * (1 + seed - SEEDS[0]) * (rho or 0.01), "failed": 0.0, "of_algorithm1": np.nan}
        for rho in (0.0, *RHOS)
        for seed in SEEDS
        for name, trained, factor in [
            *([(NOMINAL, UNTRAINED, 1.0)] if rho == 0 else [(POISON, UNTRAINED, 1.0)]),
            *([(CLOSED_LOOP, seed_, 2.0 + seed_) for seed_ in TRAINED] if rho else []),
        ]
    ]
    lines += [
        {"setting": HELD_OUT_WINDOWS, "seed": -1, "trained": trained, "attack": name, "rho": rho}
        | {"mean_error": np.nan, "failed": np.nan, "of_algorithm1": share}
        for rho in RHOS
        for name, trained, share in [(POISON, UNTRAINED, 1.0), *((CLOSED_LOOP, t, 0.5 + 0.1 * t) for t in TRAINED)]
    ]
    order = np.random.default_rng(0).permutation(len(lines))
    return {name: np.array([lines[i][name] for i in order]) for name in lines[0]}


def test_a_column_comes_by_training_seed_and_seed():
    found = report.chosen(rows(), "mean_error", "at rest", CLOSED_LOOP, 0.1)
    np.testing.assert_allclose(found, [[0.2, 0.4, 0.6], [0.3, 0.6, 0.9]])
    assert report.chosen(rows(), "mean_error", "at rest", POISON, 0.1).shape == (1, 3)


def test_the_ratio_is_that_of_the_mean_over_training_seeds():
    ratio, each = report.loop_ratio(rows(), "at rest", CLOSED_LOOP, 0.2)
    assert (ratio.value, ratio.low, ratio.high) == pytest.approx((2.5, 2.5, 2.5))
    np.testing.assert_allclose(each, [2.0, 3.0])
    table = report.loop_table(rows(), RHOS, "at rest")
    assert table[0] == "No attack: 0.02 m, 3 seeds."
    assert any("2.50 (2.50 to 2.50) [2.00 to 3.00]" in line for line in table)
