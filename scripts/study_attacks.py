"""Study: how much further attacks of several steps go than Algorithm 1, over every budget; beyond the paper.

    python -m scripts.study_attacks             # about 5 minutes on two cores
    python -m scripts.study_attacks --quick     # about 30 s: two seeds, fewer windows

The settings of Figures 3 and 4 at their largest rho, on held-out windows of a recording that the controller has not
seen, for two costs: `TargetInput`, the figure's own, and `TrackingError`, the predicted true output driven away from
the reference; and in closed loop, with the paper's budget. Shares and differences have 95 % paired bootstrap intervals
over the seeds. Rows are saved as they are made; a run that is stopped goes on where it was (--fresh and --quick begin
anew). Leaves, in results/:

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
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.case import ATTACK_SEED
from scripts.experiments.surrogates import closed_loop, load, surrogate
from scripts.shared import bootstrap
from scripts.shared.command import arguments, versions
from scripts.shared.rows import Array, Rows, read_rows
from scripts.shared.tables import Table, as_they_finish, missing
from torch_dpc import attacks

SEEDS, QUICK_SEEDS = 5, 2
FIRST_SEED = 8000  # never looked at during development
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
WINDOW = ("plant", "seed", "cost", "budget", "attack", "nominal", "decrease", "worst", "unsolved", "outside", "ms")
LOOP = ("plant", "seed", "cost", "attack", "error", "crashed")
LOOP_HEAD = f"""Mean error of the first mass and of the quadrotor's position [m] in the runs of Figures 3 and 4, and
beside it the difference from {FIRST} on the target input, with its 95 % paired bootstrap interval; a crashed vehicle
counts as lying where it crashed. The tracking error weighs what these errors measure. The masses start in perfect
tracking, where only a random start has a direction for it."""
HEAD = f"""# Attacks of {STEPS} steps against Algorithm 1

Decrease of psi as a share of Algorithm 1's: ratio of means over held-out windows and seeds, with 95 % paired bootstrap
intervals over the seeds; the decrease itself where the interval of Algorithm 1's includes 0. "Worst window" is the
largest psi above Algorithm 1's on the same window, over all attacks, as a fraction of psi: rounding of the plans, or
nothing. "Outside" is the largest excess of any perturbation over its budget, relative to the budget."""


def run_seed(name: str, seed: int, every: int) -> list[dict[str, Any]]:
    """Return one row for every cost, budget and attack of one seed on one plant."""
    torch.set_num_threads(1)
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
    torch.set_num_threads(1)
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
        rows.append({"plant": name, "seed": seed, "cost": kind, "attack": method, "error": error})
        rows[-1]["crashed"] = int(crashed)
    return rows


def closed_loop_table(rows: Rows) -> list[str]:
    """Return the lines of the table of errors in closed loop."""

    def errors(plant: str, kind: str, method: str, column: str = "error") -> Array:
        mine = (rows["plant"] == plant) & (rows["cost"] == kind) & (rows["attack"] == method)
        return rows[column][mine][np.argsort(rows["seed"][mine])]

    cases = dict.fromkeys(zip(rows["cost"], rows["attack"], strict=True))
    head = ["cost", "attack", *(cell for title in PLANTS.values() for cell in (title, f"less {FIRST}'s"))]
    lines = ["## In closed loop", "", LOOP_HEAD, "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for kind, method in cases:
        cells = [kind, method]
        for plant in PLANTS:
            error, base = errors(plant, kind, method), errors(plant, "target input", FIRST)
            crashes = int(errors(plant, kind, method, "crashed").sum())
            cells.append(f"{error.mean():.4f}" + (f", {crashes} of {len(error)} crash" if crashes else ""))
            is_base = (kind, method) == ("target input", FIRST)
            cells.append("" if is_base else f"{bootstrap.difference(error, base):+.4f}")
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
            decrease = {name: _by_seed(rows, chosen & (rows["attack"] == name)) for name in ATTACKS}
            cells = [kind, size, f"{rows['nominal'][chosen].mean():.3g}", f"{decrease[FIRST].mean():.3g}"]
            cells += [share(decrease[name], decrease[FIRST]) for name in more]
            cells += [f"{max(rows[column][chosen].max(), 0.0):.0e}" for column in ("worst", "outside")]
            lines.append("| " + " | ".join(cells) + " |")
    speed = {name: np.median(rows["ms"][(rows["plant"] == plant) & (rows["attack"] == name)]) for name in ATTACKS}
    times = ", ".join(f"{name} {value:.2g} ms" for name, value in speed.items())
    unsolved = int(rows["unsolved"][rows["plant"] == plant].sum())
    return [*lines, "", f"Median time a window, in batch: {times}. Windows without a plan, left out: {unsolved}."]


def share(decrease: Array, first: Array) -> str:
    """Return a decrease of psi as a share of Algorithm 1's; itself where Algorithm 1 does not clearly lower psi."""
    if bootstrap.mean(first).low <= 0:
        return f"decrease {decrease.mean():.3g}"
    return f"{bootstrap.ratio(decrease, first).times(100):.1f} %"


def _by_seed(rows: Rows, chosen: Array) -> Array:
    """Return the decrease of psi of each seed, in the order of the seeds."""
    return rows["decrease"][chosen][np.argsort(rows["seed"][chosen])]


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=SEEDS)
    parser.add_argument("--quick", action="store_true", help="two seeds and a quarter of the windows")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, every = (QUICK_SEEDS, QUICK_EVERY) if args.quick else (args.seeds, WINDOW_EVERY)
    paths, began = (out / "attacks.csv", out / "attacks_closed_loop.csv"), time.perf_counter()
    if args.fresh or args.quick:
        for path in paths:
            path.unlink(missing_ok=True)
    windows, loops = Table(paths[0], WINDOW), Table(paths[1], LOOP)

    pairs = [(plant, seed) for seed in range(FIRST_SEED, FIRST_SEED + seeds) for plant in PLANTS]
    jobs: list[tuple[Any, ...]] = [(*pair, every) for pair in missing(windows, pairs)]
    for found in tqdm(as_they_finish(run_seed, jobs, args.workers), total=len(jobs), desc="Attacks", unit="seed"):
        windows.add(found)
    jobs = list(missing(loops, pairs))
    for found in tqdm(as_they_finish(run_closed_loop, jobs, args.workers), total=len(jobs), desc="Closed loop"):
        loops.add(found)

    rows, note = read_rows(paths[0]), f"{versions(seeds, args.workers, FIRST_SEED)}"
    body = [line for plant in PLANTS for line in ("", *table(rows, plant))]
    body += ["", *closed_loop_table(read_rows(paths[1]))]
    (out / "attacks.md").write_text("\n".join([HEAD, "", f"{note}.", *body]) + "\n")
    print(f"Attacks: {out / 'attacks.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
