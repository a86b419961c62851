"""Times as ratios within one process: what a plan costs beside a no-op, beside DAQP, and beside a box.

Times are processor time on one thread, and all calls of a table are made in turn, block by block: other work on the
machine counts little. The time of a call is the median of its blocks' medians.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.bench.cases import CYCLE, N_G, T_INI, inputs_of, layer_of, record, take
from scripts.bench.daqp_loop import DaqpLoop
from scripts.bench.learning import learning, step_of, with_sets

HORIZON = 25
BLOCKS, WARM, MOST = 9, 3, 40  # blocks, calls of each that are not timed, and calls that are
BLOCK_TIME = 0.05  # [s] after which a block ends

Calls = dict[str, Callable[[int], Any]]
Problem = dict[str, Tensor]


class NoOp(torch.autograd.Function):
    """A Function with the signature of a plan, which computes nothing."""

    @staticmethod
    def forward(
        u_ini: Tensor, y_ini: Tensor, y_ref: Tensor | None, u_ref: Tensor | None, shapes: tuple[tuple[int, ...], ...]
    ) -> tuple[Tensor, ...]:
        return tuple(y_ini.new_empty(shape) for shape in shapes)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[3:])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(inputs[1], *output[2:])

    @staticmethod
    def backward(ctx: Any, *bars: Any) -> tuple[Tensor | None, ...]:
        return None, torch.empty_like(ctx.saved_tensors[0]), None, None, None


def milliseconds(calls: Calls) -> dict[str, float]:
    """Return the time of each call [ms]; a call takes the number of its repeat."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(BLOCKS):
        for name, call in calls.items():
            block, end = [], time.process_time() + BLOCK_TIME
            for i in range(WARM + MOST):
                began = time.process_time()
                call(i)
                done = time.process_time()
                block.append(done - began)
                if done > end:
                    break
            times[name].append(1e3 * float(np.median(block[WARM:] or block[-1:])))
    return {name: float(np.median(of_blocks)) for name, of_blocks in times.items()}


def both(layer: Any, problems: list[Problem]) -> Callable[[int], None]:
    """Return a plan with the backward of sum(u)."""

    def call(i: int) -> None:
        problem = problems[i % len(problems)]
        layer(**{**problem, "y_ini": problem["y_ini"].detach().requires_grad_()}).u.sum().backward()

    return call


def forward(layer: Any, problems: list[Problem]) -> Callable[[int], None]:
    """Return a plan without a graph."""

    def call(i: int) -> None:
        with torch.no_grad():
            layer(**problems[i % len(problems)])

    return call


def problems_of(inputs: Problem, batch: int) -> list[Problem]:
    """Return problems of one sample in turn, or one batch."""
    return [take(inputs, i) for i in range(CYCLE)] if batch == 1 else [take(inputs, slice(batch))]


def case(plant: str, count: int = 1024) -> tuple[dpc.DPCLayer, Problem]:
    """Return the layer and the inputs of a plant."""
    recording = record(plant, N_G + T_INI + HORIZON - 1)
    layer = layer_of(plant, *recording, HORIZON)
    return layer, inputs_of(plant, layer, *recording, count)


def guarded() -> dict[str, float]:
    """Return the ratios that the regression guard watches."""
    layer, inputs = case("masses", 64)
    one, many = problems_of(inputs, 1), problems_of(inputs, 64)
    data = layer.data
    v = data.horizon * (data.n_u + data.n_y)
    shapes = ((data.horizon, data.n_u), (data.horizon, data.n_y), (v,), (v,), (5,))

    def no_op(i: int) -> None:
        y_ini = one[i % CYCLE]["y_ini"].detach().requires_grad_()
        NoOp.apply(one[i % CYCLE]["u_ini"], y_ini, one[i % CYCLE]["y_ref"], None, shapes)[0].sum().backward()

    loop = DaqpLoop(layer)
    prepared, batch = [loop.prepare(problem) for problem in one], loop.prepare(many[0])
    soft = with_sets(layer, y_set=dpc.SoftBox(-5.0, 5.0, 1e3))
    ball = with_sets(layer, u_set=dpc.Ball(0.8))
    times = milliseconds(
        {
            "no-op": no_op,
            "one": both(layer, one),
            "64": both(layer, many),
            "one forward": forward(layer, one),
            "64 forward": forward(layer, many),
            "loop": lambda i: loop(**prepared[i % CYCLE]),
            "64 loop": lambda i: loop(**batch),
            "soft 64": both(soft, many),
            "ball 64": both(ball, many),
        }
    )
    return {
        "one plan and its gradient / a no-op Function": times["one"] / times["no-op"],
        "one plan / DAQP's loop": times["one forward"] / times["loop"],
        "64 plans / DAQP's loop": times["64 forward"] / times["64 loop"],
        "64 plans in a soft box / in a box": times["soft 64"] / times["64"],
        "64 plans in a ball / in a box": times["ball 64"] / times["64"],
    }


