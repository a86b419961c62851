"""Study: robust predictive control beside the paper's plans and the ridge; beyond the paper.

    python -m scripts.study_robust                      # about 10 minutes on two cores: the masses
    python -m scripts.study_robust --plants quadrotor   # hours: a robust plan of the quadrotor takes half a second

Held-out recordings. `baselines.RobustDPC` plans for the worst measurement error within a share of the attacker's
budget. It has no derivative, so Algorithm 1 uses the paper's layer on the same recording as its surrogate, for every
controller; a black box of 20 queries attacks each controller itself. Rows are saved as they are made; a run that is
stopped goes on where it was (`--fresh` begins anew). Leaves, in results/:

    study_robust.csv    one row a closed-loop run
    study_robust.md     the table
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import torch_dpc as dpc
from baselines import RobustDPC
from scripts.experiments.case import Case
from scripts.experiments.masses import MovingMasses
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared import bootstrap
from scripts.shared.command import arguments, versions
from scripts.shared.rows import Array
from scripts.shared.tables import Table, as_they_finish
from torch_dpc import attacks

CASES: dict[str, Case] = {"masses": replace(MovingMasses(), noise=0.0), "quadrotor": Quadrotor()}
HELD_OUT_FROM = 9000  # recordings, as in tune_regularization.py
RIDGE = 1e-2  # of the spread of each output, what study_noise.py recommends
SHARES = (0.1, 1.0)  # of the attacker's budget, that a robust plan is made for
QUERIES = 20
PAPER, WITH_RIDGE = "the paper's", "with the ridge"
ROBUST = {f"robust, {share:g} rho": share for share in SHARES}
ATTACKS = ("no attack", "random noise", "Algorithm 1, surrogate", f"black box, {QUERIES} queries")
ROW = ("plant", "seed", "controller", "attack", "error", "largest", "unsolved")


def run(plant: str, seed: int, controller: str) -> list[dict[str, Any]]:
    """Return the runs of one controller on one recording."""
    torch.set_num_threads(1)
    case, rows = CASES[plant], []
    with case.system() as system:
        u, y = case.record(system, HELD_OUT_FROM + seed)
        data = case.hankel(u, y)
        paper = case.layer(data)
        layer: dpc.DPCLayer = paper
        if controller == WITH_RIDGE:
            layer = case.layer(data.with_ridge(RIDGE * y.std(0)))
        elif controller in ROBUST:
            layer = RobustDPC(paper, attacks.RelativeBallBudget(ROBUST[controller] * case.rho))
        cost, budget = case.target(), attacks.RelativeBallBudget(case.rho)
        makers = (
            None,
            attacks.RandomAttack(budget),
            attacks.LinearizedAttack(paper, cost, budget),
            attacks.RandomSearchAttack(layer, cost, budget, queries=QUERIES),
        )
        for name, attack in zip(ATTACKS, makers, strict=True):
            found = case.summed_up(case.simulate(system, layer, seed, attack))
            head = {"plant": plant, "seed": seed, "controller": controller, "attack": name}
            rows.append(head | found._asdict())
    return rows


def report(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the lines of study_robust.md."""
    lines = [
        "# Robust predictive control",
        "",
        "Mean error in closed loop [m], and its paired change from the paper's.",
    ]
    for plant, case in CASES.items():
        mine = [row for row in rows if row["plant"] == plant]
        if not mine:
            continue
        lines += ["", f"## {case.title.split(',')[0].capitalize()}, rho {100 * case.rho:g} %", ""]
        lines += ["| controller | " + " | ".join(ATTACKS) + " | no plan |", "|---" * (2 + len(ATTACKS)) + "|"]
        for controller in (PAPER, WITH_RIDGE, *ROBUST):
            cells = []
            for attack in ATTACKS:
                error, base = (errors(mine, name, attack) for name in (controller, PAPER))
                change = f", {bootstrap.difference(error, base):+.4f}" if controller != PAPER and len(error) > 1 else ""
                cells.append(f"{error.mean():.4f}{change}" if len(error) else "")
            unsolved = sum(int(row["unsolved"]) for row in mine if row["controller"] == controller)
            lines.append(f"| {controller} | " + " | ".join(cells) + f" | {unsolved} |")
    return lines


def errors(rows: Sequence[Mapping[str, str]], controller: str, attack: str) -> Array:
    """Return the error of each recording [m]."""
    mine = {int(r["seed"]): float(r["error"]) for r in rows if (r["controller"], r["attack"]) == (controller, attack)}
    return np.array([mine[seed] for seed in sorted(mine)])


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=5)
    parser.add_argument("--plants", nargs="+", choices=list(CASES), default=["masses"])
    parser.add_argument("--fresh", action="store_true", help="forget what was run before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    if args.fresh:
        (out / "study_robust.csv").unlink(missing_ok=True)
    table = Table(out / "study_robust.csv", ROW)
    done = {(row["plant"], int(row["seed"]), row["controller"]) for row in table.rows()}
    names = (PAPER, WITH_RIDGE, *ROBUST)
    jobs = [(plant, seed, name) for seed in range(args.seeds) for plant in args.plants for name in names]
    jobs = [job for job in jobs if job not in done]
    for rows in tqdm(as_they_finish(run, jobs, args.workers), total=len(jobs), desc="Robust", unit="controller"):
        table.add(rows)
    lines = report(table.rows())
    note = versions(args.seeds, args.workers)
    (out / "study_robust.md").write_text("\n".join([*lines[:1], "", f"{note}.", *lines[1:]]) + "\n")
    print(f"Robust: {out / 'study_robust.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
