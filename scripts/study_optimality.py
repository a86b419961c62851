"""Study: how close attacks come to the worst there is, proven; beyond the paper.

    python -m scripts.study_optimality              # about 20 minutes: a minute for each window of the quadrotor
    python -m scripts.study_optimality --quick      # three windows of the masses

The settings of Figures 3 and 4 at their largest rho, on held-out windows of a recording that the controller has not
seen. `attacks.worst_case` proves the optimum, or leaves a bound where its time ends; every attack is put as a share of
the decrease of psi that the worst case reaches. Leaves, in results/:

    optimality.csv      one row for each plant and window
    optimality.md       shares of the proven decrease, and how many windows were proven
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from scripts.experiments.case import ATTACK_SEED
from scripts.experiments.surrogates import load, surrogate
from scripts.shared.command import arguments, versions
from scripts.shared.rows import Rows, read_rows, write_rows
from torch_dpc import attacks

WINDOWS, QUICK_WINDOWS = 20, 3
WINDOW_EVERY = 20  # steps between held-out windows
TIME_LIMIT = 60.0  # of each proof [s]
PROVEN = 0.01  # gap, relative to psi, at which a window counts as proven
PLANTS = {"masses": "Oscillating masses", "quadrotor": "Quadrotor"}
ATTACKS: dict[str, Callable[..., attacks.Attack]] = {
    "random": lambda layer, cost, budget: attacks.RandomAttack(budget),
    "Algorithm 1": attacks.LinearizedAttack,
    "Frank-Wolfe": lambda layer, cost, budget: attacks.FrankWolfeAttack(layer, cost, budget, 20),
    "projected gradient": lambda layer, cost, budget: attacks.ProjectedGradientAttack(layer, cost, budget, 20),
    "5 restarts": lambda layer, cost, budget: attacks.ProjectedGradientAttack(layer, cost, budget, 20, restarts=5),
    "black box": lambda layer, cost, budget: attacks.FiniteDifferenceAttack(layer, cost, budget, steps=5),
}


def run_windows(name: str, windows: int) -> list[dict[str, Any]]:
    """Return one row for each window of a plant."""
    plant = load(name, 0, WINDOW_EVERY)
    layer, budget = surrogate(plant), attacks.RelativeBall(plant.rho)
    refs: dict[str, Any] = plant.refs
    rows = []
    for i in tqdm(range(windows), desc=PLANTS[name]):
        u_ini, y_ini = (window[i] for window in plant.windows)
        worst = attacks.worst_case(layer, plant.cost, budget, u_ini, y_ini, **refs, time_limit=TIME_LIMIT)
        row = {"plant": name, "window": i, "nominal": float(worst.nominal), "value": float(worst.value)}
        row |= {"bound": float(worst.bound), "gap": float(worst.gap), "seconds": float(worst.seconds)}
        for method, make in ATTACKS.items():
            generator = torch.Generator().manual_seed(ATTACK_SEED + i)
            p = make(layer, plant.cost, budget)(u_ini, y_ini, **refs, generator=generator)
            psi = plant.cost(layer(u_ini, y_ini + p, **refs, on_failure="nan"))
            row[method] = float((worst.nominal - psi) / (worst.nominal - worst.value))
        rows.append(row)
    return rows


def report(rows: Rows) -> str:
    """Return the table in Markdown."""
    lines = ["# Attacks as a share of the proven worst case", ""]
    lines += ["Decrease of psi over that of the worst case: mean over the windows, in brackets the least.", ""]
    plants = [plant for plant in PLANTS if (rows["plant"] == plant).any()]
    lines += ["| | " + " | ".join(PLANTS[plant] for plant in plants) + " |", "|---|" + "---|" * len(plants)]
    for method in ATTACKS:
        cells = []
        for plant in plants:
            share = rows[method][rows["plant"] == plant]
            cells.append(f"{share.mean():.1%} ({share.min():.1%})")
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    proven, seconds = [], []
    for plant in plants:
        own = rows["plant"] == plant
        proven.append(f"{int((rows['gap'][own] <= PROVEN).sum())} of {int(own.sum())}")
        seconds.append(f"{rows['seconds'][own].mean():.1f} ({rows['seconds'][own].max():.1f})")
    lines.append(f"| proven to a gap of {PROVEN:.0%} | " + " | ".join(proven) + " |")
    lines.append("| seconds a proof, mean (most) | " + " | ".join(seconds) + " |")
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="three windows of the masses")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    chosen = {"masses": QUICK_WINDOWS} if args.quick else dict.fromkeys(PLANTS, WINDOWS)
    rows = [row for name, windows in chosen.items() for row in run_windows(name, windows)]
    write_rows(out / "optimality.csv", rows, versions(1, 1))
    text = report(read_rows(out / "optimality.csv"))
    (out / "optimality.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
