"""Weights that hold under attack: tuned, then judged where they could cheat; beyond the paper.

    python -m scripts.tune_regularization                   # about 20 minutes on two cores
    python -m scripts.tune_regularization --plants masses --quick

lambda_g, lambda_s and the diagonals of Q and R are tuned on recorded windows of three training recordings
(torch_dpc.tuning), by the gradient and by Optuna at the same processor time; and once more on data with the ridge of
study_noise.py. Validation recordings choose one point of each kind by `QUICK_TRIALS`: no scenario without an attack may
get worse. Each tuned point that may be chosen is tried with the ridge, too. Held-out recordings then judge three
candidates by all `TRIALS` (scripts/regularization/trials.py): the tuned weights, the paper's weights with the ridge,
and tuned weights with it; from rest away from the reference, from random starts, pushed, with a changing reference,
under random noise, Algorithm 1, projected gradient, a black box and a trained policy, each attacker knowing the
weights. Rows are saved as they are made; a killed run goes on where it stopped (--fresh begins anew; --quick has files
of its own). Leaves, in results/:

    tuning_{plant}.csv          one row a closed-loop run: mean and largest error [m]
    tuning_{plant}_points.csv   the weights of every point, and what the search that found it cost
    tuning_{plant}_course.csv   every evaluation of every search
    tuning_{plant}.png, .md     before and after, every point, tables
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.all_cases import CASES
from scripts.experiments.case import Case, Weights
from scripts.regularization.objectives import HELD_OUT_FROM, VALIDATION
from scripts.regularization.picture import draw
from scripts.regularization.report import (
    HELD_OUT,
    RIDGE,
    VALIDATED,
    candidates,
    has_ridge,
    twins,
    without_ridge,
    write_report,
)
from scripts.regularization.search import (
    ATTACKED_WEIGHTS,
    GUARDED,
    METHODS,
    ONLY_LAMBDAS,
    REFINED,
    RIDGE_SIZE,
    RIDGED,
    SAMPLED,
    STEPS,
    Found,
    searches,
)
from scripts.regularization.trials import QUICK_TRIALS, TRIALS, Trial, run_trials
from scripts.shared.command import arguments, versions
from scripts.shared.tables import Table, as_they_finish

POINT = ("case", "point", "method", "attacked_weight", "evaluations", "seconds", "total", "lambda_g", "lambda_s")
COURSE = ("case", "point", "evaluation", "seconds", "nominal", "attacked", "total")
RUN = ("case", "point", "split", "seed", "trial", "error", "largest", "unsolved")
POINTS_A_JOB = 6
QUICK_STEPS = 5


def search_jobs(case: str, methods: Sequence[str]) -> list[tuple[str, float, tuple[str, ...]]]:
    """Return the searches of one case; those that need another's time or point follow it in one job."""
    in_turn = (("attack", "tpe"), (SAMPLED, REFINED))
    jobs: list[tuple[str, float, tuple[str, ...]]] = [
        (case, 1.0, some) for group in in_turn if (some := tuple(m for m in group if m in methods))
    ]
    jobs += [(case, w, ("attack",)) for w in ATTACKED_WEIGHTS if w != 1.0 and "attack" in methods]
    return [*jobs, *((case, 1.0, (m,)) for m in (GUARDED, RIDGED, "danskin", ONLY_LAMBDAS) if m in methods)]


def label(method: str, attacked_weight: float) -> str:
    """Return the name of a point."""
    return f"{method} {attacked_weight:g}"


def search(case: str, attacked_weight: float, methods: tuple[str, ...], steps: int) -> tuple[str, list[Found]]:
    """Run one job of `search_jobs`, in a process of its own."""
    return case, searches(case, attacked_weight, methods, steps)


def run_points(
    case_name: str, split: str, seed: int, points: dict[str, Weights], trials: Sequence[Trial]
) -> list[dict[str, Any]]:
    """Run points in closed loop on one recording; return one row a run."""
    torch.set_num_threads(1)
    case, rows = CASES[case_name], []
    with case.system() as plant:
        u, y = case.record(plant, seed)
        data = case.hankel(u, y)
        for name, weights in points.items():
            layer = case.layer(data.with_ridge(RIDGE_SIZE * y.std(0)) if has_ridge(name) else data, weights)
            keys = {"case": case_name, "point": name, "split": split}
            rows += [keys | row for row in run_trials(case, plant, layer, seed, trials)]
    return rows


def validation_jobs(case: Case, tuned: dict[str, Weights]) -> list[tuple[Any, ...]]:
    """Return the closed-loop jobs that come before the choice: (case, split, seed, points, trials)."""
    points = {"paper": case.paper(), RIDGE: case.paper(), **tuned}
    names = list(points)
    parts = [names[i : i + POINTS_A_JOB] for i in range(0, len(names), POINTS_A_JOB)]
    return [
        (case.name, VALIDATED, seed, {n: points[n] for n in some}, QUICK_TRIALS)
        for seed in VALIDATION
        for some in parts
    ]


def judge_jobs(case: Case, points: dict[str, Weights], seeds: int) -> list[tuple[Any, ...]]:
    """Return the jobs that judge points by every trial on held-out recordings."""
    return [
        (case.name, HELD_OUT, HELD_OUT_FROM + i, {name: weights}, TRIALS)
        for i in range(seeds)
        for name, weights in points.items()
    ]


