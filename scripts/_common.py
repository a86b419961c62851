"""What the scripts share: the command line, runs on all cores, rows on disk, statistics, versions."""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

import torch_dpc as dpc

Array = NDArray[Any]
Rows = dict[str, Array]

RESULTS = Path(__file__).resolve().parent.parent / "results"
NOMINAL, RANDOM, POISON = "nominal", "random", "algorithm1"
ATTACK_SEED = 1000  # the noise of seed s is drawn from ATTACK_SEED + s, the same directions at every rho
BAND = (10, 90)  # percentiles over the seeds


def arguments(doc: str, seeds: int = 10) -> argparse.ArgumentParser:
    """Return the command line that all scripts have."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=seeds, help=f"how many, from 0 on (default {seeds})")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default results/)")
    parser.add_argument("--workers", type=int, default=cores(), help="processes (default: one a core)")
    return parser


def cores() -> int:
    """Return the cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def attacks(layer: dpc.DPCLayer, cost: Any, rhos: Iterable[float]) -> Iterator[tuple[str, float, Any]]:
    """Yield the name, rho and attack of every run: no attack first, then random noise and Algorithm 1 at each rho."""
    yield NOMINAL, 0.0, None
    for rho in rhos:
        budget = dpc.attacks.RelativeBall(rho)
        yield RANDOM, rho, dpc.attacks.RandomAttack(budget)
        yield POISON, rho, dpc.attacks.LinearizedAttack(layer, cost, budget)


# --- runs on all cores -----------------------------------------------------------------------------------------------


def run_all(function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], workers: int, label: str) -> list[Any]:
    """Return `function(*job)` of every job, in order, with a progress bar.

    Every job runs on one thread, so the numbers do not depend on how many run at once.
    """
    results: list[Any] = [None] * len(jobs)
    workers = min(workers, len(jobs))
    with tqdm(total=len(jobs), desc=label, unit="seed") as bar:
        if workers <= 1:
            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            for i, job in enumerate(jobs):
                results[i] = function(*job)
                bar.update()
            torch.set_num_threads(threads)
            return results
        context = multiprocessing.get_context("spawn")  # a forked torch may hang on its thread pool
        with ProcessPoolExecutor(workers, context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            index = {pool.submit(function, *job): i for i, job in enumerate(jobs)}
            for done in as_completed(index):
                results[index[done]] = done.result()
                bar.update()
    return results


# --- rows on disk ----------------------------------------------------------------------------------------------------


def write_rows(path: Path, runs: Iterable[dict[str, Any]], note: str) -> None:
    """Write runs, dictionaries of columns, one row a time step; a scalar is repeated. The note comes first, after #."""
    with path.open("w", newline="") as file:
        file.write(f"# {note}\n")
        writer = csv.writer(file)
        for i, run in enumerate(runs):
            if i == 0:
                writer.writerow(run)
            steps = max(np.size(value) for value in run.values())
            writer.writerows(zip(*(_cells(value, steps) for value in run.values()), strict=True))


def _cells(value: Any, steps: int) -> list[str]:
    if isinstance(value, str):
        return [value] * steps
    return [f"{entry:.9g}" for entry in np.broadcast_to(np.asarray(value), (steps,))]


def read_rows(path: Path) -> Rows:
    """Return the columns of a file of `write_rows`: floats, and strings where a cell is no number."""
    with path.open(newline="") as file:
        names, *rows = csv.reader(line for line in file if not line.startswith("#"))
    return {name: _parsed(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def _parsed(column: tuple[str, ...]) -> Array:
    try:
        return np.array(column, dtype=float)
    except ValueError:
        return np.array(column)


def grid(rows: Rows, column: str, attack: str, rho: float) -> Array:
    """Return one column of the runs under one attack, `(seeds, steps)`."""
    chosen = (rows["attack"] == attack) & np.isclose(rows["rho"], rho, rtol=1e-6)
    return rows[column][chosen].reshape(len(np.unique(rows["seed"])), -1)


def write_pgf(path: Path, t: Array, columns: Sequence[Array]) -> None:
    """Write a table as the paper's plots read it: `iter rho1 rho2 ...`, separated by spaces; `iter` is the time [s]."""
    header = " ".join(["iter", *(f"rho{i + 1}" for i in range(len(columns)))])
    np.savetxt(path, np.column_stack([t, *columns]), fmt="%.6g", header=header, comments="")


# --- statistics ------------------------------------------------------------------------------------------------------


def band(values: Array) -> tuple[Array, Array, Array]:
    """Return the median over the seeds, the first axis, and the ends of the band around it."""
    low, median, high = np.percentile(values, (BAND[0], 50, BAND[1]), axis=0)
    return median, low, high


def spread(values: Array) -> dict[str, float]:
    """Return the mean, the median and the extremes over the seeds."""
    return {name: float(getattr(np, name)(values)) for name in ("mean", "median", "min", "max")}


def summarise(rows: Rows, rhos: Sequence[float]) -> dict[str, Any]:
    """Return the error of each run, averaged over its time, over the seeds, and how the attacks compare at each rho.

    The ratios are those of the means over the seeds. What an attack adds is its error less the nominal one, and the
    ratio of what they add is None where random noise adds nothing.
    """
    nominal = grid(rows, "error", NOMINAL, 0.0).mean(axis=1)
    levels = []
    for rho in rhos:
        random, poison = (grid(rows, "error", attack, rho).mean(axis=1) for attack in (RANDOM, POISON))
        added = {"random": random - nominal, "poison": poison - nominal}
        adds = added["random"] > 1e-3 * nominal
        levels.append(
            {
                "rho": rho,
                "seeds": len(nominal),
                "random": spread(random),
                "poison": spread(poison),
                "ratio": float(poison.mean() / random.mean()),
                "ratio_by_seed": spread(poison / random),
                "added_random": spread(added["random"]),
                "added_poison": spread(added["poison"]),
                "added_ratio": float(added["poison"].mean() / added["random"].mean())
                if added["random"].mean() > 1e-3 * nominal.mean()
                else None,
                "added_ratio_by_seed": spread(added["poison"][adds] / added["random"][adds]) if adds.any() else None,
                "seeds_where_random_adds": int(adds.sum()),
            }
        )
    return {"seeds": len(nominal), "nominal": spread(nominal), "levels": levels}


# --- what a result was made with -------------------------------------------------------------------------------------


def versions(seeds: int, workers: int) -> str:
    """Return one line: package versions, seeds, processes and threads."""
    return (
        f"torch_dpc {dpc.__version__}, torch {torch.__version__}, numpy {np.__version__}, "
        f"Python {platform.python_version()}; seeds 0 to {seeds - 1}; "
        f"{min(workers, seeds)} processes of 1 thread"
    )


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write what `report.py` reads."""
    path.write_text(json.dumps(content, indent=1) + "\n")
