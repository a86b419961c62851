"""The study of the recipe: its statistics on rows with known factors, and its picture."""

import numpy as np
import pytest

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

from scripts import study_recipe as script
from scripts.shared import bootstrap

SEEDS, FRESH = range(10), range(5000, 5010)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """The ends of the intervals are not judged here."""
    monkeypatch.setattr(bootstrap, "SETTINGS", bootstrap.Settings(resamples=99))


def rows_of(factor, fresh_factor, random=1.2):
    """Rows of every variation: 1 m without an attack, `random` and factor x random, a little more on later seeds."""
    return [
        {"variation": variation.key, "seed": str(seed), "attack": attack, "crashed": "0", "unsolved": "0"}
        | {"error": str(error * (1 + 0.01 * (seed % 10)))}
        for variation in script.VARIATIONS
        for seed in (*SEEDS, *FRESH)
        for attack, error in {
            "nominal": 1.0,
            "random": random,
            "algorithm1": random * (factor if seed in SEEDS else fresh_factor) * (1 + 0.1 * (seed % 10)),
        }.items()
    ]


def test_factors_of_errors_and_of_what_is_added():
    e = script.errors_of(rows_of(5.0, 5.0), script.VARIATIONS[0], SEEDS)
    np.testing.assert_allclose(e.by_seed, 5.0 * (1 + 0.1 * np.arange(10)))
    found = script.added(e)
    assert found.value == pytest.approx((e.poison.mean() - e.nominal.mean()) / (e.random.mean() - e.nominal.mean()))
    assert script.added(script.errors_of(rows_of(5.0, 5.0, random=1.0), script.VARIATIONS[0], SEEDS)) is None


@pytest.mark.parametrize(("fresh_factor", "inside"), [(5.0, True), (2.0, False), (20.0, False)])
def test_fresh_seeds_reproduce_a_line_or_do_not(fresh_factor, inside):
    rows = rows_of(5.0, fresh_factor)
    e, f = (script.errors_of(rows, script.VARIATIONS[0], seeds) for seeds in (SEEDS, FRESH))
    assert script.reproduced(e, f) == inside
    lines = script.table(rows, SEEDS, FRESH)
    n = len(script.VARIATIONS)
    assert lines[n + 3] == f"Inside the band: {n if inside else 0} of {n} settings."
    assert len(lines) == 2 * (2 + n) + 3 and len(script.table(rows, SEEDS, range(0))) == 2 + n


def test_the_picture_has_fresh_seeds_or_none(tmp_path):
    for name, fresh in (("with", FRESH), ("without", range(0))):
        script.plot(tmp_path / f"{name}.png", rows_of(5.0, 6.0), SEEDS, fresh)
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
