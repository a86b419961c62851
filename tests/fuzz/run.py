"""Solve one case with the layer and let the reference judge it."""

import time
import traceback
import warnings
from dataclasses import dataclass, field
from typing import Any

import torch

import torch_dpc as dpc
from tests.oracles.judge import Finding, check_failure, check_plan, reference
from tests.oracles.reduction import rows_of

from .posed import problem_of
from .problems import Case, Spec, make


@dataclass
class Report:
    """What became of a case."""

    stream: str
    index: int
    samples: list[dict[str, Any]] = field(default_factory=list)  # verdict and figures of each
    error: str = ""  # a raw exception
    seconds: float = 0.0  # processor time of the first call
    traits: dict[str, Any] = field(default_factory=dict)


def layer_of(case: Case, **options: Any) -> dpc.DPCLayer:
    """Return the layer of a case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dpc.ExcitationWarning)
        us, ys = ([torch.as_tensor(x) for x in part] for part in zip(*case.recordings, strict=True))
        data = dpc.HankelData.from_trajectories(us, ys, t_ini=case.t_ini, horizon=case.horizon)
        sets = {name: set_of(spec) for name, spec in case.sets.items()}
        weights = {k: torch.as_tensor(v) if hasattr(v, "shape") else v for k, v in case.weights.items()}
        return dpc.DPCLayer(data, **weights, **sets, **{"on_failure": "nan", **options})


def set_of(spec: Spec) -> dpc.ConvexSet:
    """Return the package's set of a specification."""
    kind, rest = spec[0], [torch.as_tensor(x) if hasattr(x, "shape") else x for x in spec[1:]]
    if kind == "product":
        return dpc.Product([(set_of(part), channels) for part, channels in spec[1]])
    if kind in ("box", "soft", "nonnegative"):
        return {"box": dpc.Box, "soft": dpc.SoftBox, "nonnegative": dpc.NonNegative}[kind](*rest)
    if kind == "ball":
        return dpc.Ball(rest[0], rest[1], per=rest[2])
    return dpc.SecondOrderCone(per=rest[0])


def call(layer: dpc.DPCLayer, case: Case) -> dpc.DPCSolution:
    """Plan for all samples of a case in one call."""
    stack = {name: torch.stack([torch.as_tensor(getattr(s, name)) for s in case.samples])
             for name in ("u_ini", "y_ini", "u_ref", "y_ref")}  # fmt: skip
    return layer(stack.pop("u_ini"), stack.pop("y_ini"), **stack)


def run(stream: str, index: int) -> Report:
    """Return the report of one case; an exception is part of it."""
    case = make(stream, index)
    report = Report(stream, index, traits=case.traits)
    start = time.process_time()
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            layer = layer_of(case)
            plan = call(layer, case)
            g = plan.g
    except Exception as error:  # noqa: BLE001  (any exception is a finding)
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = next(
            (f for f in reversed(traceback.extract_tb(error.__traceback__)) if "torch_dpc" in f.filename), frame
        )
        report.error = f"{type(error).__name__} at {where.filename.split('/')[-1]}:{where.lineno}: {str(error)[:120]}"
        return report
    report.seconds = time.process_time() - start
    problem = problem_of(case)
    rows = rows_of(problem)
    for i, sample in enumerate(case.samples):
        ref = reference(problem, rows, sample)
        status = int(plan.info.status[i])
        if status == dpc.Status.SOLVED:
            u, y, one = (x[i].numpy() for x in (plan.u, plan.y, g))
            finding = check_plan(problem, rows, sample, ref, u, y, one)
        else:
            finding = check_failure(rows, ref, infeasible=status == dpc.Status.INFEASIBLE)
        report.samples.append(_figures(finding, plan, i, ref))
    return report


def _figures(finding: Finding, plan: dpc.DPCSolution, i: int, ref: Any) -> dict[str, Any]:
    gap = float(ref.optimum.value - ref.optimum.bound) if ref.optimum else None
    return {
        "verdict": finding.verdict.value, "equality": finding.equality, "outside": finding.outside,
        "excess": finding.excess, "cost": finding.cost, "optimum": finding.optimum, "note": finding.note,
        "status": int(plan.info.status[i]), "residual": float(plan.info.residual[i]),
        "selection": bool(plan.info.is_selection), "answer": ref.answer.value, "gap": gap, "least": ref.violation,
    }  # fmt: skip
