"""Study: streams of any length in constant memory, online updates, and files of saved layers.

    python -m scripts.study_stream             # about 2 minutes on one core, 10 million samples included
    python -m scripts.study_stream --quick     # about 30 s: a hundredth of the samples

Every stream is one ongoing recording of a linear plant with noise, simulated chunk by chunk, in a process of its own.
Rows are saved as they are made; a run that is stopped goes on where it was (`--fresh` starts over). Leaves, in
results/:

    stream.csv              one line a row: part, plant, quantity, value
    stream.md               the same as tables
    stream_adaptation.png   tracking when the plant changes, with the recorded data fixed and updated
"""

from __future__ import annotations

import csv
import functools
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.signal import lfilter
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.masses import Masses
from scripts.experiments.stream_adaptation import CHANGE, FORGETTINGS, SEEDS, plot, track
from scripts.shared.command import arguments, versions
from scripts.shared.rows import Array

T_INI, HORIZON = Masses.t_ini, Masses.horizon
CHUNK = 20_000  # samples that the plant makes at once
NOISE = 1e-2
SAMPLES = {"masses": (100_000, 1_000_000, 10_000_000), "quadrotor": (100_000, 1_000_000)}
QUICK = 100  # --quick makes this share
WEIGHTS: dict[str, Any] = {"Q": 10.0, "R": 1.0, "lambda_g": Masses.lambda_g, "lambda_s": Masses.lambda_s}
UPDATES = 300
N_G = (500, 50_000)
SEED = 0


def plant(name: str) -> tuple[Array, Array, Array]:
    """Return A, B, C: damped masses, or a random stable plant of 12 states with the quadrotor's 3 inputs, 6 outputs."""
    if name == "masses":
        masses = dpc.systems.OscillatingMasses(damping=0.1)
        return masses.A.numpy(), masses.B.numpy(), np.eye(4)
    source = np.random.default_rng(SEED)
    A = source.standard_normal((12, 12))
    A *= 0.98 / np.abs(np.linalg.eigvals(A)).max()
    return A, source.standard_normal((12, 3)), source.standard_normal((6, 12)) / 10


def recorder(name: str, samples: int) -> Iterator[tuple[Array, Array]]:
    """Yield chunks of one ongoing recording: uniform inputs, noisy outputs. Each mode is a filter of its own."""
    A, B, C = plant(name)
    modes, V = np.linalg.eig(A)
    drive, read = np.linalg.solve(V, B), C @ V
    source, state = np.random.default_rng(SEED), np.zeros(len(A), dtype=complex)
    for first in range(0, samples, CHUNK):
        u = source.uniform(-1.0, 1.0, (min(CHUNK, samples - first), B.shape[1]))
        forced = u @ drive.T
        z = np.empty((len(u) + 1, len(A)), dtype=complex)
        z[0] = state
        for i, mode in enumerate(modes):  # z[k + 1] = mode z[k] + forced[k]
            z[1:, i] = lfilter([1.0], [1.0, -mode], forced[:, i], zi=[mode * state[i]])[0]
        state = z[-1]
        yield u, (z[:-1] @ read.T).real + NOISE * source.standard_normal((len(u), len(C)))


