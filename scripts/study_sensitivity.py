"""Study: how the tracking error grows with rho, and where each controller breaks; beyond the paper.

    python -m scripts.study_sensitivity             # about 2 minutes on two cores
    python -m scripts.study_sensitivity --quick     # about 20 s: two seeds, four rho

The settings of Figures 3 and 4 with rho on a logarithmic grid, for Algorithm 1 and random noise. A run of the masses
fails when an output leaves its bounds, a flight when the vehicle crashes (it then counts as lying there). Rows are
saved as they are made; a run that is stopped goes on where it was (--fresh and --quick begin anew). Leaves, in
results/:

    study_sensitivity.csv   one row a run: mean and largest error, whether and when it failed, plans without a solution
    study_sensitivity.png   median over the seeds and the band between the 10th and the 90th percentile
    study_sensitivity.md    the same as tables
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from scripts.experiments.case import Case, run_seed
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared import bootstrap
from scripts.shared.command import arguments, versions
from scripts.shared.plots import COLOURS, NAMES, draw_band, percent, plt, say_band, style
from scripts.shared.rows import Array, Rows, grid, read_rows
from scripts.shared.statistics import NOMINAL, POISON, RANDOM, band
from scripts.shared.tables import Table, as_they_finish, missing

EXPERIMENTS: dict[str, Case] = {"masses": Masses(), "quadrotor": Quadrotor()}
TITLES = {"masses": "oscillating masses", "quadrotor": "quadrotor"}
RHO = {"masses": np.logspace(-3, 0, 13), "quadrotor": np.logspace(-4, -1.5, 11)}  # 0.1 to 100 %, 0.01 to 3.2 %
QUICK_SEEDS, QUICK_EVERY = 2, 4
ROW = ("plant", "seed", "attack", "rho", "mean_error", "max_error", "failed", "failed_at", "unsolved")
HEAD = """# Tracking error against rho

