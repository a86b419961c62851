"""Weights that hold under attack: Pareto front of nominal against attacked error, before and after; beyond the paper.

    python -m scripts.tune_regularization                   # 11 minutes on two cores, busy with other work too
    python -m scripts.tune_regularization --plants masses --quick

lambda_g, lambda_s and the diagonals of Q and R are tuned on recorded windows of three training recordings
(torch_dpc.tuning), by the gradient and by Optuna at the same processor time, and judged in closed loop on held-out
recordings by an attacker who knows the tuned weights. A grid over lambda_g and lambda_s alone is the backdrop. Rows are
saved as they are made; a killed run goes on where it stopped (--fresh begins anew; --quick has
files of its own). Leaves, in results/:

    tuning_{plant}.csv          one row a closed-loop run: mean and largest error [m]
    tuning_{plant}_points.csv   the weights of every point, and what the search that found it cost
    tuning_{plant}_course.csv   every evaluation of every search
    tuning_{plant}.png, .md     front, course, tables
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.all_cases import CASES
from scripts.experiments.case import Case, Run, Weights
from scripts.regularization.objectives import HELD_OUT_FROM, VALIDATION
from scripts.regularization.report import HELD_OUT, VALIDATED, choose, write_report
from scripts.regularization.search import ATTACKED_WEIGHTS, ONLY_LAMBDAS, STEPS, Found, searches
from scripts.shared.command import arguments, versions
from scripts.shared.tables import Table, as_they_finish

LAMBDA_G = (1e0, 1e2, 1e4, 1e6)
LAMBDA_S = (1e2, 1e3, 1e4, 1e5, 1e6, 1e8)
POINT = ("case", "point", "method", "attacked_weight", "evaluations", "seconds", "total", "lambda_g", "lambda_s")
COURSE = ("case", "point", "evaluation", "seconds", "nominal", "attacked", "total")
RUN = ("case", "point", "split", "seed", "attack", "rho", "error", "largest", "unsolved")
GRID_SEEDS = 4  # held-out recordings on which the backdrop is run
POINTS_A_JOB = 6
QUICK_STEPS = 5


def search_jobs(case: str) -> list[tuple[str, float, tuple[str, ...]]]:
    """Return the searches of one case; those of Optuna follow the one whose time they are given."""
    jobs: list[tuple[str, float, tuple[str, ...]]] = [(case, 1.0, ("attack", "tpe", "cmaes", "both"))]
    jobs += [(case, w, ("attack",)) for w in ATTACKED_WEIGHTS if w != 1.0]
    return [*jobs, (case, 1.0, ("danskin",)), (case, 1.0, (ONLY_LAMBDAS,))]


def label(method: str, attacked_weight: float) -> str:
    """Return the name of a point."""
    return f"{method} {attacked_weight:g}"


def search(case: str, attacked_weight: float, methods: tuple[str, ...], steps: int) -> tuple[str, list[Found]]:
    """Run one job of `search_jobs`, in a process of its own."""
    return case, searches(case, attacked_weight, methods, steps)


def grid(case: Case) -> dict[str, Weights]:
    """Return the backdrop: the paper's Q and R under other lambdas."""
    paper = case.paper()
    return {f"grid {g:g} {s:g}": paper._replace(lambda_g=g, lambda_s=s) for g in LAMBDA_G for s in LAMBDA_S}


def run_points(
    case_name: str, split: str, seed: int, points: dict[str, Weights], attacks: list[tuple[str, float]]
) -> list[dict[str, Any]]:
    """Run points in closed loop on one recording; return one row a run."""
    torch.set_num_threads(1)
    case = CASES[case_name]
    rows = []
    with case.system() as plant:
        data = case.data(plant, seed)
        for name, weights in points.items():
            layer = case.layer(data, weights)
            for attack, rho in attacks:
                run: Run = case.run(plant, layer, seed, attack, rho)
                keys = {"case": case_name, "point": name, "split": split, "seed": seed, "attack": attack, "rho": rho}
                rows.append(keys | run._asdict())
    return rows


