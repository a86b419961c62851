"""Study: what weights that learn, and sets that are no boxes, cost.

    python -m scripts.study_learning        # about 1 minute on two cores

The paper's two plants at horizon 25, batch 16, windows of the recording perturbed by 2 %. A step is a forward, a
backward of |u|^2 and a step of Adam. Leaves results/learning.md and results/learning.csv.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import nn

import torch_dpc as dpc
from scripts.bench.cases import N_G, T_INI, inputs_of, layer_of, record, take
from scripts.bench.learning import learning, step_of, with_sets
from scripts.shared.command import RESULTS, cores, versions

HORIZON, BATCH, CALLS, REPEATS = 25, 16, 10, 7


def seconds(step: Callable[[], None]) -> list[float]:
    """Return the time of CALLS steps, REPEATS times."""
    step()
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        for _ in range(CALLS):
            step()
        times.append(time.perf_counter() - began)
    return times


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=cores(), help="of torch (default: one a core)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default results/)")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    rows = []
    for plant in ("masses", "quadrotor"):
        recording = record(plant, N_G + T_INI + HORIZON - 1)
        layer = layer_of(plant, *recording, HORIZON)
        inputs = take(inputs_of(plant, layer, *recording), slice(BATCH))
        largest = float(layer(**inputs).u.norm(dim=-1).max())
        layers = {
            "fixed weights, boxes": layer,
            "Q, R, lambda_g, lambda_s learn": learning(layer),
            "16 values of lambda_g at once, learning": dpc.DPCLayer(
                layer.data, Q=layer.Q, R=layer.R, lambda_s=layer.lambda_s, u_set=layer.u_set, y_set=layer.y_set,
                lambda_g=nn.Parameter(torch.logspace(0, 3, 16, dtype=torch.float64)),
            ),
            "fixed weights, u in a ball": with_sets(layer, u_set=dpc.Ball(0.7 * largest)),
            "Q, R, lambda_g, lambda_s learn, u in a ball": learning(layer, u_set=dpc.Ball(0.7 * largest)),
        }  # fmt: skip
        for name, other in layers.items():
            problem = {k: v[:1] for k, v in inputs.items()} if "16 values" in name else inputs
            times = seconds(step_of(other, problem))
            with torch.no_grad():
                residual = float(other(**problem).info.residual.max())
            rows.append(
                {
                    "plant": plant,
                    "problem": name,
                    "ten_calls_s": float(np.median(times)),
                    "least_s": min(times),
                    "most_s": max(times),
                    "residual": residual,
                }
            )
            print(f"{plant}, {name}: {rows[-1]['ten_calls_s']:.3f} s")
    args.out.mkdir(parents=True, exist_ok=True)
    with (args.out / "learning.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    lines = [
        f"{versions(1, 1).split(';')[0]}; {args.threads} threads; batch {BATCH}, median of {REPEATS} times "
        f"{CALLS} calls.",
        "",
        "| plant | problem | ten calls, forward + backward [s] | from | to | F at the solution |",
        "|---|---|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {r['plant']} | {r['problem']} | {r['ten_calls_s']:.3f} | {r['least_s']:.3f} | {r['most_s']:.3f} | "
        f"{r['residual']:.0e} |"
        for r in rows
    ]
    (args.out / "learning.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