Mean error over a run [m]: median over the seeds, in brackets the 10th and the 90th percentile; ratio of means with its
95 % paired bootstrap interval over the seeds. Where runs fail the error says little: a crashed vehicle counts as lying
where it crashed."""
FAILS = {"masses": "an output beyond its bounds", "quadrotor": "a crash"}


def run_plant(plant: str, seed: int, rhos: Array) -> list[dict[str, Any]]:
    """Return one row for every run of one seed on one plant."""
    torch.set_num_threads(1)
    return [
        {
            "plant": plant,
            "seed": seed,
            "attack": run["attack"],
            "rho": run["rho"],
            "mean_error": run["error"].mean(),
            "max_error": run["error"].max(),
            "failed": int(failed(run).any()),
            "failed_at": run["t"][failed(run).argmax()] if failed(run).any() else np.nan,
            "unsolved": int(run["unsolved"][:: EXPERIMENTS[plant].replan_every].sum()),
        }
        for run in run_seed(EXPERIMENTS[plant], seed, rhos.tolist())
    ]


def failed(run: dict[str, Any]) -> Array:
    """Return whether the run has failed, at each step."""
    if "crashed" in run:
        return run["crashed"]
    outputs = np.stack([np.abs(run[f"y{i}"]) for i in (1, 2, 3, 4)], axis=1)
    return np.any(outputs > EXPERIMENTS["masses"].y_max, axis=1)


def of_plant(rows: Rows, plant: str) -> Rows:
    """Return the rows of one plant, in the order of the seeds."""
    chosen = np.flatnonzero(rows["plant"] == plant)
    order = chosen[np.argsort(rows["seed"][chosen], kind="stable")]
    return {name: column[order] for name, column in rows.items()}


def across(rows: Rows, column: str, attack: str) -> Array:
    """Return a column of the runs under one attack, `(seeds, rho)`."""
    rhos = np.unique(rows["rho"][rows["attack"] == attack])
    return np.concatenate([grid(rows, column, attack, rho) for rho in rhos], axis=1)


def plot(path: Path, rows: Rows) -> None:
    """Draw the mean error above and the failed runs below, one column a plant."""
    style()
    figure, panels = plt.subplots(2, 2, figsize=(8.4, 4.6), sharex="col", height_ratios=(4, 1))
    for (above, below), plant in zip(panels.T, EXPERIMENTS, strict=True):
        chosen = of_plant(rows, plant)
        rhos = 100 * np.unique(chosen["rho"][chosen["attack"] == POISON])
        for attack, marker, shift in ((RANDOM, "o", 0.93), (POISON, "s", 1.07)):
            look = {"color": COLOURS[attack], "label": NAMES[attack]}
            draw_band(above, rhos, across(chosen, "mean_error", attack), marker=marker, markersize=4, **look)
            share = 100 * across(chosen, "failed", attack).mean(axis=0)
            below.vlines(shift * rhos, 0, share, color=COLOURS[attack], linewidth=4)
        if not chosen["failed"].any():
            below.text(0.5, 0.5, "no run fails", transform=below.transAxes, ha="center", va="center")
        nominal = np.median(across(chosen, "mean_error", NOMINAL))
        if nominal > 1e-6:
            above.axhline(nominal, color=COLOURS[NOMINAL], linestyle=(0, (4, 2)), label=NAMES[NOMINAL])
        above.set(title=TITLES[plant], xscale="log", yscale="log", ylabel="mean tracking error [m]")
        say_band(above, len(np.unique(chosen["seed"])))
        below.set(xlabel=r"$\rho$ [%]", ylabel="failed [%]", ylim=(0, 100), yticks=(0, 50, 100))
        below.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    figure.legend(*panels[0, 1].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.savefig(path)
    plt.close(figure)


def table(rows: Rows, plant: str) -> list[str]:
    """Return the lines of one plant's table, and where it breaks."""
    rhos = np.unique(rows["rho"][rows["attack"] == POISON])
    error = {attack: across(rows, "mean_error", attack) for attack in (RANDOM, POISON)}
    fails = {attack: across(rows, "failed", attack) for attack in (RANDOM, POISON)}
    lines = [
        f"## {TITLES[plant].capitalize()}",
        "",
        f"No attack: {np.median(across(rows, 'mean_error', NOMINAL)):.2g} m. Failed means {FAILS[plant]}. "
        f"Plans without a solution: {int(rows['unsolved'].sum())}.",
        "",
        "| rho | random noise | Algorithm 1 | ratio of means | failed, random | failed, Algorithm 1 |",
        "|---|---|---|---|---|---|",
    ]
    for i, rho in enumerate(rhos):
        cells = [percent(rho)]
        cells += ["{:.2g} ({:.2g} to {:.2g})".format(*band(error[attack][:, i])) for attack in (RANDOM, POISON)]
        cells += [f"{bootstrap.ratio(error[POISON][:, i], error[RANDOM][:, i]):.1f}"]
        cells += [f"{int(fails[attack][:, i].sum())} of {len(fails[attack])}" for attack in (RANDOM, POISON)]
        lines.append("| " + " | ".join(cells) + " |")
    return lines + ["", *(f"- {NAMES[attack]}: {first_failure(rhos, fails[attack])}" for attack in (RANDOM, POISON))]


def first_failure(rhos: Array, failed: Array) -> str:
    """Return, in words, the smallest rho at which a run failed."""
    if not failed.any():
        return f"no run fails up to {percent(rhos[-1])}."
    first = rhos[failed.any(axis=0).argmax()]
    last = f"{int(failed[:, -1].sum())} of {len(failed)}"
    return f"the first run fails at {percent(first)}; at {percent(rhos[-1])} {last} do."


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="two seeds and every fourth rho")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, every = (QUICK_SEEDS, QUICK_EVERY) if args.quick else (args.seeds, 1)
    path, began = out / "study_sensitivity.csv", time.perf_counter()
    if args.fresh or args.quick:
        path.unlink(missing_ok=True)
    measured = Table(path, ROW)

    pairs = [(plant, seed) for seed in range(seeds) for plant in EXPERIMENTS]
    jobs = [(plant, seed, RHO[plant][::every]) for plant, seed in missing(measured, pairs)]
    for runs in tqdm(as_they_finish(run_plant, jobs, args.workers), total=len(jobs), desc="Sensitivity", unit="seed"):
        measured.add(runs)

    rows, note = read_rows(path), versions(seeds, args.workers)
    plot(out / "study_sensitivity.png", rows)
    body = [line for plant in EXPERIMENTS for line in ("", *table(of_plant(rows, plant), plant))]
    (out / "study_sensitivity.md").write_text("\n".join([HEAD, "", f"{note}.", *body]) + "\n")
    print(f"Sensitivity: {out / 'study_sensitivity.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
