"""Profile: where a call of the layer spends its time, at batch 1 and batch 1024.

    python -m scripts.profile_layer         # about 15 s on two cores

The oscillating masses at horizon 25, the problems of `benchmark.py`. Each stage is timed alone, on the inputs that it
has in the call, so the stages need not add up to the call to the last microsecond. Leaves results/profile.md.

The floor is what the arithmetic alone would cost at the rate of a large float64 matrix product timed in the same run:
v0 = C A theta (2 (r n_theta + N r) flops a problem) and one Cholesky solve with the active rows (k^3/3 + 2 k^2), each
once forward and once backward.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.bench.cases import CYCLE, N_G, T_INI, inputs_of, layer_of, record, take
from scripts.shared.command import RESULTS, cores, versions
from torch_dpc.sets.bounds import Bounds
from torch_dpc.solve import kernels

PLANT, HORIZON, BATCHES = "masses", 25, (1, 1024)
BUDGET, LEAST, MOST = 6.0, 7, 2000  # [s] and rounds of each batch size; a round runs every stage once
RATE_SIZE = 1500  # of the matrix product that shows the machine's rate

Problem = dict[str, Tensor]
Stages = dict[str, Callable[[int], Any]]


def microseconds(stages: Stages) -> dict[str, float]:
    """Return the median time of each stage [us]; turn by turn, so that all see the same machine."""
    times: list[list[float]] = []
    end = time.perf_counter() + BUDGET
    while len(times) < LEAST or (time.perf_counter() < end and len(times) < MOST):
        row = []
        for stage in stages.values():
            began = time.perf_counter()
            stage(len(times))
            row.append(1e6 * (time.perf_counter() - began))
        times.append(row)
    return dict(zip(stages, np.median(times[2:], axis=0).tolist(), strict=True))


def calls_of(layer: dpc.DPCLayer, problems: list[Problem]) -> Stages:
    """Return whole calls: without a graph, with one, its backward, and both in one go."""

    def with_graph(i: int) -> Tensor:
        problem = problems[i % len(problems)]
        return layer(**{**problem, "y_ini": problem["y_ini"].detach().requires_grad_()}).u.sum()

    graphs = [with_graph(i) for i in range(len(problems))]
    return {
        "forward": lambda i: layer(**problems[i % len(problems)]),
        "forward with a graph": with_graph,
        "backward of sum(u)": lambda i: graphs[i % len(graphs)].backward(retain_graph=True),
        "forward + backward": lambda i: with_graph(i).backward(),
    }


def stages_of(layer: dpc.DPCLayer, problems: list[Problem]) -> tuple[Stages, Stages, Stages]:
    """Return the stages around the solve, inside it, and of the backward; and the whole solve among the first."""
    device = torch.device("cpu")
    solver = layer.factored(device).solver
    planner, sets = solver.compiled, Bounds(*layer.bounds(device))
    assert planner is not None
    thetas = [_theta(layer, problem) for problem in problems]
    arrays = planner.arrays(sets, thetas[0].shape[:-1], device)
    assert arrays is not None
    flat, V, n = [theta.reshape(-1, theta.shape[-1]) for theta in thetas], planner.reduction.V, len(problems)
    starts = [None if len(theta) == 1 else (theta @ V.mT).numpy() for theta in flat]  # the kernel's own for one
    planned = [solver.solve(theta, sets, "raise") for theta in thetas]
    at = [(p.lam, p.lam, p.active, p.active) for p in planned]
    bars, threads = [np.ones(p.lam.shape) for p in planned], torch.get_num_threads()
    around = {
        "checks and flattening": lambda i: _theta(layer, problems[i % n]),
        "weights and bounds unchanged?": lambda i: (layer.factored(device), layer.bounds(device)),
        "the whole solve": lambda i: solver.solve(thetas[i % n], sets, "raise"),
    }
    inside: Stages = {
        "kernel: multipliers, plan, judgement": lambda i: kernels.plan(
            planner.map, arrays, flat[i % n].numpy(), starts[i % n], threads
        ),
    }
    if starts[0] is not None:
        inside = {"V theta": lambda i: flat[i % n] @ V.mT, **inside}
    backward = {"kernel: adjoint, and V'": lambda i: planner.adjoint(sets, at[i % n], bars[i % n], None)}
    return around, inside, backward


def _theta(layer: dpc.DPCLayer, problem: dict[str, Tensor]) -> Tensor:
    return layer.flatten(problem["u_ini"], problem["y_ini"], problem.get("y_ref"), problem.get("u_ref"))[0]


def flops(layer: dpc.DPCLayer, problems: list[dict[str, Tensor]]) -> tuple[float, float, float]:
    """Return the flops of v0 and of the active systems in one direction, and the mean number of active rows."""
    reduction = layer.reduction
    products, systems, active = [], [], []
    for problem in problems:
        k = layer(**problem).info.n_active.double()
        products.append(2.0 * k.numel() * (reduction.A_theta.numel() + reduction.rows.C.numel()))
        systems.append(float((k**3 / 3 + 2 * k**2).sum()))
        active.append(float(k.mean()))
    return float(np.mean(products)), float(np.mean(systems)), float(np.mean(active))


def rate() -> float:
    """Return the flops a microsecond of a large float64 matrix product."""
    a = torch.rand(RATE_SIZE, RATE_SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    times = []
    for _ in range(8):
        began = time.perf_counter()
        a @ a
        times.append(1e6 * (time.perf_counter() - began))
    return 2 * RATE_SIZE**3 / float(np.median(times))


def profile(layer: dpc.DPCLayer, inputs: Problem, batch: int, per_us: float) -> list[str]:
    """Return the lines of one batch size."""
    problems = [take(inputs, i) for i in range(CYCLE)] if batch == 1 else [take(inputs, slice(batch))]
    calls, (around, inside, backward) = calls_of(layer, problems), stages_of(layer, problems)
    spent = microseconds(calls | around | inside | backward)
    solve, both = spent.pop("the whole solve"), spent["forward + backward"]
    flatten, unchanged = (spent[name] for name in around if name != "the whole solve")
    rest = {
        "the rest of the solve": solve - sum(spent[name] for name in inside),
        "results and the rest of the call": spent["forward"] - solve - flatten - unchanged,
        "autograd, forward": spent["forward with a graph"] - spent["forward"],
        "autograd, backward": spent["backward of sum(u)"] - sum(spent[name] for name in backward),
        "both in one go, beyond its parts": both - spent["forward with a graph"] - spent["backward of sum(u)"],
    }
    products, systems, active = flops(layer, problems)
    totals = {name: spent.pop(name) for name in calls} | {"floor": 2 * (products + systems) / per_us}
    lines = [f"## Batch {batch}", "", "| stage | time [us] | a problem [us] | share of forward + backward |"]
    lines.append("|---|---:|---:|---:|")
    for mark, group in (("", spent | rest), ("**", totals)):
        lines += [f"| {mark}{k}{mark} | {t:,.1f} | {t / batch:,.2f} | {t / both:.0%} |" for k, t in group.items()]
    lines += [
        "",
        f"Floor: {2 * products / batch:,.0f} flops a problem for v0 and its transpose, {2 * systems / batch:,.0f} for "
        f"the systems, {active:.1f} active rows on average. Forward + backward takes {both / totals['floor']:,.1f} "
        "times the floor.",
        "",
    ]
    return lines


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=cores(), help="of torch (default: one a core)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default results/)")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    if not kernels.has_kernels(torch.ones(())):
        raise SystemExit("The kernels were not built, so there is nothing to profile: install with a C compiler.")
    recording = record(PLANT, N_G + T_INI + HORIZON - 1)
    layer = layer_of(PLANT, *recording, HORIZON)
    inputs = inputs_of(PLANT, layer, *recording)
    per_us = rate()
    made_with = versions(1, 1).split(";")[0]
    lines = ["# Where a call spends its time", "", f"{made_with}; seed 0; {args.threads} threads.", ""]
    lines += [
        f"{PLANT.capitalize()}, horizon {HORIZON}, n_g {N_G}. Medians of calls, the stages turn by turn. Rate of a "
        f"float64 matrix product ({RATE_SIZE} x {RATE_SIZE}): {per_us / 1e3:.1f} Gflop/s.",
        "",
    ]
    for batch in BATCHES:
        lines += profile(layer, inputs, batch, per_us)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "profile.md").write_text("\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