def sets_beside_boxes(plant: str) -> Iterator[tuple[str, int, float, float, float]]:
    """Yield (set, batch, ms of forward and backward, ratio to the box forward, and of both)."""
    layer, inputs = case(plant)
    largest = float(layer(**take(inputs, slice(64))).u.norm(dim=-1).max())
    layers = {
        "box": layer,
        "soft box on y, price 1e3": with_sets(layer, y_set=dpc.SoftBox(-5.0, 5.0, 1e3)),
        "soft box on y, price reached": with_sets(layer, y_set=dpc.SoftBox(-0.3, 0.3, 1e3)),
        "ball on u": with_sets(layer, u_set=dpc.Ball(0.7 * largest)),
        "cone on u": with_sets(layer, u_set=dpc.SecondOrderCone()),
    }
    for batch in (1, 64, 1024):
        problems = problems_of(inputs, batch)
        alone = milliseconds({name: forward(other, problems) for name, other in layers.items()})
        times = milliseconds({name: both(other, problems) for name, other in layers.items()})
        for name in layers:
            yield name, batch, times[name], alone[name] / alone["box"], times[name] / times["box"]


def latencies(calls: int = 20_000) -> Iterator[tuple[str, list[float]]]:
    """Yield (call, [median, 99 %, 99.9 %, worst] in ms) of single plans, the masses, one after the other."""
    layer, inputs = case("masses", 64)
    one, loop = problems_of(inputs, 1), DaqpLoop(layer)
    prepared = [loop.prepare(problem) for problem in one]
    named: Calls = {
        "torch_dpc, forward": forward(layer, one),
        "torch_dpc, forward and backward": both(layer, one),
        "DAQP in a Python loop, forward": lambda i: loop(**prepared[i % CYCLE]),
    }
    for name, call in named.items():
        times = np.empty(calls)
        for i in range(-100, calls):  # the first 100 are overwritten: they warm up
            began = time.process_time()
            call(i % CYCLE)
            times[i] = 1e3 * (time.process_time() - began)
        yield name, np.percentile(times, (50, 99, 99.9, 100)).tolist()


def learning_steps() -> dict[str, float]:
    """Return the time of a training step [ms], masses, by what learns."""
    layer, inputs = case("masses", 64)
    one = take(inputs, 0)
    weights = {"Q": layer.Q, "R": layer.R, "lambda_s": layer.lambda_s, "u_set": layer.u_set, "y_set": layer.y_set}
    many = torch.nn.Parameter(torch.logspace(0, 3, 64, dtype=torch.float64))
    steps = {
        "weights fixed, one sample": step_of(layer, one),
        "Q, R, lambda_g, lambda_s learn, one sample": step_of(learning(layer), one),
        "Q, R, lambda_g, lambda_s learn, 64 samples": step_of(learning(layer), inputs),
        "64 values of lambda_g learn, one sample each": step_of(
            dpc.DPCLayer(layer.data, lambda_g=many, **weights), inputs
        ),
    }
    return milliseconds({name: _numbered(step) for name, step in steps.items()})


def _numbered(step: Callable[[], None]) -> Callable[[int], None]:
    return lambda _: step()
