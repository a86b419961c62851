"""Table I: the size of the system that each method solves to differentiate one plan.

    python -m scripts.table1_sizes          # about 10 s on two cores

Every number is read off what is solved, none is computed from a formula: from CVXPYlayers' own canonicalised cone
program (m rows and n variables make a homogeneous self-dual embedding of m + n + 1), from the Jacobian J of the paper's
full projected-KKT system as it is built, and from the matrix G of the reduced system. Leaves, in results/:

    table1_sizes.md, table1_sizes.csv       three rows, two plants at three horizons

Sizes do not depend on the numbers in the data. The masses' data are simulated; the quadrotor's are random numbers of
its dimensions, so that this script needs no PyBullet.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

import torch_dpc as dpc
from baselines import CvxpyLayersDPC, FullKKT
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared.command import RESULTS

HORIZONS = (25, 50, 100)
SEED = 0

METHODS: dict[str, Callable[[dpc.DPCLayer], int]] = {
    "CVXPYlayers": lambda layer: CvxpyLayersDPC(layer, formulation="paper").kkt_size,
    "projected KKT, full (paper)": lambda layer: FullKKT(layer).kkt_size,
    "projected KKT, reduced (torch_dpc)": lambda layer: layer.reduction.G.shape[-1],
}


def masses_layer(horizon: int) -> dpc.DPCLayer:
    """Return the paper's problem on the oscillating masses."""
    return replace(Masses(), horizon=horizon).planner(SEED)


def quadrotor_layer(horizon: int) -> dpc.DPCLayer:
    """Return a problem of the quadrotor's dimensions, with random numbers for data."""
    case, generator = replace(Quadrotor(), horizon=horizon), torch.Generator().manual_seed(SEED)
    sizes = (len(case.R), len(case.Q))
    u, y = (torch.randn(case.samples, n, dtype=torch.float64, generator=generator) for n in sizes)
    return case.layer(case.hankel(u, y))


PLANTS: dict[str, Callable[[int], dpc.DPCLayer]] = {"masses": masses_layer, "quadrotor": quadrotor_layer}


def sizes(plant: str, horizon: int) -> dict[str, int]:
    """Return the size by every method."""
    layer = PLANTS[plant](horizon)
    return {method: read(layer) for method, read in METHODS.items()}


def write(found: dict[tuple[str, int], dict[str, int]], out: Path) -> None:
    """Write the table, a row for each method, a column for each plant and horizon."""
    out.mkdir(parents=True, exist_ok=True)
    header = ["method", *(f"{plant}, horizon {horizon}" for plant, horizon in found)]
    rows = [[method, *(row[method] for row in found.values())] for method in METHODS]
    with (out / "table1_sizes.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    lines = [
        "# Table I: unknowns of the system solved to differentiate one plan",
        "",
        "| " + " | ".join(header) + " |",
        "|---|" + "---:|" * len(found),
        *("| " + " | ".join(map(str, row)) + " |" for row in rows),
        "",
        f"t_ini = {Masses.t_ini}, n_g = {Masses.n_g}. CVXPYlayers: m + n + 1 of its own cone program; the others: the "
        "order of the matrix that is built. The quadrotor's data are random numbers of its dimensions.",
    ]
    (out / "table1_sizes.md").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Read every size and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default results/)")
    out = parser.parse_args().out
    torch.set_num_threads(1)  # small matrices: more threads only wait for one another
    cases = [(plant, horizon) for plant in PLANTS for horizon in HORIZONS]
    write({case: sizes(*case) for case in tqdm(cases, desc="Table I", unit="problem")}, out)


if __name__ == "__main__":
    main()
