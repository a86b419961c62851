"""One row of the benchmark, measured in a process of its own.

Forward is a call without a graph; forward + backward a call with one on y_ini and the backward of sum(u). The clock
runs around each call. What has been measured so far is told after every stage, so that a row that is stopped keeps it.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.bench.cases import CYCLE, LOOP, N_G, OURS, T_INI, Row, layer_of, read_case, record, take
from scripts.bench.daqp_loop import DaqpLoop
from scripts.bench.higher_precision import relative
from scripts.bench.timing import BUDGET, MOST_REPEATS, forget_peak, least_repeats, limit_memory, peak, repeat, summary
from scripts.shared.rows import Array

#: What marks a line of the row's own among whatever the peers print.
MARK = "@row "
#: Set-ups that take less than this many seconds are repeated so often.
QUICK_SET_UP, SET_UPS = 1.0, 5

Problem = dict[str, Tensor]
Told = dict[str, Any]


class Solver:
    """The layer, a peer or the loop, behind one call.

    Args:
        row: which one, on what.
        recording: inputs and outputs that the layer plans from.

    Attributes:
        setup_ms: its set-up time, ours from the recording on, a peer's on top of that.
    """

    def __init__(self, row: Row, recording: tuple[Tensor, Tensor]):
        self.call: Any
        began = time.perf_counter()
        self.call = layer = layer_of(row.plant, *recording, row.horizon, OURS.get(row.name, "auto"))
        layer.reduction  # noqa: B018  (factors now)
        if row.name not in OURS:
            began = time.perf_counter()
            self.call = DaqpLoop(layer) if row.name == LOOP else _peers()[row.name].make(layer)
        self.setup_ms = 1e3 * (time.perf_counter() - began)
        self.is_loop = row.name == LOOP
        self.differentiable = row.name in OURS or (not self.is_loop and _peers()[row.name].kind == "differentiable")
        size = "reduced_kkt_size" if row.name in OURS else "kkt_size"
        self.kkt_size = int(getattr(self.call, size)) if self.differentiable else None

    def prepare(self, problem: Problem) -> Any:
        """Return a problem as the solver takes it."""
        return self.call.prepare(problem) if self.is_loop else problem

    def forward(self, problem: Any) -> None:
        """Plan without a graph."""
        with torch.no_grad():
            self.call(**problem)

    def with_graph(self, problem: Any) -> tuple[Any, Tensor]:
        """Return the plan and the y_ini that it hangs on."""
        y_ini = problem["y_ini"].detach().requires_grad_()
        return self.call(**{**problem, "y_ini": y_ini}), y_ini

    def both(self, problem: Any) -> float:
        """Plan and differentiate sum(u); return when the plan was there."""
        loss = self.with_graph(problem)[0].u.sum()
        planned = time.perf_counter()
        loss.backward()
        return planned

    def found(self, problem: Any) -> tuple[Array, Array | None, str, list[float]]:
        """Return v = (u, y), the gradient of sum(u), the solver's words, and the times [ms] of the two steps."""
        began = time.perf_counter()
        if self.is_loop:
            return self.call(**problem), None, "", []
        sol, y_ini = self.with_graph(problem) if self.differentiable else (self.call(**problem), None)
        loss = sol.u.sum()
        planned = time.perf_counter()
        if y_ini is not None:
            loss.backward()
        times = [1e3 * (moment - began) for moment in (planned, time.perf_counter())]
        v = torch.cat([sol.u.flatten(-2), sol.y.flatten(-2)], dim=-1).detach().numpy()
        gradient = None if y_ini is None or y_ini.grad is None else y_ini.grad.numpy()
        return v, gradient, getattr(sol.info, "message", ""), times


