"""Study: why noise in the recording protects: the sensitivity of the plan against noise, lambda_g and lambda_s.

    python -m scripts.study_noise               # about 10 minutes on two cores
    python -m scripts.study_noise --quick       # about 1 minute: two seeds

Both plants, ten recordings each. The sensitivity is max |du| / |p| of the plan without its bounds. It is measured on
recordings with noise, and on clean recordings with a *ridge*: extra windows that add to Yp Yp' what the noise adds on
average. Then the loop is closed, under no attack, random noise and Algorithm 1 at the largest rho: with noise, with the
ridge on clean data, and with other lambda_s. The masses follow a sinusoid from random starts. Rows are saved as they
are made; a run that is stopped goes on where it was (`--fresh` begins anew). Leaves, in results/:

    study_noise.csv             one row a closed-loop run
    study_noise_gain.csv        one row a sensitivity
    study_noise.md, .png        tables and picture
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from scripts.experiments.case import Case
from scripts.experiments.masses import MovingMasses
from scripts.experiments.quadrotor import Quadrotor
from scripts.experiments.sensitivity import plan_gain, unexplained, with_noise
from scripts.regularization.noise_report import ATTACKS, CLEAN, draw, report
from scripts.shared.command import arguments, versions
from scripts.shared.tables import Table, as_they_finish

CASES: dict[str, Case] = {"masses": replace(MovingMasses(), noise=0.0), "quadrotor": Quadrotor()}
SIZES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # of noise and ridge, relative to the spread of each output
LAMBDAS = {"lambda_s": tuple(10.0**k for k in range(0, 9)), "lambda_g": tuple(10.0**k for k in range(-2, 7))}
NOISES = (0.0, 1e-3, 1e-2)  # at which the lambdas are varied
CLOSED = {"noise": (1e-4, 1e-3, 1e-2, 1e-1), "ridge": (1e-4, 1e-3, 1e-2, 1e-1), "lambda_s": (1e2, 1e3, 1e4, 1e5)}
GAIN = ("plant", "seed", "kind", "size", "noise", "gain")
RUN = ("plant", "seed", "kind", "size", "attack", "error", "largest", "unsolved")


def gains(plant: str, seed: int) -> list[dict[str, Any]]:
    """Return the sensitivities of one recording, and the directions of its past outputs."""
    torch.set_num_threads(1)
    case = CASES[plant]
    with case.system() as system:
        u, y = case.record(system, seed)
    clean, paper, rows = case.hankel(u, y), case.paper(), []

    def add(kind: str, size: float, noise: float, value: float) -> None:
        rows.append({"plant": plant, "seed": seed, "kind": kind, "size": size, "noise": noise, "gain": value})

    add(CLEAN, 0.0, 0.0, plan_gain(case.layer(clean)))
    for size in SIZES:
        add("noise", size, size, plan_gain(case.layer(case.hankel(u, with_noise(y, size, seed)))))
        add("ridge", size, 0.0, plan_gain(case.layer(case.hankel(u, y, ridge=size))))
    for noise in NOISES:
        data = case.hankel(u, with_noise(y, noise, seed))
        for value in LAMBDAS["lambda_s"]:
            add("lambda_s", value, noise, plan_gain(case.layer(data, paper._replace(lambda_s=value))))
        for value in LAMBDAS["lambda_g"]:
            add("lambda_g", value, noise, plan_gain(case.layer(data, paper._replace(lambda_g=value))))
    for i, size in enumerate(unexplained(clean, y).tolist()):
        add("direction", float(i), 0.0, size)
    return rows


def close_loop(plant: str, seed: int, kind: str, size: float) -> list[dict[str, Any]]:
    """Return the runs of one seed with one change of data or weights."""
    torch.set_num_threads(1)
    case, rows = CASES[plant], []
    with case.system() as system:
        u, y = case.record(system, seed)
        recorded = with_noise(y, size, seed) if kind == "noise" else y
        data = case.hankel(u, recorded, ridge=size if kind == "ridge" else 0.0)
        weights = case.paper()._replace(lambda_s=size) if kind == "lambda_s" else case.paper()
        layer = case.layer(data, weights)
        for attack in ATTACKS:
            run = case.run(system, layer, seed, attack, case.rho)
            rows.append({"plant": plant, "seed": seed, "kind": kind, "size": size, "attack": attack} | run._asdict())
    return rows


def closed_jobs(seeds: Sequence[int]) -> list[tuple[str, int, str, float]]:
    """Return plant, seed, kind and size of every closed-loop job."""
    changes = [(CLEAN, 0.0), *((kind, size) for kind, sizes in CLOSED.items() for size in sizes)]
    return [(plant, seed, kind, size) for seed in seeds for plant in CASES for kind, size in changes]


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="two seeds")
    parser.add_argument("--fresh", action="store_true", help="forget what was run before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, began = range(2 if args.quick else args.seeds), time.perf_counter()
    if args.fresh:
        for name in ("study_noise.csv", "study_noise_gain.csv"):
            (out / name).unlink(missing_ok=True)
    measured, runs = Table(out / "study_noise_gain.csv", GAIN), Table(out / "study_noise.csv", RUN)

    known = {(row["plant"], int(row["seed"])) for row in measured.rows()}
    jobs: list[tuple[Any, ...]] = [(p, seed) for seed in seeds for p in CASES if (p, seed) not in known]
    for rows in tqdm(as_they_finish(gains, jobs, args.workers), total=len(jobs), desc="Sensitivity", unit="seed"):
        measured.add(rows)
    done = {(r["plant"], int(r["seed"]), r["kind"], float(r["size"])) for r in runs.rows()}
    jobs = [job for job in closed_jobs(seeds) if job not in done]
    for rows in tqdm(as_they_finish(close_loop, jobs, args.workers), total=len(jobs), desc="Closed loop", unit="run"):
        runs.add(rows)

    titles = {plant: f"{case.title}, rho {case.rho:.1%}" for plant, case in CASES.items()}
    lines = report(titles, measured.rows(), runs.rows(), seeds)
    note = versions(len(seeds), args.workers)
    (out / "study_noise.md").write_text("\n".join([*lines[:1], "", f"{note}.", *lines[1:]]) + "\n")
    draw(out / "study_noise.png", titles, measured.rows(), runs.rows(), seeds)
    print(f"Noise: {out / 'study_noise.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