def stream(name: str, samples: int) -> dict[str, float]:
    """Return time and memory of one stream, and the rounding in its factor; meant for a process of its own.

    The time is that of the processor, which other processes on the machine touch least.
    """
    torch.set_num_threads(1)
    warm = dpc.HankelData.from_stream(recorder(name, 2000), t_ini=T_INI, horizon=HORIZON)  # code, buffers, threads
    del warm
    held = dpc.HankelStream(t_ini=T_INI, horizon=HORIZON)
    depth, before = T_INI + HORIZON, _peak_mb()
    times, first_mb, squares, tail = [], 0.0, 0.0, np.zeros(0)
    for u, y in tqdm(recorder(name, samples), total=-(-samples // CHUNK), desc=f"{name}, {samples:,}", unit="chunk"):
        began = time.process_time()
        held.append(u, y)
        times.append((time.process_time() - began) / len(u))
        first_mb = first_mb or _peak_mb()
        squares = squares + np.square(u).sum(axis=0)
        tail = u[1 - depth :]
    data = held.data
    # The first step's inputs of all windows are all inputs but the last depth - 1: |row|^2 is known without the factor.
    exact = squares - np.square(tail).sum(axis=0)
    kept = data.Up[: data.n_u].square().sum(dim=1).numpy()
    part = max(len(times) // 10, 1)
    return {
        "samples": samples,
        "windows": data.n_windows,
        "peak [MB]": _peak_mb(),
        "growth over all chunks [MB]": _peak_mb() - before,
        "growth after the first chunk [MB]": _peak_mb() - first_mb,
        "CPU time a sample [us]": 1e6 * float(np.mean(times)),
        "first tenth [us]": 1e6 * float(np.median(times[:part])),
        "last tenth [us]": 1e6 * float(np.median(times[-part:])),
        "rounding of row norms": float(np.abs(kept / exact - 1).max()),
    }


def updates(name: str, count: int) -> dict[str, float]:
    """Return the times of an update by one sample, and apart from it of the layer's reduction [ms]."""
    torch.set_num_threads(1)
    held = dpc.HankelStream(t_ini=T_INI, horizon=HORIZON, forgetting=0.999)
    (u, y), *_ = recorder(name, 2000 + count)
    held.append(u[:2000], y[:2000])
    layer = dpc.DPCLayer(held.data, **WEIGHTS, u_set=dpc.Box(-1.0, 1.0))
    update: list[float] = []
    row_space: list[float] = []
    reduction: list[float] = []

    def renewed(k: int) -> dpc.HankelData:
        held.append(u[k], y[k])
        return held.data

    for k in range(2000, 2000 + count):
        data = _timed(update, functools.partial(renewed, k))
        if k % 10 == 0:
            _timed(row_space, functools.partial(getattr, data, "row_space"))
            layer.data = data
            _timed(reduction, lambda: layer.reduction)
    out = {"rows": float(sum(len(m) for m in held.data.matrices))}
    for label, times in (("update", update), ("row space", row_space), ("reduction", reduction)):
        out |= {f"{label} [ms]": float(np.median(times)), f"{label}, 95 % [ms]": float(np.percentile(times, 95))}
    return out


def files(name: str, n_g: int) -> dict[str, float]:
    """Return the sizes [kB] of saved layers of n_g windows, the time to read one, and how far plans move."""
    torch.set_num_threads(1)
    u, y = (np.concatenate(part) for part in zip(*recorder(name, n_g + T_INI + HORIZON - 1), strict=True))
    data = dpc.HankelData.from_trajectories(u, y, t_ini=T_INI, horizon=HORIZON)
    layer = dpc.DPCLayer(data, **WEIGHTS, u_set=dpc.Box(-1.0, 1.0))
    window = [torch.from_numpy(signal[100 : 100 + T_INI]) for signal in (u, y)]
    out: dict[str, float] = {"windows": n_g}
    with tempfile.TemporaryDirectory() as folder:
        for label, whole in (("compact", False), ("with windows", True)):
            path = Path(folder) / f"{label}.safetensors"
            layer.save(path, data=whole)
            times: list[float] = []
            back = _timed(times, functools.partial(dpc.DPCLayer.load, path))
            moved = (back(*window).u - layer(*window).u).abs().max()
            out |= {f"{label} [kB]": path.stat().st_size / 1e3, f"{label}, read [ms]": times[0]}
            out[f"{label}, change of u"] = float(moved)
    return out


def adaptation(forgetting: float, seed: int) -> dict[str, float]:
    """Return the error [m] at each step of a run in which the plant changes; forgetting 0 stands for fixed data."""
    torch.set_num_threads(1)
    return {f"error {k}": error for k, error in enumerate(track(forgetting, seed))}


def in_a_process(function: Callable[..., dict[str, float]], given: tuple[Any, ...]) -> dict[str, float]:
    """Return the function's result from a process of its own, so that its peak memory is its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *given).result()


def _timed(times: list[float], function: Callable[[], Any]) -> Any:
    began = time.perf_counter()
    result = function()
    times.append(1e3 * (time.perf_counter() - began))
    return result


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# --- rows and tables --------------------------------------------------------------------------------------------------


def jobs(quick: bool) -> list[tuple[Callable[..., dict[str, float]], tuple[Any, ...]]]:
    """Return what is to be done, a function and its arguments each."""
    share = QUICK if quick else 1
    listed: list[tuple[Callable[..., dict[str, float]], tuple[Any, ...]]] = []
    listed += [(stream, (name, samples // share)) for name, lengths in SAMPLES.items() for samples in lengths]
    listed += [(updates, (name, UPDATES)) for name in SAMPLES]
    listed += [(files, (name, n_g)) for name in SAMPLES for n_g in (N_G[:1] if quick else N_G)]
    return listed + [(adaptation, (forgetting, seed)) for forgetting in FORGETTINGS for seed in range(SEEDS)]


def errors_of(done: dict[tuple[str, str], dict[str, float]]) -> dict[float, Array]:
    """Return the errors when the plant changes, `(seeds, steps)`, by the forgetting."""
    keys = {f: [("adaptation", json.dumps([f, seed])) for seed in range(SEEDS)] for f in FORGETTINGS}
    return {f: np.array([list(done[key].values()) for key in some]) for f, some in keys.items()}


def tables(done: dict[tuple[str, str], dict[str, float]], note: str) -> str:
    """Return the report."""
    titles = {
        "stream": "Streams, one recording each",
        "updates": "Online update by one sample, and apart from it what the layer then does",
        "files": "Files of saved layers",
    }
    lines = ["# Data that never stops", "", f"{note}. t_ini = {T_INI}, horizon = {HORIZON}, one thread.", ""]
    for part, title in titles.items():
        rows = [(json.loads(key)[0], row) for (of, key), row in done.items() if of == part]
        lines += [f"## {title}", "", "| plant | " + " | ".join(rows[0][1]) + " |", "|---|" + "---:|" * len(rows[0][1])]
        lines += [f"| {name} | " + " | ".join(f"{v:,.4g}" if v < 1e4 else f"{v:,.0f}" for v in row.values()) + " |"
                  for name, row in rows]  # fmt: skip
        lines.append("")
    spans = {"10 s before": (-100, 0), "10 s after": (0, 100), "10 to 30 s": (100, 300), "60 to 80 s": (600, 800)}
    lines += ["## The plant changes", "", f"Mean distance to the reference around the change [m], {SEEDS} seeds.", ""]
    lines += ["| data | " + " | ".join(spans) + " |", "|---|" + "---:|" * len(spans)]
    for forgetting, error in errors_of(done).items():
        name = f"updated, forgetting {forgetting}" if forgetting else "fixed"
        means = [error[:, CHANGE + first : CHANGE + last].mean() for first, last in spans.values()]
        lines.append(f"| {name} | " + " | ".join(f"{mean:.4f}" for mean in means) + " |")
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="a hundredth of the samples")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "stream.csv"
    done: dict[tuple[str, str], dict[str, float]] = {}
    if path.exists() and not args.fresh:
        with path.open(newline="") as file:
            for part, key, quantity, value in list(csv.reader(file))[1:]:
                done.setdefault((part, key), {})[quantity] = float(value)
    else:
        path.write_text("part,arguments,quantity,value\n")
    wanted = [(function, given, (function.__name__, json.dumps(given))) for function, given in jobs(args.quick)]
    for function, given, key in tqdm(wanted, desc="Stream study", unit="row"):
        if key in done:
            continue
        done[key] = in_a_process(function, given)
        with path.open("a", newline="") as file:
            csv.writer(file).writerows([*key, quantity, repr(value)] for quantity, value in done[key].items())
    chosen = {key: done[key] for _, _, key in wanted}
    (args.out / "stream.md").write_text(tables(chosen, versions(1, 1)))
    plot(args.out / "stream_adaptation.png", errors_of(chosen))
    print(f"Stream study: {args.out / 'stream.md'}")


if __name__ == "__main__":
    main()
