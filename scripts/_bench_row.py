"""One row of the benchmark, measured in a process of its own.

Forward is a call without a graph; forward + backward a call with one on y_ini and the backward of sum(u). The clock
runs around each call. What has been measured so far is told after every stage, so that a row that is stopped keeps it.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from _bench_cases import CYCLE, LOOP, N_G, OURS, T_INI, Row, layer_of, read_case, record, take
from _common import Array
from _daqp_loop import DaqpLoop
from _reference import relative

#: What marks a line of the row's own among whatever the peers print.
MARK = "@row "
#: Seconds of repeats for each time, and the most and least of them; a call longer than `LONG` is made once.
BUDGET, MOST_REPEATS, LEAST_REPEATS, LONG = {"full": 1.0, "quick": 0.5}, 500, 5, 4.0
WARM_UP = 0.2  # [s]
#: Of the machine's memory, so that a peer that asks for too much is told so, instead of being killed with others.
MEMORY_SHARE = 0.75

Told = dict[str, Any]


def measure(row: Row, case: Path, mode: str, threads: int) -> None:
    """Measure one row and tell the results, stage by stage, on standard output."""
    torch.set_num_threads(threads)
    limit = int(MEMORY_SHARE * _memory_of_machine())
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    told: Told = {"status": "ok", "message": ""}
    try:
        _measure(row, case, BUDGET[mode], told)
    except ImportError as error:
        told |= {"status": "not installed", "message": str(error)}
    except Exception as error:  # whatever a peer raises belongs in its row
        told |= {"status": "failed", "message": f"{type(error).__name__}: {error}"}
    _tell(told)


def _measure(row: Row, case: Path, budget: float, told: Told) -> None:
    recording, inputs, reference = read_case(case)
    differentiable = _warm_up_imports(row)
    if row.n_g != N_G and row.scaling:
        of_n_g = record(row.plant, row.n_g + T_INI + row.horizon - 1)
    else:
        of_n_g = recording
    problems = [take(inputs, i) for i in range(CYCLE)] if row.batch == 1 else [take(inputs, slice(row.batch))]

    _forget_peak()
    before = _peak()
    solver, told["setup_ms"] = _set_up(row, of_n_g)
    is_loop = isinstance(solver, DaqpLoop)
    if hasattr(solver, "kkt_size") and differentiable:
        told["kkt_size"] = int(solver.kkt_size)
    if row.name in OURS:
        told["kkt_size"] = solver.reduced_kkt_size
    calls = [solver.prepare(problem) if is_loop else problem for problem in problems]
    _tell(told)

    def with_graph(i: int) -> Tensor:
        problem = calls[i % len(calls)]
        return solver(**{**problem, "y_ini": problem["y_ini"].detach().requires_grad_()}).u

    def forward(i: int) -> None:
        with torch.no_grad():
            solver(**calls[i % len(calls)])

    began, note, call = time.perf_counter(), "", forward
    try:
        forward(0)
    except Exception:  # some peers can be called with a graph alone
        if not differentiable:
            raise
        began, note, call = time.perf_counter(), "forward is timed with a graph, without one it fails", with_graph
        with_graph(0)
    first = time.perf_counter() - began
    told |= {"first_ms": 1e3 * first, "forward_ms": 1e3 * first, "repeats": 1, "peak_mb": _peak() - before}
    _tell(told)
    if row.scaling:
        told |= _beside(solver, layer_of(row.plant, *recording, row.horizon), calls, budget)
    else:
        told |= _summary("forward", _repeat(call, budget, first)[:, 0])
    told["peak_mb"] = _peak() - before
    told |= _errors(solver, is_loop, row, inputs, reference, differentiable)
    told["message"] = "; ".join(part for part in (told["message"], note) if part)
    _tell(told)
    if not differentiable:
        return

    def both(i: int) -> float:
        loss = with_graph(i).sum()
        forward_done = time.perf_counter()
        loss.backward()
        return forward_done

    repeated = _repeat(both, budget, first)
    told |= _summary("both", repeated[:, 0]) | _summary("backward", repeated[:, 1]) | {"peak_mb": _peak() - before}


def _set_up(row: Row, recording: tuple[Tensor, Tensor]) -> tuple[Any, float]:
    """Return the solver and its set-up time [ms]: ours from the recording on, a peer's on top of that."""
    began = time.perf_counter()
    layer = layer_of(row.plant, *recording, row.horizon, OURS.get(row.name, "auto"))
    layer.reduction  # noqa: B018  (factors now)
    solver: Any = layer
    if row.name not in OURS:
        began = time.perf_counter()
        solver = DaqpLoop(layer) if row.name == LOOP else _peers()[row.name].make(layer)
    return solver, 1e3 * (time.perf_counter() - began)


