"""The tables and the picture of benchmark.csv."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from scripts.bench.cases import LOOP, OURS, PERTURBATION
from scripts.bench.scatter import scatter

Line = dict[str, str]

HOW = f"""Times are medians in ms, with the quartiles in brackets, of calls one after the other; *forward* is a call
without a graph, *both* is forward and backward of sum(u) with a graph on y_ini, *a problem* is a time divided by the
batch. A batch of one takes 16 problems in turn. *Setup*: torch_dpc from the recorded trajectories to the first call;
a peer, what it needs on top of that. *Memory* is the peak above what the process held after its imports. *Size* is that
of the system solved to differentiate. The problems are windows of the recording with y_ini perturbed by
{PERTURBATION["masses"]:.0%} (masses) and {PERTURBATION["quadrotor"]:.1%} (quadrotor), and the references of the
figures. *Errors* are relative, of the plan (u, y) and of d sum(u) / d y_ini, the largest over up to 4 problems,
against a reference in extended precision (`scripts/bench/higher_precision.py`) whose own error is estimated at
{{reference}} or less.
"(paper)" is the QP as the paper prints it, "(reduced)" our least-distance form."""


def write_report(out: Path, lines: list[Line]) -> str:
    """Write benchmark.md and benchmark.png; return the first table."""
    shown = [line for line in lines if line["scaling"] == "False"]
    head = ["# Benchmark", "", *made_with(lines), "", _how(lines)]
    first = ["## torch_dpc against the others", "", *ratios(shown)]
    body = [*scaling([line for line in lines if line["scaling"] == "True"]), *_all(shown)]
    (out / "benchmark.md").write_text("\n".join([*head, "", *first, "", *body]) + "\n")
    chosen = of(shown, plant="masses", horizon="25", batch="1")
    drawn = [line for line in chosen if line["gradient_error"] and line["both_ms"]]
    if drawn:
        scatter(out / "benchmark.png", drawn, [_why(line) for line in chosen if _lacks_gradient(line)])
    return "\n".join(first[2:])


def _lacks_gradient(line: Line) -> bool:
    from baselines import PEERS

    known = PEERS.get(line["name"])
    return not line["gradient_error"] and known is not None and known.kind == "differentiable"


def _why(line: Line) -> str:
    return f"{line['name']}, {line['status']}"


def made_with(lines: list[Line]) -> list[str]:
    """Say with what the lines were measured."""
    told = []
    for names in (("processor", "threads", "seed", "mode"), ("versions",)):
        parts = [f"{name} {' or '.join(dict.fromkeys(line[name] for line in lines))}" for name in names]
        told.append("; ".join(parts).removeprefix("processor ").removeprefix("versions ") + ".")
    return told


def _how(lines: list[Line]) -> str:
    known = [float(line["reference_error"]) for line in lines if line["reference_error"]]
    return HOW.format(reference=f"{max(known):.0e}" if known else "an unknown amount")


def ratios(lines: list[Line]) -> list[str]:
    """The layer with its default engine, beside the loop over DAQP and the fastest differentiable peer."""
    if not of(lines, name="torch_dpc"):
        return ["(no row of torch_dpc itself)"]
    header = ["plant", "horizon", "batch", "forward", "a problem [us]", "DAQP loop", "ratio", "both", "a problem [us]"]
    header += ["gradient error", "fastest differentiable peer", "its both", "ratio", "its gradient error"]
    rows = []
    for ours in of(lines, name="torch_dpc"):
        same = of(lines, plant=ours["plant"], horizon=ours["horizon"], batch=ours["batch"])
        loop = next(iter(of(same, name=LOOP)), None)
        peers = [line for line in same if line["name"] not in OURS and line["both_ms"] and line["status"] == "ok"]
        peer = min(peers, key=lambda line: float(line["both_ms"]), default=None)
        row = [ours["plant"], ours["horizon"], ours["batch"], number(ours["forward_ms"]), each(ours, "forward_ms")]
        row += [number(loop["forward_ms"]), ratio(loop, ours, "forward_ms")] if loop else ["", ""]
        row += [number(ours["both_ms"]), each(ours, "both_ms"), number(ours["gradient_error"], ".0e")]
        row += [peer["name"], number(peer["both_ms"]), ratio(peer, ours, "both_ms")] if peer else [""] * 3
        rows.append([*row, number(peer["gradient_error"], ".0e") if peer else ""])
    lead = table(header, rows, left=("plant", "fastest differentiable peer"))
    return [*lead, "", *cvxpylayers(lines), "A ratio is theirs to ours: above 1, torch_dpc is faster."]


def cvxpylayers(lines: list[Line]) -> list[str]:
    """The layer beside the fastest configuration of cvxpylayers on the QP as printed."""
    chosen = of(lines, plant="masses", horizon="25", batch="1")
    ours = next((line for line in of(chosen, name="torch_dpc") if line["both_ms"]), None)
    theirs = [line for line in chosen if "cvxpylayers" in line["name"] and "(paper)" in line["name"]]
    theirs = [line for line in theirs if line["both_ms"] and line["status"] == "ok"]
    if ours is None or not theirs:
        return []
    best = min(theirs, key=lambda line: float(line["both_ms"]))
    return [
        "On the masses' QP as the paper prints it (horizon 25, batch 1) the fastest cvxpylayers configuration of the "
        f"{len(theirs)} that finished, {best['name']}, takes {ratio(best, ours, 'both_ms')} times as long, "
        f"with a gradient error of {number(best['gradient_error'], '.0e')}.",
        "",
    ]


def scaling(lines: list[Line]) -> list[str]:
    """The rows that let n_g grow."""
    if not lines:
        return []
    header = ["recorded windows n_g", "setup [s]", "memory [MB]", "forward", "ratio to n_g = 500", "solution error"]
    rows = []
    for line in sorted(lines, key=lambda line: int(line["n_g"])):
        setup = number(str(float(line["setup_ms"]) / 1e3)) if line["setup_ms"] else line["status"]
        row = [line["n_g"], setup, number(line["peak_mb"]), _spread(line, "forward"), number(line["ratio"], ".2f")]
        rows.append([*row, number(line["solution_error"], ".0e")])
    text = "The masses at horizon 25, batch 1; the layer on 500 windows is called turn by turn beside each."
    return ["## More recorded windows", "", *table(header, rows), "", text, ""]


def _all(lines: list[Line]) -> list[str]:
    header = ["solver", "setup", "forward", "backward", "both", "a problem [us]", "memory [MB]", "size"]
    header += ["solution error", "gradient error", "repeats", "remarks"]
    out = []
    problems = dict.fromkeys((line["plant"], int(line["horizon"]), int(line["batch"])) for line in lines)
    for plant, horizon, batch in sorted(problems):
        rows = []
        for line in of(lines, plant=plant, horizon=str(horizon), batch=str(batch)):
            time = each(line, "both_ms") or each(line, "forward_ms")
            row = [line["name"], number(line["setup_ms"])]
            row += [_spread(line, stage) for stage in ("forward", "backward", "both")]
            row += [time, number(line["peak_mb"]), line["kkt_size"]]
            row += [number(line[f"{name}_error"], ".0e") for name in ("solution", "gradient")]
            rows.append([*row, line["repeats"], remark(line)])
        out += [f"## {plant}, horizon {horizon}, batch {batch}", ""]
        out += [*table(header, rows, left=("solver", "remarks")), ""]
    return out


def remark(line: Line) -> str:
    """Return how a row ended where that was not well, and the message that came with it."""
    status = "" if line["status"] == "ok" else line["status"]
    message = line["message"].replace("|", "/").replace("\n", " ")
    message = message if len(message) <= 120 else message[:117] + "..."
    return ": ".join(part for part in (status, message) if part)


# --- cells -----------------------------------------------------------------------------------------------------------


def of(lines: Iterable[Line], **values: str) -> list[Line]:
    return [line for line in lines if all(line[name] == value for name, value in values.items())]


def number(cell: str, form: str = ".3g") -> str:
    if not cell:
        return ""
    value = float(cell)
    return f"{value:,.0f}" if form == ".3g" and value >= 1000 else f"{value:{form}}"


def _spread(line: Line, stage: str) -> str:
    if not line[f"{stage}_ms"]:
        return ""
    low, high = number(line[f"{stage}_q1"]), number(line[f"{stage}_q3"])
    return number(line[f"{stage}_ms"]) + (f" ({low} to {high})" if low != high else "")


def each(line: Line, time: str) -> str:
    return number(str(1e3 * float(line[time]) / int(line["batch"]))) if line[time] else ""


def ratio(theirs: Line, ours: Line, time: str) -> str:
    return number(str(float(theirs[time]) / float(ours[time]))) if theirs[time] and ours[time] else ""


def table(header: list[str], rows: list[list[Any]], left: tuple[str, ...] = ()) -> list[str]:
    join: Callable[[list[Any]], str] = lambda cells: "| " + " | ".join(map(str, cells)) + " |"  # noqa: E731
    return [join(header), "|" + "|".join("---" if name in left else "---:" for name in header) + "|", *map(join, rows)]
