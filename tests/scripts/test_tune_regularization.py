"""The tuning script: tables that survive kills, cases that are the figures', and the files a short run leaves."""

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")


from scripts import tune_regularization as script
from scripts.experiments.all_cases import CASES
from scripts.experiments.case import Weights, run_seed
from scripts.experiments.masses import Masses, MovingTarget
from scripts.experiments.scenario import AWAY, CHANGING, FIGURE, PUSHED, RANDOM_START, SCENARIOS
from scripts.regularization import report
from scripts.regularization import trials as trials_of
from scripts.regularization.objectives import ATTACKED, PRICE, objectives
from scripts.regularization.trials import QUICK_TRIALS, Trial, dominates, verdicts
from scripts.shared.tables import Table, as_they_finish
from torch_dpc import tuning

HOLDING = Weights(1e2, 1e6, (1e-6,) * 4, (1e6, 1e6))  # the input stays at its reference whatever is measured
RIDGE = {"guarded": True, "ridge": 1e-2}


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
    jobs = script.validation_jobs(case, {"attack 1": case.paper()})
    jobs += script.judge_jobs(case, {"paper": case.paper(), "attack 1": case.paper()}, seeds=2)
    rows = [(c, n, split, str(s), t.name) for c, split, s, points, trials in jobs for n in points for t in trials]
    assert len(rows) == len(set(rows))  # no run twice
    assert script.missing(jobs, set(rows)) == []
    left = script.missing(jobs, set(rows) - {rows[0]})
    assert [(j[0], j[1], j[2], list(j[3])) for j in left] == [("held", jobs[0][1], jobs[0][2], ["paper"])]
    assert [trial.name for trial in left[0][4]] == [rows[0][4]]


def test_the_masses_run_as_in_figure_3():
    (figure,) = [r for r in run_seed(Masses(), 1, [0.1]) if r["attack"] == "algorithm1"]
    case = CASES["held"]
    with case.system() as plant:
        run = case.run(plant, case.layer(case.data(plant, 1), case.paper()), 1, "algorithm1", 0.1)
    assert run.error == pytest.approx(figure["error"].mean(), rel=1e-12)


def test_windows_come_from_every_scenario():
    """Without an attack a run that starts on the reference stays there; all the others leave it."""
    case = CASES["held"]
    with case.system() as plant:
        objective = objectives(case, plant, case.paper())[0]
    scales = tuning.WeightScales(objective.layer)
    nominal, _ = objective.costs(scales)
    runs = nominal.reshape(len(SCENARIOS) + len(ATTACKED), -1)
    order = [s for scenario in SCENARIOS for s in (scenario,) * (2 if scenario in ATTACKED else 1)]
    assert runs[0].max() < 1e-6 and order[0] == order[1] == FIGURE
    assert all(runs[i, 0] > 1e-3 for i, scenario in enumerate(order) if scenario in (AWAY, RANDOM_START))
    held = (objective.y_ref == torch.tensor(case.y_ref)).flatten(1).all(1).reshape(len(order), -1)
    assert [bool(row.all()) for row in held] == [scenario != CHANGING for scenario in order]


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


def test_the_guard_charges_what_the_papers_weights_do_not_cost():
    """At the paper's weights nothing is above the guard; holding the input costs much in the runs that start away."""
    case = CASES["held"]
    with case.system() as plant:
        (plain, guarded, ridged), holding = (
            [objectives(case, plant, case.paper(), **options)[0] for options in ({}, {"guarded": True}, RIDGE)],
            objectives(case, plant, HOLDING, guarded=True)[0],
        )
    scales = tuning.WeightScales(plain.layer)
    values = [{k: float(v.detach()) for k, v in goal(scales).items()} for goal in (plain, guarded, holding)]
    assert values[0] == pytest.approx(values[1], rel=1e-9)
    assert values[2]["total"] > values[2]["nominal"] + values[2]["attacked"] + 0.1 * PRICE
    assert ridged.layer.data.n_g == plain.layer.data.n_g + case.t_ini * plain.layer.data.n_y
    assert torch.equal(ridged.allowed, guarded.allowed)


def rows_of(point, errors, split, seeds=(1, 2, 3, 4)):
    """Rows of the quick trials of one point: the same error in every scenario without an attack, and Algorithm 1's."""
    nominal, attacked = errors
    return [
        {"case": "moving", "point": point, "split": split, "trial": trial.name, "seed": str(seed)}
        | {"error": str((attacked if trial.attack == "algorithm1" else nominal) * (1 + 0.01 * seed))}
        for trial in QUICK_TRIALS
        for seed in seeds
    ]


def test_the_choice_is_never_worse_in_any_scenario():
    points = [{"case": "moving", "point": f"attack {w}", "method": "attack"} for w in (1, 3)]
    runs = rows_of("paper", (1.0, 2.0), report.VALIDATED)
    runs += rows_of("attack 1", (1.01, 1.5), report.VALIDATED)  # 1 % more counts as the same
    runs += rows_of("attack 3", (0.9, 1.0), report.VALIDATED)
    assert report.choose(points, runs, CASES["moving"]) == "attack 3"
    away = next(r for r in runs if r["point"] == "attack 3" and r["trial"].startswith("from rest"))
    away["error"] = "3.0"  # worse in a single scenario
    assert report.choose(points, runs, CASES["moving"]) == "attack 1"
    assert report.choose([], runs, CASES["moving"]) == "paper"
    growth, trial = report.excess(runs, CASES["moving"], "attack 3")
    assert trial == away["trial"] and growth > 0.3


