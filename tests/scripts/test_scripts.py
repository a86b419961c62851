"""The scripts: what they write on disk, their statistics, and small runs of Figures 3 and 4."""

import json
import math

import numpy as np
import pytest
import torch

import torch_dpc as dpc

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")
pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")


import recordings
from scripts import figure3_masses, report, study_sensitivity
from scripts.experiments.quadrotor import LiesWhereItCrashed, Quadrotor
from scripts.shared.command import run_all
from scripts.shared.film import CAMERA, HEIGHT, WIDTH, project
from scripts.shared.plots import percent
from scripts.shared.rows import grid, read_rows, write_pgf, write_rows
from scripts.shared.statistics import band, summarise

SAME_FLIGHT = 1e-9  # [m, rad]: another processor may round PyBullet's arithmetic differently
PIXEL = 1.5  # [pixels]


def runs(errors):
    """Return runs of two seeds and three steps from {(attack, rho): error of seed 0}; seed 1 has twice the error."""
    t = np.arange(3) * 0.1
    return [
        {"seed": seed, "attack": attack, "rho": rho, "t": t, "error": (1 + seed) * error * np.ones(3)}
        for seed in (0, 1)
        for (attack, rho), error in errors.items()
    ]


def saved(tmp_path, errors):
    write_rows(tmp_path / "rows.csv", runs(errors), "a note, with a comma")
    return read_rows(tmp_path / "rows.csv")


# --- files -----------------------------------------------------------------------------------------------------------


def test_pgf_tables_have_the_form_the_papers_plots_read(tmp_path):
    write_pgf(tmp_path / "a.csv", np.array([0.0, 0.1, 20.0]), [np.array([1.0, 2.0, 3.0]), np.ones(3) / 3])
    assert (tmp_path / "a.csv").read_text() == "iter rho1 rho2\n0 1 0.333333\n0.1 2 0.333333\n20 3 0.333333\n"


def test_rows_come_back_as_they_were_written(tmp_path):
    rows = saved(tmp_path, {("nominal", 0.0): 0.1, ("random", 0.003): 1 / 3})
    assert (tmp_path / "rows.csv").read_text().startswith("# a note, with a comma\nseed,attack,rho,t,error\n0,nominal,")
    assert len(rows["t"]) == 2 * 2 * 3
    np.testing.assert_allclose(grid(rows, "error", "random", 0.003), [[1 / 3] * 3, [2 / 3] * 3], rtol=1e-8)
    np.testing.assert_allclose(grid(rows, "t", "nominal", 0.0), [[0, 0.1, 0.2]] * 2)


# --- statistics ------------------------------------------------------------------------------------------------------


def test_band_is_the_median_and_two_percentiles_over_the_seeds():
    values = np.arange(11.0)[:, None] * [1.0, -1.0]  # 0 ... 10 and 0 ... -10
    median, low, high = band(values)
    np.testing.assert_allclose(median, [5, -5])
    np.testing.assert_allclose(low, [1, -9])
    np.testing.assert_allclose(high, [9, -1])


def test_summary_compares_errors_and_added_errors(tmp_path):
    rows = saved(tmp_path, {("nominal", 0.0): 0.1, ("random", 0.01): 0.2, ("algorithm1", 0.01): 0.6})
    summary = summarise(rows, [0.01])
    (level,) = summary["levels"]
    assert summary["nominal"]["mean"] == pytest.approx(0.15)
    assert level["ratio"] == pytest.approx(3.0)
    assert level["added_ratio"] == pytest.approx(5.0)
    assert level["ratio_interval"] == pytest.approx([3.0, 3.0])
    assert level["added_ratio_interval"] == pytest.approx([5.0, 5.0])
    assert (level["poison"]["min"], level["poison"]["max"]) == pytest.approx((0.6, 1.2))
    assert (level["seeds"], level["seeds_where_random_adds"]) == (2, 2)


def test_summary_gives_no_ratio_where_random_noise_adds_nothing(tmp_path):
    rows = saved(tmp_path, {("nominal", 0.0): 0.1, ("random", 0.01): 0.09, ("algorithm1", 0.01): 0.6})
    (level,) = summarise(rows, [0.01])["levels"]
    assert level["added_ratio"] is None and level["added_ratio_by_seed"] is None
    assert level["added_ratio_interval"] is None
    assert report.times(level["added_ratio"], level["added_ratio_interval"]) == "random adds nothing"


def test_percent_and_first_failure_read_well():
    assert [percent(rho) for rho in (0.003, 0.1, 1.0, 10**-2.5)] == ["0.3 %", "10 %", "100 %", "0.32 %"]
    fails = np.array([[0, 0, 1], [0, 1, 1]])
    rhos = np.array([0.001, 0.002, 0.004])
    assert study_sensitivity.first_failure(rhos, fails) == "the first run fails at 0.2 %; at 0.4 % 2 of 2 do."
    assert study_sensitivity.first_failure(rhos, 0 * fails) == "no run fails up to 0.4 %."