def run_jobs(case: Case, tuned: dict[str, Weights], seeds: int) -> list[tuple[Any, ...]]:
    """Return the closed-loop jobs of a case: (case, split, seed, points, attacks)."""
    pair, held_out = [("nominal", 0.0), ("algorithm1", case.rho)], range(HELD_OUT_FROM, HELD_OUT_FROM + seeds)
    jobs: list[tuple[Any, ...]] = []

    def add(split: str, some: Any, points: dict[str, Weights], attacks: list[tuple[str, float]]) -> None:
        names = list(points)
        for seed in some:
            for i in range(0, len(names), POINTS_A_JOB):
                jobs.append((case.name, split, seed, {n: points[n] for n in names[i : i + POINTS_A_JOB]}, attacks))

    points = {"paper": case.paper(), **tuned}
    add(VALIDATED, VALIDATION, points, pair)
    add(HELD_OUT, held_out, points, pair)
    add(HELD_OUT, held_out[:GRID_SEEDS], grid(case), pair)
    return jobs


def other_jobs(case: Case, chosen: dict[str, Weights], seeds: int) -> list[tuple[Any, ...]]:
    """Return the jobs that run the paper's and the chosen weights under the attacks that nothing was tuned against."""
    others = [
        (a, r) for r in case.rhos for a in ("random", "algorithm1", "other") if (a, r) != ("algorithm1", case.rho)
    ]
    points = {"paper": case.paper(), **chosen}
    return [(case.name, HELD_OUT, HELD_OUT_FROM + i, points, others) for i in range(seeds)]


def missing(jobs: list[tuple[Any, ...]], done: set[tuple[str, ...]]) -> list[tuple[Any, ...]]:
    """Return the jobs of which a row is missing, with the points that miss one."""
    left = []
    for case, split, seed, points, attacks in jobs:
        some = {
            name: weights
            for name, weights in points.items()
            if any((case, name, split, str(seed), attack, f"{rho:.9g}") not in done for attack, rho in attacks)
        }
        if some:
            left.append((case, split, seed, some, attacks))
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


def tune_plant(plant: str, out: Path, seeds: int, workers: int, steps: int = STEPS, suffix: str = "") -> None:
    """Search, run and report for one plant."""
    stem = f"tuning_{plant}{suffix}"
    cases = [case for case in CASES.values() if case.plant == plant]
    entries = tuple(point_columns(cases[0].paper()))[2:]
    points = Table(out / f"{stem}_points.csv", (*POINT, *entries))
    course = Table(out / f"{stem}_course.csv", COURSE)
    runs = Table(out / f"{stem}.csv", RUN)

    found = {(row["case"], row["point"]) for row in points.rows()}
    wanted = [job for case in cases for job in search_jobs(case.name)]
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
    close_loops(runs, [job for c in cases for job in run_jobs(c, tuned[c.name], seeds)], workers, plant)
    chosen = {c.name: choose(points.rows(), runs.rows(), c) for c in cases}
    jobs = [job for c in cases for job in other_jobs(c, {chosen[c.name]: tuned[c.name][chosen[c.name]]}, seeds)]
    close_loops(runs, jobs, workers, f"{plant}, other attacks")
    note = (
        versions(seeds, workers).split(";")[0] + f"; held-out recordings {HELD_OUT_FROM} to {HELD_OUT_FROM + seeds - 1}"
    )
    write_report(out / stem, cases, points.rows(), course.rows(), runs.rows(), note)


def close_loops(runs: Table, jobs: list[tuple[Any, ...]], workers: int, label: str) -> None:
    """Run what is missing of some closed-loop jobs."""
    keys = ("case", "point", "split", "seed", "attack", "rho")
    jobs = missing(jobs, {tuple(row[key] for key in keys) for row in runs.rows()})
    for rows in tqdm(as_they_finish(run_points, jobs, workers), total=len(jobs), desc=f"{label}: closed loop"):
        runs.add(rows)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=8)
    parser.add_argument("--plants", nargs="+", choices=("masses", "quadrotor"), default=["masses", "quadrotor"])
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
            tune_plant(plant, out, 2, args.workers, QUICK_STEPS, "_quick")
        else:
            tune_plant(plant, out, args.seeds, args.workers)
        print(f"Tuning, {plant}: {time.perf_counter() - began:.0f} s")


def has_simulator() -> bool:
    try:
        with dpc.systems.Quadrotor():
            return True
    except ImportError:
        return False


if __name__ == "__main__":
    main()
