"""Study: how much further attacks of several steps go than Algorithm 1, over every budget; beyond the paper.

    python -m scripts.study_attacks             # about 2 minutes on two cores
    python -m scripts.study_attacks --quick     # about 30 s: one seed, fewer windows

The settings of Figures 3 and 4 at their largest rho, on held-out windows of a recording that the controller has not
seen, for two costs: `TargetInput`, the figure's own, and `TrackingError`, the predicted true output driven away from
the reference; and in closed loop, with the paper's budget. Leaves, in results/:

    attacks.csv                 one row for each plant, seed, cost, budget and attack
    attacks_closed_loop.csv     one row for each plant, seed, cost and attack
    attacks.md                  decrease of psi as a share of Algorithm 1's, and the error in closed loop
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_dpc as dpc
from scripts.experiments.case import ATTACK_SEED
from scripts.experiments.surrogates import closed_loop, load, surrogate
from scripts.shared.command import arguments, run_all, versions
from scripts.shared.rows import Rows, read_rows, write_rows
from torch_dpc import attacks

SEEDS, QUICK_SEEDS = 3, 1
WINDOW_EVERY, QUICK_EVERY = 12, 48
PLANTS = {"masses": "Oscillating masses", "quadrotor": "Quadrotor"}
STEPS = 20
FIRST = "Algorithm 1"
ATTACKS: dict[str, Callable[..., Any]] = {
    FIRST: attacks.LinearizedAttack,
    "projected gradient": functools.partial(attacks.ProjectedGradientAttack, steps=STEPS),
    "momentum 0.5": functools.partial(attacks.ProjectedGradientAttack, steps=STEPS, momentum=0.5),
    "5 restarts": functools.partial(attacks.ProjectedGradientAttack, steps=STEPS, restarts=5),
    "Frank-Wolfe": functools.partial(attacks.FrankWolfeAttack, steps=STEPS),
}
#: All relative to y_ini; sizes of one order, so that psi moves by the same order.
BUDGETS = {
    "Euclidean ball, rho": lambda rho: attacks.RelativeBall(rho),
    "each channel's ball, rho": lambda rho: attacks.PerChannel(attacks.RelativeBall(rho)),
    "2 sensors, rho": lambda rho: attacks.SparseBall(2, rho, relative=True),
    "ellipsoid, rho / 3": lambda rho: attacks.Ellipsoid(rho / 3, relative=True),
    "box, rho / 3": lambda rho: attacks.Box(rho / 3, relative=True),
    "1-norm ball, rho / 2": lambda rho: attacks.L1Ball(rho / 2, relative=True),
}
IN_LOOP = (FIRST, "projected gradient", "5 restarts")
#: The outputs whose error the figures show: what `TrackingError` weighs in closed loop.
JUDGED = {"masses": torch.tensor([1, 0, 0, 0]), "quadrotor": torch.tensor([1, 1, 1, 0, 0, 0])}
LOOP_HEAD = """Mean error of the first mass and of the quadrotor's position [m] in the runs of Figures 3 and 4, over the
seeds, in brackets the extremes; a crashed vehicle counts as lying where it crashed. The tracking error weighs what
these errors measure. The masses start in perfect tracking, where only a random start has a direction for it."""
HEAD = f"""# Attacks of {STEPS} steps against Algorithm 1

Decrease of psi as a share of Algorithm 1's, mean over held-out windows. "Worst window" is the largest psi above
Algorithm 1's on the same window, over all attacks, as a fraction of psi: rounding of the plans, or nothing. "Outside"
is the largest excess of any perturbation over its budget, relative to the budget."""


def run_seed(name: str, seed: int, every: int) -> list[dict[str, Any]]:
    """Return one row for every cost, budget and attack of one seed on one plant."""
    plant = load(name, seed, every)
    layer = surrogate(plant)
    u_ini, y_ini = plant.windows
    assert isinstance(layer.data, dpc.HankelData)
    tracking = attacks.TrackingError(layer.data, layer.Q)
    costs = {"target input": (plant.cost, plant.cost.at(0))}
    costs["tracking error"] = (tracking, tracking.given(u_ini=u_ini, y_ini=y_ini, y_ref=plant.refs["y_ref"]))
    rows = []
    for kind, (cost, psi_of) in costs.items():
        nominal = psi_of(layer(u_ini, y_ini, **plant.refs))
        for size, budget_of in BUDGETS.items():
            budget, first = budget_of(plant.rho), None
            for method, make in ATTACKS.items():
                generator = torch.Generator().manual_seed(ATTACK_SEED + seed)
                began = time.perf_counter()
                p = make(layer, cost, budget)(u_ini, y_ini, **plant.refs, generator=generator)
                seconds = time.perf_counter() - began
                psi = psi_of(layer(u_ini, y_ini + p, **plant.refs, on_failure="nan"))
                first = psi if first is None else first
                solved = psi.isfinite() & first.isfinite()
                row = {"plant": name, "seed": seed, "cost": kind, "budget": size, "attack": method}
                row |= {"nominal": float(nominal.mean()), "decrease": float((nominal - psi)[solved].mean())}
                row |= {"worst": float(((psi - first) / first.abs())[solved].max()), "unsolved": int((~solved).sum())}
                row |= {"outside": float(budget.excess(p, y_ini).max()), "ms": 1e3 * seconds / len(u_ini)}
                rows.append(row)
    return rows


def run_closed_loop(name: str, seed: int) -> list[dict[str, Any]]:
    """Return one row for every cost and attack of one seed, with the paper's budget."""
    plant = load(name, seed, WINDOW_EVERY)
    layer, budget = surrogate(plant), attacks.RelativeBall(plant.rho)
    judged = JUDGED[name].to(torch.float64)
    assert isinstance(layer.data, dpc.HankelData)
    costs = {"target input": plant.cost, "tracking error": attacks.TrackingError(layer.data, torch.diag(judged))}
    runs: list[tuple[str, str, Any]] = [("-", "no attack", None), ("-", "random noise", attacks.RandomAttack(budget))]
    runs += [(kind, method, ATTACKS[method](layer, cost, budget)) for kind, cost in costs.items() for method in IN_LOOP]
    rows = []
    for kind, method, attack in runs:
        error, crashed = closed_loop(plant, layer, attack, seed)
        rows.append({"plant": name, "seed": seed, "cost": kind, "attack": method, "error": error, "crashed": crashed})
    return rows


