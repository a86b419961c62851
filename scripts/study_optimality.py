"""Study: how close attacks come to the worst there is, proven; beyond the paper.

    python -m scripts.study_optimality              # about half an hour: a minute for each window of the quadrotor
    python -m scripts.study_optimality --quick      # three windows of the masses

The settings of Figures 3 and 4 at their largest rho, on held-out windows of a recording that the controller has not
seen. `attacks.worst_case` proves the optimum, or leaves a bound where its time ends; every attack is put as a share of
the decrease of psi that the worst perturbation found reaches, and so are two certificates: the bound of `worst_case`,
and what `attacks.sensitivity_bound` leaves possible. The trained network is fitted to the controller's own recording,
by psi through the layer. Each finished window is kept, and a run that was stopped goes on. Leaves, in results/:

    optimality_{plant}.csv      one row for each window
    optimality.md               shares of the decrease, certificates, and how many windows were proven
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.case import ATTACK_SEED
from scripts.experiments.surrogates import Plant, load, surrogate
from scripts.shared.command import arguments, versions
from scripts.shared.rows import Rows, read_rows, write_rows
from torch_dpc import attacks

WINDOWS, QUICK_WINDOWS = 20, 3
WINDOW_EVERY = 20  # steps between held-out windows
TIME_LIMIT = 60.0  # of each proof [s]
PROVEN = 0.01  # gap, relative to psi, at which a window counts as proven
PLANTS = {"masses": "Oscillating masses", "quadrotor": "Quadrotor"}
HOLDS_OUTPUTS = {"quadrotor"}  # plants whose plans meet bounds of outputs: the certificate must cover them
TRAINED = "trained network"
ITERATIONS, BATCH, RATE, HIDDEN = 300, 128, 3e-3, [16]  # of its training: Adam, windows an iteration, step, widths
ATTACKS: dict[str, Callable[..., attacks.Attack]] = {
    "random": lambda layer, cost, budget: attacks.RandomAttack(budget),
    "Algorithm 1": attacks.LinearizedAttack,
    "Frank-Wolfe": lambda layer, cost, budget: attacks.FrankWolfeAttack(layer, cost, budget, 20),
    "projected gradient": lambda layer, cost, budget: attacks.ProjectedGradientAttack(layer, cost, budget, 20),
    "5 restarts": lambda layer, cost, budget: attacks.ProjectedGradientAttack(layer, cost, budget, 20, restarts=5),
    "black box": lambda layer, cost, budget: attacks.FiniteDifferenceAttack(layer, cost, budget, steps=5),
}


def trained(plant: Plant, layer: dpc.DPCLayer, budget: attacks.Budget) -> attacks.Attack:
    """Return a network that lowers psi on the windows of the controller's own recording."""
    case, (u, y) = plant.case, plant.own
    at = torch.arange(case.samples - case.t_ini - case.horizon)[:, None] + torch.arange(case.t_ini)
    u_ini, y_ini, generator = u[at], y[at], torch.Generator().manual_seed(0)
    recorded = (u_ini, y_ini, plant.refs["y_ref"], plant.refs.get("u_ref"), 0)
    policy = attacks.AttackPolicy.for_windows(case.hankel(u, y), recorded, hidden=HIDDEN, generator=generator)
    optimizer = torch.optim.Adam(policy.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, ITERATIONS)
    attack, psi = attacks.PolicyAttack(policy, budget), plant.cost.at(0)
    for _ in tqdm(range(ITERATIONS), desc="training"):
        index = torch.randint(len(at), (BATCH,), generator=generator)
        p = attack(u_ini[index], y_ini[index], **plant.refs)
        plan = layer(u_ini[index], y_ini[index] + p, **plant.refs, on_failure="nan")
        loss = torch.nan_to_num(psi(plan)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return attacks.PolicyAttack(policy.requires_grad_(False), budget)


def run_windows(name: str, windows: int, path: Path) -> None:
    """Write one row for each window of a plant; rows that are there are kept."""
    plant = load(name, 0, WINDOW_EVERY)
    layer, budget = surrogate(plant), attacks.RelativeBall(plant.rho)
    refs: dict[str, Any] = plant.refs
    made = {method: make(layer, plant.cost, budget) for method, make in ATTACKS.items()}
    done = read_rows(path) if path.exists() else {"gap": np.zeros(0)}
    table: list[dict[str, Any]] = [{key: done[key][i] for key in done} for i in range(len(done["gap"]))]
    if len(table) >= windows:
        return
    L = float(attacks.sensitivity_bound(layer, outputs=name in HOLDS_OUTPUTS))
    made[TRAINED] = trained(plant, layer, budget)
    for i in tqdm(range(len(table), windows), desc=PLANTS[name]):
        u_ini, y_ini = (window[i] for window in plant.windows)
        began = time.process_time()
        worst = attacks.worst_case(layer, plant.cost, budget, u_ini, y_ini, **refs, time_limit=TIME_LIMIT)
        row = {"plant": name, "window": i, "nominal": float(worst.nominal), "value": float(worst.value)}
        row |= {"bound": float(worst.bound), "gap": float(worst.gap), "seconds": float(worst.seconds)}
        row |= {"cpu": time.process_time() - began, "L": L, "reach": L * plant.rho * float(y_ini.norm())}
        for method, attack in made.items():
            generator = torch.Generator().manual_seed(ATTACK_SEED + i)
            p = attack(u_ini, y_ini, **refs, generator=generator)
            psi = plant.cost(layer(u_ini, y_ini + p, **refs, on_failure="nan"))
            row[method] = float((worst.nominal - psi) / (worst.nominal - worst.value))
        table.append(row)
        write_rows(path, table, versions(1, 1))


def report(tables: dict[str, Rows]) -> str:
    """Return the table in Markdown."""
    lines = ["# Attacks as a share of the worst case", ""]
    lines += [
        "Decrease of psi over that of the worst perturbation found: mean over the windows, in brackets the least "
    ]
    lines += ["(of the certificates, the largest).", ""]
    lines += ["| | " + " | ".join(PLANTS[plant] for plant in tables) + " |", "|---|" + "---|" * len(tables)]

    def line(name: str, cell: Callable[[Rows], str]) -> None:
        lines.append(f"| {name} | " + " | ".join(cell(rows) for rows in tables.values()) + " |")

    for method in (*ATTACKS, TRAINED):
        line(method, lambda rows, m=method: f"{rows[m].mean():.1%} ({rows[m].min():.1%})")  # type: ignore[misc]
    line("windows", lambda rows: str(len(rows["gap"])))
    line("bound of `worst_case`", lambda rows: _share(rows, rows["bound"]))
    line("left by `sensitivity_bound`", lambda rows: _share(rows, _certified(rows)))
    line(f"proven to a gap of {PROVEN:.0%}", lambda rows: f"{int((rows['gap'] <= PROVEN).sum())} of {len(rows['gap'])}")
    line("gap, mean (largest)", lambda rows: f"{rows['gap'].mean():.2%} ({rows['gap'].max():.2%})")
    line("CPU seconds a proof, mean (most)", lambda rows: f"{rows['cpu'].mean():.1f} ({rows['cpu'].max():.1f})")
    line("seconds a proof, mean (most)", lambda rows: f"{rows['seconds'].mean():.1f} ({rows['seconds'].max():.1f})")
    return "\n".join(lines) + "\n"


def _share(rows: Rows, least: np.ndarray) -> str:
    share = (rows["nominal"] - least) / (rows["nominal"] - rows["value"])
    return f"{share.mean():.1%} ({share.max():.1%})"


def _certified(rows: Rows) -> np.ndarray:
    """Return the least psi for an input that may move by L |p|: 1/2 (|u - u_target| - L |p|)^2, or 0."""
    return 0.5 * np.maximum(np.sqrt(2 * rows["nominal"]) - rows["reach"], 0.0) ** 2


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="three windows of the masses")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    chosen = {"masses": QUICK_WINDOWS} if args.quick else dict.fromkeys(PLANTS, WINDOWS)
    paths = {name: out / f"optimality_{name}.csv" for name in chosen}
    for name, windows in chosen.items():
        run_windows(name, windows, paths[name])
    text = report({name: read_rows(path) for name, path in paths.items()})
    (out / "optimality.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
