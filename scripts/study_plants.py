"""Study: what data-driven plans need on four plants; beyond the paper.

    python -m scripts.study_plants              # about 15 minutes on two cores
    python -m scripts.study_plants --quick      # about 3 minutes: two seeds

Oscillating masses (linear), four tanks (an operating point far from zero), a pole on a cart (unstable, strongly
nonlinear) and the quadrotor follow a reference under four planners with the same weights: the paper's formulation, the
affine one (1'g = 1), the affine one on the windows nearest to the present one, and predictive control with the true
model, linearised at the operating point. Every measurement has noise, except in the true model. The error is the
distance from the reference, averaged over the run, in the channels that count, and cut where the task is lost. The
offset is the size of the mean deviation over the last tenth of the run, in which noise averages out. Rows are saved as
they are made: a run that is stopped goes on where it was (`--fresh` begins anew). Leaves, in results/:

    study_plants.csv        one row a run
    study_plants.md, .png   median and band over the seeds
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.plants import CASES, PlantCase
from scripts.shared.command import arguments, versions
from scripts.shared.plots import plt, style
from scripts.shared.statistics import BAND, band
from scripts.shared.tables import Table, as_they_finish

COLUMNS = ("plant", "seed", "planner", "error", "last", "lost", "unsolved", "offset")
NARROW = 3.0  # errors within this factor are drawn on a linear axis
PLANNERS = {
    "paper": ("the paper's formulation", "#d55e00"),
    "affine": ("affine", "#0072b2"),
    "nearest": ("nearest windows", "#009e73"),
    "model": ("true model, linearised", "black"),
}


def planner_of(name: str, case: PlantCase, seed: int) -> Any:
    """Return one of the planners."""
    if name == "model":
        return dpc.DPCLayer(case.data_of_model(seed), **case.weights, affine=True)
    layer = dpc.DPCLayer(case.data(seed), **case.weights, affine=name != "paper")
    if name != "nearest":
        return layer
    near = dpc.DPCLayer(layer.data, **{**layer.config(), "regularizer": "identity", "lambda_g": case.lambda_near})
    return dpc.NearestWindows(near, case.k, rounds=1)


def attempt(plant: str, seed: int) -> list[dict[str, Any]]:
    """Return one row for each planner."""
    torch.set_num_threads(1)
    case, rows = CASES[plant](), []
    for name in PLANNERS:
        log = case.follow(planner_of(name, case, seed), seed)
        deviation = (log.y - log.y_ref)[:, case.channels]
        error = torch.linalg.vector_norm(deviation, dim=1).nan_to_num(case.worst)
        lost = bool((error >= case.worst).any())
        error, tenth = error.clamp_max(case.worst), len(error) // 10
        offset = float(torch.linalg.vector_norm(deviation[-tenth:].mean(0)).nan_to_num(case.worst))
        rows.append(
            {
                "plant": plant,
                "seed": seed,
                "planner": name,
                "error": float(error.mean()),
                "last": float(error[-tenth:].mean()),
                "lost": int(lost),
                "unsolved": int((log.status != dpc.Status.SOLVED)[log.replanned].sum()),
                "offset": min(offset, case.worst),
            }
        )
    return rows


def values_of(rows: Sequence[dict[str, str]], plant: str, planner: str, column: str, seeds: int) -> np.ndarray:
    """Return one number a seed."""
    mine = [r for r in rows if r["plant"] == plant and r["planner"] == planner and int(r["seed"]) < seeds]
    return np.array([float(r[column]) for r in mine])


def table(rows: Sequence[dict[str, str]], seeds: int) -> list[str]:
    """Return the lines of the table."""
    head = ["plant", "planner", "mean error", "error of the last tenth", "offset", "lost", "plans without a solution"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for plant, make in CASES.items():
        case = make()
        for planner, (label, _) in PLANNERS.items():
            cells = [case.name, label]
            for column in ("error", "last", "offset"):
                median, low, high = band(values_of(rows, plant, planner, column, seeds))
                cells.append(f"{median:.3g} ({low:.3g} to {high:.3g}) {case.unit}")
            lost, unsolved = (int(values_of(rows, plant, planner, c, seeds).sum()) for c in ("lost", "unsolved"))
            lines.append("| " + " | ".join([*cells, f"{lost} of {seeds}", str(unsolved)]) + " |")
    return lines


def plot(path: Path, rows: Sequence[dict[str, str]], seeds: int) -> None:
    """Draw the median error of every planner on every plant, with the band over the seeds."""
    style()
    figure, panels = plt.subplots(1, len(CASES), figsize=(11.0, 3.2), squeeze=False)
    for axes, (plant, make) in zip(panels[0], CASES.items(), strict=True):
        case = make()
        for place, (planner, (_, colour)) in enumerate(PLANNERS.items()):
            errors = values_of(rows, plant, planner, "error", seeds)
            median, low, high = band(errors)
            axes.vlines(place, low, high, color=colour, linewidth=3, alpha=0.5)
            axes.plot(place, median, "o", color=colour, markersize=7)
            axes.plot(np.full(len(errors), place + 0.18), errors, ".", color=colour, markersize=3)
        every = [values_of(rows, plant, planner, "error", seeds) for planner in PLANNERS]
        scale = "log" if max(map(max, every)) > NARROW * min(map(min, every)) else "linear"
        axes.set(title=case.name, yscale=scale, ylabel=f"mean error [{case.unit}]", xlim=(-0.6, 3.6))
        if scale == "linear":
            axes.set_ylim(bottom=0.0)
        axes.set_xticks(range(len(PLANNERS)), ["paper", "affine", "nearest", "model"], rotation=30)
    figure.suptitle(f"median and {BAND[0]}th to {BAND[1]}th percentile over {seeds} seeds")
    figure.savefig(path)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="two seeds")
    parser.add_argument("--fresh", action="store_true", help="forget what was run before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds = 2 if args.quick else args.seeds
    if args.fresh:
        (out / "study_plants.csv").unlink(missing_ok=True)
    made, began = Table(out / "study_plants.csv", COLUMNS), time.perf_counter()

    done = {(r["plant"], int(r["seed"])) for r in made.rows()}
    jobs = [(plant, seed) for seed in range(seeds) for plant in CASES if (plant, seed) not in done]
    for rows in tqdm(as_they_finish(attempt, jobs, args.workers), total=len(jobs), desc="Plants", unit="run"):
        made.add(rows)

    lines = ["# What data-driven plans need on four plants", "", f"{versions(seeds, args.workers)}.", ""]
    lines += [f"Median over the seeds ({BAND[0]}th to {BAND[1]}th percentile).", "", *table(made.rows(), seeds)]
    (out / "study_plants.md").write_text("\n".join(lines) + "\n")
    plot(out / "study_plants.png", made.rows(), seeds)
    print(f"Plants: {out / 'study_plants.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