def test_points_with_the_ridge_are_chosen_apart():
    points = [{"case": "moving", "point": name, "method": name.split()[0]} for name in ("guarded 1", "ridged 1")]
    runs = rows_of("paper", (1.0, 2.0), report.VALIDATED) + rows_of("ridge", (0.9, 1.0), report.VALIDATED)
    runs += rows_of("guarded 1", (1.1, 0.1), report.VALIDATED)  # pays with tracking
    runs += rows_of("ridged 1", (0.8, 0.9), report.VALIDATED)
    assert report.twins(points, runs, CASES["moving"]) == []  # none without the ridge may be chosen
    assert report.choose(points, runs, CASES["moving"]) == "paper"
    assert report.choose(points, runs, CASES["moving"], ridged=True) == "ridged 1"
    names = {"ridge": "paper's weights, ridge", "ridged 1": "weights tuned with the ridge"}
    assert report.candidates(points, runs, CASES["moving"]) == names
    fit = [{"case": "moving", "point": "attack 0.3", "method": "attack"}]
    runs += rows_of("attack 0.3", (0.7, 2.1), report.VALIDATED)  # better without an attack, no better under it
    assert report.twins(points + fit, runs, CASES["moving"]) == ["ridge and attack 0.3"]
    runs += rows_of("ridge and attack 0.3", (0.7, 0.8), report.VALIDATED)
    names = {"ridge": "paper's weights, ridge", "ridge and attack 0.3": "tuned weights and the ridge"}
    assert report.candidates(points + fit, runs, CASES["moving"]) == names


# --- the judgement ----------------------------------------------------------------------------------------------------


def judged_against_the_paper(case, weights, seeds, trials):
    rows = []
    with case.system() as plant:
        for seed in seeds:
            data = case.data(plant, seed)
            for point, tried in (("paper", None), ("tuned", weights)):
                found = trials_of.run_trials(case, plant, case.layer(data, tried), seed, trials)
                rows += [{"case": case.name, "point": point, **row} for row in found]
    return rows


def test_a_controller_that_holds_the_input_is_rejected(monkeypatch):
    """On the masses of Figure 3 it is perfect without an attack and hardly moved by one; it no longer controls."""
    monkeypatch.setattr(trials_of, "TRIALS", QUICK_TRIALS)
    rows = judged_against_the_paper(CASES["held"], HOLDING, range(3), QUICK_TRIALS)
    found = {v.trial: v for v in verdicts(rows, "held", "paper", "tuned")}
    figure, attacked = Trial(FIGURE, "nominal").name, Trial(FIGURE, "algorithm1").name
    assert found[figure].says == "same" and found[attacked].says == "better"
    assert found[attacked].after.max() < 0.1 * found[attacked].before.min()
    assert found[Trial(AWAY, "nominal").name].says == "worse"
    assert not dominates(list(found.values()))
    points = [{"case": "held", "point": "tuned", "method": "attack"}]
    rows = [row | {"split": report.VALIDATED} for row in rows]
    assert report.choose(points, rows, CASES["held"]) == "paper"


def test_weights_dominate_only_where_the_intervals_say_so(monkeypatch):
    monkeypatch.setattr(trials_of, "TRIALS", QUICK_TRIALS)
    rows = rows_of("paper", (1.0, 2.0), "") + rows_of("tuned", (0.99, 1.0), "")
    assert dominates(verdicts(rows, "moving", "paper", "tuned"))
    spoiled = next(r for r in rows if r["point"] == "tuned" and r["seed"] == "4")
    spoiled["error"] = "2.0"  # one seed of one trial: its interval now reaches a worsening
    assert not dominates(verdicts(rows, "moving", "paper", "tuned"))
    assert not dominates(
        verdicts(rows_of("paper", (1, 2), "") + rows_of("same", (1, 2), ""), "moving", "paper", "same")
    )


def test_pushes_are_unseen_and_start_after_the_warm_up():
    case = CASES["held"]
    with case.system() as plant:
        layer = case.layer(case.data(plant, 0))
        log = case.simulate(plant, layer, 0, None, PUSHED)
    moved = (log.y - torch.tensor(case.y_ref)).norm(dim=1)
    assert moved[0] < 1e-12 and (moved[1:11] > 1e-4).all()
    assert (log.u.abs() <= 1 + 1e-9).all()  # what the controller asked for, not what the plant got


@pytest.mark.slow
def test_every_attacker_runs_and_the_policy_learns():
    case = CASES["held"]
    with case.system() as plant:
        layer = case.layer(case.data(plant, 0))
        rows = trials_of.run_trials(case, plant, layer, 0)
    error = {row["trial"]: row["error"] for row in rows}
    assert len(error) == len(trials_of.TRIALS) and not any(row["unsolved"] for row in rows)
    assert error[Trial(FIGURE, "policy").name] > 1.5 * error[Trial(FIGURE, "random").name]


@pytest.mark.slow
def test_a_short_run_leaves_its_files_and_is_not_repeated(tmp_path):
    pytest.importorskip("optuna", reason="the comparison needs Optuna: pip install '.[tuning]'")
    arguments = ["--plants", "masses", "--quick", "--workers", "1", "--out", str(tmp_path)]
    arguments += ["--methods", "guarded", "ridged", "attack", "tpe"]
    script.main(arguments)
    text = (tmp_path / "tuning_masses_quick.md").read_text()
    assert text.count("| from rest away from the reference, no attack |") == 2 and "Optuna, TPE" in text
    assert (tmp_path / "tuning_masses_quick.png").stat().st_size > 10_000
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
    script.main(arguments)
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