def measure(row: Row, case: Path, mode: str, threads: int) -> None:
    """Measure one row and tell the results, stage by stage, on standard output."""
    torch.set_num_threads(threads)
    limit_memory()
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
    of_n_g = recording if row.n_g == N_G or not row.scaling else record(row.plant, row.n_g + T_INI + row.horizon - 1)
    _warm_up_imports(row)

    forget_peak()
    before = peak()
    solver = Solver(row, of_n_g)
    told |= {"setup_ms": solver.setup_ms, "kkt_size": solver.kkt_size}
    _tell(told)

    problems = [take(inputs, i) for i in range(CYCLE)] if row.batch == 1 else [take(inputs, slice(row.batch))]
    problems = [solver.prepare(problem) for problem in problems]
    call: Any = solver.forward
    note, began = "", time.perf_counter()
    try:
        call(problems[0])
        first = time.perf_counter() - began
    except Exception:  # some peers can be called with a graph alone
        if not solver.differentiable:
            raise
        call, note = solver.with_graph, "forward is timed with a graph, without one it fails"
        found, times = _errors(solver, row, inputs, reference, np.inf)
        told |= found
        first = times[0, 0] / 1e3
    told |= {"first_ms": 1e3 * first, **summary("forward", np.array([1e3 * first]))}
    _tell(told)
    if row.scaling:
        told |= _beside(solver, Solver(row, recording), problems)
    elif least_repeats(first) > 1:
        told |= summary("forward", repeat(lambda i: call(problems[i % len(problems)]), budget, first)[:, 0])
    told["peak_mb"] = peak() - before

    if not note or least_repeats(first) > 1:
        told |= _errors(solver, row, inputs, reference, first)[0]
    told |= {"message": "; ".join(part for part in (told["message"], note) if part), "peak_mb": peak() - before}
    _tell(told)
    if solver.differentiable and least_repeats(first) > 1:
        repeated = repeat(lambda i: solver.both(problems[i % len(problems)]), budget, first)
        told |= summary("both", repeated[:, 0]) | summary("backward", repeated[:, 1]) | {"peak_mb": peak() - before}
        _tell(told)
    set_ups = [solver.setup_ms]
    while least_repeats(first) > 1 and solver.setup_ms < 1e3 * QUICK_SET_UP and len(set_ups) < SET_UPS:
        set_ups.append(Solver(row, of_n_g).setup_ms)
    told["setup_ms"] = np.median(set_ups)


def _errors(solver: Solver, row: Row, inputs: Problem, reference: dict[str, Array], first: float) -> tuple[Told, Array]:
    """Return the largest relative errors over the problems with a reference, and the times of these calls.

    The times are [ms], `(calls, 2)`: to the plan, and to the gradient.
    """
    checked = reference["checked"].tolist()
    if row.batch > 1:
        calls = [(take(inputs, slice(row.batch)), list(enumerate(checked)))]
    else:  # a slow solver is looked at once
        calls = [
            (take(inputs, i), [(k, ...)]) for k, i in enumerate(checked[: 1 if least_repeats(first) < 5 else None])
        ]
    worst: Told = {"message": "", "checked": sum(len(pairs) for _, pairs in calls)}
    times: list[list[float]] = []
    for problem, pairs in calls:
        v, gradient, words, spent = solver.found(solver.prepare(problem))
        worst["message"] = words or worst["message"]
        times += [spent] if gradient is not None else []
        for k, i in pairs:
            errors = {"solution_error": relative(v[i], reference["v"][k])}
            if gradient is not None:
                errors["gradient_error"] = relative(gradient[i], reference["gradient"][k])
            for name, error in errors.items():
                worst[name] = max(worst.get(name, 0.0), np.inf if np.isnan(error) else error)
    if times:
        planned, done = np.array(times).T
        worst |= summary("both", done) | summary("backward", done - planned)
    return worst, np.array(times)


def _beside(solver: Solver, other: Solver, problems: list[Any]) -> Told:
    """Time two layers turn by turn; return the summary of the first and the ratio of the medians."""
    times = np.empty((2, MOST_REPEATS))
    for i in range(-50, MOST_REPEATS):  # the first 50 are overwritten: they warm up
        for k, one in enumerate((solver, other)):
            began = time.perf_counter()
            one.forward(problems[i % len(problems)])
            times[k, i] = 1e3 * (time.perf_counter() - began)
    return summary("forward", times[0]) | {"ratio": float(np.median(times[0]) / np.median(times[1]))}


def _warm_up_imports(row: Row) -> None:
    """Make and call the solver on a tiny problem, so that imports count neither as time nor as memory.

    A peer that fails there has its chance on the real problem.
    """
    u, y = record("masses", 40)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=4)
    layer = dpc.DPCLayer(data, 1.0, 1.0, 1.0, 1e3, dpc.Box(-1.0, 1.0), dpc.Box(-9.0, 9.0))
    solvers: list[Any] = [layer]
    if row.name not in (*OURS, LOOP):
        solvers.append(_peers()[row.name].make(layer))
    try:
        for solver in solvers:
            u_plan = solver(u[:2], y[:2].clone().requires_grad_()).u
            if u_plan.requires_grad:
                u_plan.sum().backward()
    except Exception as error:
        print(f"on the tiny problem: {error}", file=sys.stderr)


def _peers() -> dict[str, Any]:
    from baselines import PEERS

    return PEERS


def _tell(told: Told) -> None:
    print(f"\n{MARK}{json.dumps(told, default=float)}", flush=True)