def closed_loop_table(rows: Rows) -> list[str]:
    """Return the lines of the table of errors in closed loop."""
    cases = dict.fromkeys(zip(rows["cost"], rows["attack"], strict=True))
    lines = ["## In closed loop", "", LOOP_HEAD, ""]
    lines += ["| cost | attack | " + " | ".join(PLANTS.values()) + " |", "|---|---|" + "---|" * len(PLANTS)]
    for kind, method in cases:
        cells = [kind, method]
        for plant in PLANTS:
            chosen = (rows["plant"] == plant) & (rows["cost"] == kind) & (rows["attack"] == method)
            error, crashes = rows["error"][chosen], int(rows["crashed"][chosen].sum())
            cells.append(f"{error.mean():.3f} ({error.min():.3f} to {error.max():.3f})")
            cells[-1] += f", {crashes} of {len(error)} crash" if crashes else ""
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def table(rows: Rows, plant: str) -> list[str]:
    """Return the lines of one plant's table."""
    more = [name for name in ATTACKS if name != FIRST]
    head = ["cost", "budget", "psi", f"decrease, {FIRST}", *more, "worst window", "outside"]
    lines = [f"## {PLANTS[plant]}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for kind in dict.fromkeys(rows["cost"]):
        for size in BUDGETS:
            chosen = (rows["plant"] == plant) & (rows["cost"] == kind) & (rows["budget"] == size)
            of = {name: chosen & (rows["attack"] == name) for name in ATTACKS}
            decrease = rows["decrease"][of[FIRST]].mean()
            cells = [kind, size, f"{rows['nominal'][chosen].mean():.3g}", f"{decrease:.3g}"]
            cells += [f"{100 * rows['decrease'][of[name]].mean() / decrease:.1f} %" for name in more]
            cells += [f"{max(rows[column][chosen].max(), 0.0):.0e}" for column in ("worst", "outside")]
            lines.append("| " + " | ".join(cells) + " |")
    speed = {name: np.median(rows["ms"][(rows["plant"] == plant) & (rows["attack"] == name)]) for name in ATTACKS}
    times = ", ".join(f"{name} {value:.2g} ms" for name, value in speed.items())
    unsolved = int(rows["unsolved"][rows["plant"] == plant].sum())
    return [*lines, "", f"Median time a window, in batch: {times}. Windows without a plan, left out: {unsolved}."]


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=SEEDS)
    parser.add_argument("--quick", action="store_true", help="one seed and a quarter of the windows")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, every = (QUICK_SEEDS, QUICK_EVERY) if args.quick else (args.seeds, WINDOW_EVERY)
    began, note = time.perf_counter(), versions(seeds, args.workers)

    jobs = [(plant, seed, every) for plant in PLANTS for seed in range(seeds)]
    runs = run_all(run_seed, jobs, args.workers, "Attacks")
    write_rows(out / "attacks.csv", (row for job in runs for row in job), note)
    loops = run_all(run_closed_loop, [job[:2] for job in jobs], args.workers, "Closed loop")
    write_rows(out / "attacks_closed_loop.csv", (row for job in loops for row in job), note)

    rows = read_rows(out / "attacks.csv")
    body = [line for plant in PLANTS for line in ("", *table(rows, plant))]
    body += ["", *closed_loop_table(read_rows(out / "attacks_closed_loop.csv"))]
    (out / "attacks.md").write_text("\n".join([HEAD, "", f"{note}.", *body]) + "\n")
    print(f"Attacks: {out / 'attacks.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
