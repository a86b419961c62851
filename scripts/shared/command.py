"""The command line, runs on all cores, and the versions that a result was made with."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import torch_dpc as dpc

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"


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


def versions(seeds: int, workers: int, first: int = 0) -> str:
    """Return one line: package versions, seeds from the first on, processes and threads."""
    return (
        f"torch_dpc {dpc.__version__}, torch {torch.__version__}, numpy {np.__version__}, "
        f"Python {platform.python_version()}; seeds {first} to {first + seeds - 1}; "
        f"{min(workers, seeds)} processes of 1 thread"
    )
