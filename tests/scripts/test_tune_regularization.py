"""The tuning script: tables that survive kills, cases that are the figures', and the files a short run leaves."""

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")


from scripts import tune_regularization as script
from scripts.experiments.all_cases import CASES
from scripts.experiments.case import Weights, run_seed
from scripts.experiments.masses import Masses, MovingTarget
from scripts.regularization import report
from scripts.regularization.objectives import objectives
from scripts.shared.tables import Table, as_they_finish
from torch_dpc import tuning


def test_a_table_keeps_whole_lines_only(tmp_path):
    path = tmp_path / "table.csv"
    Table(path, ("a", "b")).add([{"a": 1, "b": 0.1}, {"a": "x,y", "b": 1 / 3}])
    with path.open("a") as file:
        file.write("3,0.")  # a kill in the middle of a line
    again = Table(path, ("a", "b"))
    assert again.rows() == [{"a": "1", "b": "0.1"}, {"a": "x,y", "b": "0.333333333"}]
    again.add([{"a": 4, "b": 4.0}])
    assert [row["a"] for row in again.rows()] == ["1", "x,y", "4"]
    assert Table(path, ("a", "c")).rows() == []  # other columns: begun anew


def test_every_job_comes_back_whatever_the_number_of_processes():
    jobs = [(i,) for i in range(5)]
    assert sorted(as_they_finish(abs, jobs, 1)) == sorted(as_they_finish(abs, jobs, 2)) == list(range(5))


def test_only_what_is_missing_is_run_again():
    case = CASES["held"]
    jobs = script.run_jobs(case, {"attack 1": case.paper()}, seeds=2)
    rows = [
        (c, n, split, str(s), a, f"{r:.9g}")
        for c, split, s, points, attacks in jobs
        for n in points
        for a, r in attacks
    ]
    assert len(rows) == len(set(rows))  # no run twice
    assert script.missing(jobs, set(rows)) == []
    left = script.missing(jobs, set(rows) - {rows[0]})
    assert [(j[0], j[1], j[2], list(j[3])) for j in left] == [("held", jobs[0][1], jobs[0][2], ["paper"])]


def test_the_masses_run_as_in_figure_3():
    (figure,) = [r for r in run_seed(Masses(), 1, [0.1]) if r["attack"] == "algorithm1"]
    case = CASES["held"]
    with case.system() as plant:
        run = case.run(plant, case.layer(case.data(plant, 1), case.paper()), 1, "algorithm1", 0.1)
    assert run.error == pytest.approx(figure["error"].mean(), rel=1e-12)


def test_windows_continue_as_the_run_did():
    """The objective's first plan of a window is the plan of the closed loop there, attack and all."""
    case = CASES["held"]
    with case.system() as plant:
        objective = objectives(case, plant, case.paper())[0]
    scales = tuning.WeightScales(objective.layer)
    nominal, attacked = objective.costs(scales)
    half = len(nominal) // 2  # windows of the run without attack come first, at rest on the reference
    assert nominal[:half].max() < 1e-6 < attacked[:half].min()
    assert (objective.y_ref == torch.tensor(case.y_ref)).all()


def test_a_moving_target_is_the_attackers_at_each_start():
    trajectory = torch.arange(20.0)[:, None].expand(-1, 2)
    psi = MovingTarget(trajectory, torch.tensor([0, 7])).at(3)

    class Plan:
        u = torch.stack([trajectory[3:8], trajectory[10:15]])

    assert (psi(Plan) == 0).all()


def test_weights_survive_the_table(tmp_path):
    weights = Weights(1e2, 1e6, (1.0, 2.0, 3.0, 4.0), (5.0, 6.0))
    columns = script.point_columns(weights)
    table = Table(tmp_path / "points.csv", (*script.POINT, *list(columns)[2:]))
    table.add([{"case": "held", "point": "a", "evaluations": 1, **columns}])
    assert script.weights_of(table.rows()[0]) == weights


def test_the_choice_respects_the_nominal_limit():
    def run(point, attack, error, split=report.VALIDATED):
        keys = {"case": "moving", "point": point, "split": split, "seed": "100", "attack": attack}
        return {**keys, "rho": "0" if attack == "nominal" else "0.1", "error": str(error)}

    runs = [run("paper", "nominal", 1.0), run("paper", "algorithm1", 2.0)]
    runs += [run("attack 1", "nominal", 1.05), run("attack 1", "algorithm1", 1.5)]
    runs += [run("attack 3", "nominal", 1.2), run("attack 3", "algorithm1", 1.0)]
    points = [{"case": "moving", "point": f"attack {w}", "method": "attack"} for w in (1, 3)]
    assert report.choose(points, runs, CASES["moving"]) == "attack 1"


@pytest.mark.slow
def test_a_short_run_leaves_its_files_and_is_not_repeated(tmp_path, monkeypatch):
    pytest.importorskip("optuna", reason="the comparison needs Optuna: pip install '.[tuning]'")
    monkeypatch.setattr(script, "LAMBDA_S", (1e4, 1e6))
    arguments = ["--plants", "masses", "--quick", "--workers", "1", "--out", str(tmp_path)]
    script.main(arguments)
    text = (tmp_path / "tuning_masses_quick.md").read_text()
    assert text.count("**chosen**") == 2 and "Optuna, TPE" in text
    assert (tmp_path / "tuning_masses_quick.png").stat().st_size > 10_000
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
    script.main(arguments)
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