def _peers() -> dict[str, Any]:
    from baselines import PEERS

    return PEERS


def _warm_up_imports(row: Row) -> bool:
    """Make and call the solver on a tiny problem, so that imports count in no time; return whether it has a gradient.

    A peer that fails on the tiny problem has its chance on the real one.
    """
    u, y = record("masses", 40)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=4)
    layer = dpc.DPCLayer(data, 1.0, 1.0, 1.0, 1e3, dpc.Box(-1.0, 1.0), dpc.Box(-9.0, 9.0))
    if row.name == LOOP:
        return False
    solver: Any = layer if row.name in OURS else _peers()[row.name].make(layer)
    differentiable = row.name in OURS or _peers()[row.name].kind == "differentiable"
    try:
        y_ini = y[:2].clone().requires_grad_()
        loss = solver(u[:2], y_ini).u.sum()
        if differentiable:
            loss.backward()
    except Exception as error:
        print(f"on the tiny problem: {error}", file=sys.stderr)
    return differentiable


# --- times -----------------------------------------------------------------------------------------------------------


def _repeat(call: Callable[[int], Any], budget: float, first: float) -> Array:
    """Return the times [ms] of the calls, `(repeats, 2)`: whole, and after the moment that the call returned."""
    least = 1 if first > LONG else LEAST_REPEATS
    i, end = 0, time.perf_counter() + min(WARM_UP, budget)
    while first < WARM_UP and time.perf_counter() < end:
        call(i)
        i += 1
    times: list[tuple[float, float]] = []
    end = time.perf_counter() + budget
    while len(times) < least or (time.perf_counter() < end and len(times) < MOST_REPEATS):
        began = time.perf_counter()
        middle = call(i)
        done = time.perf_counter()
        times.append((1e3 * (done - began), 1e3 * (done - middle) if isinstance(middle, float) else np.nan))
        i += 1
    return np.array(times)


def _summary(name: str, times: Array) -> Told:
    low, median, high = np.percentile(times, (25, 50, 75))
    return {f"{name}_ms": median, f"{name}_q1": low, f"{name}_q3": high, "repeats": len(times)}


def _beside(solver: Any, other: Any, calls: list[dict[str, Any]], budget: float) -> Told:
    """Time two layers turn by turn; return the summary of the first and the ratio of the medians."""
    times = np.empty((2, MOST_REPEATS))
    with torch.no_grad():
        for i in range(-50, MOST_REPEATS):
            for k, layer in enumerate((solver, other)):
                began = time.perf_counter()
                layer(**calls[i % len(calls)])
                times[k, i] = 1e3 * (time.perf_counter() - began)
    return _summary("forward", times[0]) | {"ratio": float(np.median(times[0]) / np.median(times[1]))}


# --- errors and memory -----------------------------------------------------------------------------------------------


def _errors(solver: Any, is_loop: bool, row: Row, inputs: Any, reference: dict[str, Array], gradient: bool) -> Told:
    """Return the largest relative errors over the samples with a reference, and the solver's words."""
    worst: Told = {"message": ""}
    checked = reference["checked"].tolist()
    parts = [(take(inputs, i), [k]) for k, i in enumerate(checked)]
    if row.batch > 1:
        parts = [(take(inputs, slice(row.batch)), list(range(len(checked))))]
    for problem, ks in parts:
        if is_loop:
            v, slope = solver(**solver.prepare(problem)), None
        else:
            y_ini = problem["y_ini"].clone().requires_grad_(gradient)
            sol = solver(**{**problem, "y_ini": y_ini})
            worst["message"] = getattr(sol.info, "message", "") or worst["message"]
            v = torch.cat([sol.u.flatten(-2), sol.y.flatten(-2)], dim=-1).detach().numpy()
            if gradient:
                sol.u.sum().backward()
            slope = y_ini.grad.numpy() if gradient else None
        for k in ks:
            i = checked[k] if row.batch > 1 else ...
            found = {"solution_error": (v[i], reference["v"][k])}
            if slope is not None:
                found["gradient_error"] = slope[i], reference["gradient"][k]
            for name, pair in found.items():
                worst[name] = max(worst.get(name, 0.0), relative(*pair), key=lambda x: np.inf if x != x else x)
        worst["checked"] = worst.get("checked", 0) + len(ks)
    return worst


def _peak() -> float:
    """Return the largest memory this process has held [MB]."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss of a new process starts at what its parent held
        return next(float(line.split()[1]) for line in status.open() if line.startswith("VmHWM")) / 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _forget_peak() -> None:
    """Let the peak start at what is held now, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _memory_of_machine() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _tell(told: Told) -> None:
    print(f"\n{MARK}{json.dumps(told, default=float)}", flush=True)