def test_jobs_come_back_in_order_whatever_the_number_of_processes():
    jobs = [(float(i),) for i in range(4)]
    assert run_all(math.sqrt, jobs, 1, "one") == [math.sqrt(i) for i in range(4)]
    assert run_all(math.sqrt, jobs, 2, "two") == [math.sqrt(i) for i in range(4)]


# --- the experiments -------------------------------------------------------------------------------------------------


def test_circle_is_the_papers():
    reference = Quadrotor().circle(251)
    offset = reference[:, :3] - Quadrotor().centre
    np.testing.assert_allclose(torch.linalg.vector_norm(offset, dim=1), 0.3, rtol=1e-12)
    np.testing.assert_allclose(reference[250], reference[0], atol=1e-12)  # 10 s later
    assert (reference[:, 2] == 1).all() and (reference[:, 3:] == 0).all()


def test_a_crashed_vehicle_lies_where_it_crashed():
    class Faller:
        height, crashed = 3.0, False

        def reset(self, position):
            self.height, self.crashed = 3.0, False
            return torch.tensor([self.height])

        def step(self, u):
            self.height -= 1.0
            self.crashed = self.height <= 1.0
            return torch.tensor([self.height])

    plant = LiesWhereItCrashed(Faller())
    plant.reset()
    assert [float(plant.step(0.0)) for _ in range(4)] == [2.0, 1.0, 1.0, 1.0]
    assert plant.down == [False, True, True, True]
    plant.reset()
    assert float(plant.step(0.0)) == 2.0


def test_figure3_runs_and_leaves_its_files(tmp_path, capsys):
    figure3_masses.main(["--seeds", "2", "--workers", "1", "--out", str(tmp_path)])
    for name in ("mass_poi.csv", "mass_rand.csv"):
        table = np.loadtxt(tmp_path / name, skiprows=1)
        assert (tmp_path / name).read_text().splitlines()[0] == "iter rho1 rho2 rho3"
        np.testing.assert_allclose(table[:, 0], 0.1 * np.arange(200), atol=1e-9)
    assert (tmp_path / "figure3_masses.png").stat().st_size > 10_000
    result = json.loads((tmp_path / "figure3_masses.json").read_text())
    assert result["unsolved"] == 0 and result["nominal"]["max"] < 1e-9
    poison = [level["poison"]["mean"] for level in result["levels"]]
    assert poison == sorted(poison) and 0.03 < poison[-1] < 0.06
    assert all(level["ratio"] > 1 for level in result["levels"])

    report.main(["--out", str(tmp_path)])
    text = (tmp_path / "report.md").read_text()
    assert "| Figure 3: errors on axes from 0 to 0.1 m, Algorithm 1 above random noise | " in text
    assert "figure3_masses.png" in text and "Not made: run `python -m scripts.figure4_quadrotor`" in text


# --- the stored flight -----------------------------------------------------------------------------------------------


def test_recorded_flight_excites_the_quadrotor_and_algorithm_1_works_on_it():
    u, y = recordings.quadrotor_recording()
    case = Quadrotor()
    layer = case.layer(case.hankel(u, y))
    assert layer.data.n_g == 500 and layer.data.rank == layer.data.Up.shape[0] + 31 * 6 + 25 * 3
    window = (u[100:106], y[100:106])
    references = {"y_ref": case.circle(25)}
    cost = case.target()
    budget = dpc.attacks.RelativeBall(0.003)
    p = dpc.attacks.LinearizedAttack(layer, cost, budget)(*window, **references)
    noise = dpc.attacks.RandomAttack(budget)(window[1], window[1], generator=torch.Generator().manual_seed(0))
    plain, random, poisoned = (cost(layer(window[0], window[1] + q, **references)) for q in (0 * p, noise, p))
    assert poisoned < plain and poisoned < random


def test_recorded_flight_is_what_the_recipe_gives():
    pytest.importorskip("pybullet", reason="the quadrotor simulation needs pybullet (Python <= 3.11)")
    for stored, flown in zip(recordings.quadrotor_recording(), recordings.fly_again(), strict=True):
        np.testing.assert_allclose(flown, stored, atol=SAME_FLIGHT)


def test_film_draws_points_where_the_camera_sees_them():
    pytest.importorskip("pybullet", reason="the quadrotor simulation needs pybullet (Python <= 3.11)")
    with dpc.systems.Quadrotor() as plant:
        plant.reset(position=(0.0, -3.0, 1.0))
        empty = plant.render(WIDTH, HEIGHT, **CAMERA).astype(int)
        place = np.array([[0.2, 0.3, 1.0]])
        plant.reset(position=place[0])
        seen = np.abs(plant.render(WIDTH, HEIGHT, **CAMERA) - empty).sum(axis=2) > 0
    x, y = project(place)
    row, column = np.argwhere(seen[: int(y[0]) + 30]).mean(axis=0)  # without the shadow on the ground below
    assert abs(column - x[0]) < 5 * PIXEL and abs(row - y[0]) < 5 * PIXEL