def missing(jobs: list[tuple[Any, ...]], done: set[tuple[str, ...]]) -> list[tuple[Any, ...]]:
    """Return the jobs of which a row is missing, with the points and the trials that miss one."""
    left = []
    for case, split, seed, points, trials in jobs:
        todo = {n: [t for t in trials if (case, n, split, str(seed), t.name) not in done] for n in points}
        some = {name: points[name] for name, open_trials in todo.items() if open_trials}
        if some:
            open_names = {t.name for open_trials in todo.values() for t in open_trials}
            left.append((case, split, seed, some, tuple(t for t in trials if t.name in open_names)))
    return left


def point_columns(weights: Weights) -> dict[str, float]:
    """Return weights as columns."""
    diagonals = {"Q": weights.Q, "R": weights.R}
    entries = {f"{name}{i + 1}": v for name, diagonal in diagonals.items() for i, v in enumerate(diagonal)}
    return {"lambda_g": weights.lambda_g, "lambda_s": weights.lambda_s, **entries}


def weights_of(row: dict[str, str]) -> Weights:
    """Return the weights in a row of points."""
    Q, R = (tuple(float(v) for k, v in row.items() if k[0] == n and k[1:].isdigit()) for n in "QR")
    return Weights(float(row["lambda_g"]), float(row["lambda_s"]), Q, R)


def tune_plant(
    plant: str, out: Path, seeds: int, workers: int, methods: Sequence[str], steps: int = STEPS, suffix: str = ""
) -> None:
    """Search, run and report for one plant."""
    stem = f"tuning_{plant}{suffix}"
    cases = [case for case in CASES.values() if case.plant == plant]
    entries = tuple(point_columns(cases[0].paper()))[2:]
    points = Table(out / f"{stem}_points.csv", (*POINT, *entries))
    course = Table(out / f"{stem}_course.csv", COURSE)
    runs = Table(out / f"{stem}.csv", RUN)

    found = {(row["case"], row["point"]) for row in points.rows()}
    wanted = [job for case in cases for job in search_jobs(case.name, methods)]
    jobs: list[tuple[Any, ...]] = [
        (*job, steps) for job in wanted if any((job[0], label(m, job[1])) not in found for m in job[2])
    ]
    for case, results in tqdm(as_they_finish(search, jobs, workers), total=len(jobs), desc=f"{plant}: search"):
        for result in results:
            name = label(result.method, result.attacked_weight)
            if (case, name) in found:
                continue
            course.add({"case": case, "point": name, **row} for row in result.history)
            head = {"case": case, "point": name, "method": result.method, "attacked_weight": result.attacked_weight}
            cost = {"evaluations": len(result.history), "seconds": result.seconds}
            points.add([{**head, **cost, "total": result.best["total"], **point_columns(result.weights)}])

    tuned = {c.name: {r["point"]: weights_of(r) for r in points.rows() if r["case"] == c.name} for c in cases}
    close_loops(runs, [job for c in cases for job in validation_jobs(c, tuned[c.name])], workers, plant)
    for c in cases:  # every point that may be chosen is tried once more with the ridge
        tuned[c.name] |= {n: tuned[c.name][without_ridge(n)] for n in twins(points.rows(), runs.rows(), c)}
    close_loops(runs, [job for c in cases for job in validation_jobs(c, tuned[c.name])], workers, f"{plant}, ridge")
    known = {c.name: {"paper": c.paper(), RIDGE: c.paper(), **tuned[c.name]} for c in cases}
    judged = {c.name: ["paper", *candidates(points.rows(), runs.rows(), c)] for c in cases}
    jobs = [job for c in cases for job in judge_jobs(c, {n: known[c.name][n] for n in judged[c.name]}, seeds)]
    close_loops(runs, jobs, workers, f"{plant}, every trial")
    note = (
        versions(seeds, workers).split(";")[0] + f"; held-out recordings {HELD_OUT_FROM} to {HELD_OUT_FROM + seeds - 1}"
    )
    write_report(out / f"{stem}.md", cases, points.rows(), runs.rows(), note)
    draw(out / f"{stem}.png", cases, points.rows(), runs.rows())


def close_loops(runs: Table, jobs: list[tuple[Any, ...]], workers: int, label: str) -> None:
    """Run what is missing of some closed-loop jobs."""
    keys = ("case", "point", "split", "seed", "trial")
    jobs = missing(jobs, {tuple(row[key] for key in keys) for row in runs.rows()})
    for rows in tqdm(as_they_finish(run_points, jobs, workers), total=len(jobs), desc=f"{label}: closed loop"):
        runs.add(rows)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=6)
    parser.add_argument("--plants", nargs="+", choices=("masses", "quadrotor"), default=["masses", "quadrotor"])
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), default=list(METHODS), help="searches to compare"
    )
    parser.add_argument("--quick", action="store_true", help="two held-out recordings, searches of 5 steps")
    parser.add_argument("--fresh", action="store_true", help="forget what an earlier run has saved")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    for plant in args.plants:
        if plant == "quadrotor" and not has_simulator():
            print("NOTE: without PyBullet there is no quadrotor: pip install '.[quadrotor]'")
            continue
        if args.fresh:
            for path in out.glob(f"tuning_{plant}*.csv"):
                path.unlink()
        began = time.perf_counter()
        if args.quick:
            tune_plant(plant, out, 2, args.workers, args.methods, QUICK_STEPS, "_quick")
        else:
            tune_plant(plant, out, args.seeds, args.workers, args.methods)
        print(f"Tuning, {plant}: {time.perf_counter() - began:.0f} s")


def has_simulator() -> bool:
    try:
        with dpc.systems.Quadrotor():
            return True
    except ImportError:
        return False


if __name__ == "__main__":
    main()
