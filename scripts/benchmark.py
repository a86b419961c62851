"""Benchmark: time and error of torch_dpc beside other solvers and differentiable QP layers.

    python -m scripts.benchmark             # about 40 minutes on two cores
    python -m scripts.benchmark --quick     # under 2 minutes: the masses at horizon 25, the fastest peers
    python -m scripts.benchmark --scaling   # the number of recorded windows, 500 to 50,000, alone
    python -m scripts.benchmark --check     # the regression guard: ratios within one process, half a minute
    python -m scripts.benchmark --sets      # balls, cones, soft boxes and learnable weights, 3 minutes
    python -m scripts.benchmark --docs      # everything, then Table I and the profile, all into docs/benchmarks.md

Both plants of the paper, horizons 25 to 100, batches 1 to 1024; every peer in `baselines/` on the QP as the paper
prints it and on our reduced form. Each row is measured in a process of its own, so a peer that crashes, hangs or eats
memory touches nothing else, and is saved at once: a run that is stopped goes on where it was, and rows measured before
with the same versions and sources are not measured again (`--fresh` starts over). Errors are against
`bench/higher_precision.py`.
Leaves, in results/:

    benchmark.csv       one line a row: times with quartiles, memory, errors, versions
    benchmark.md        the same as tables
    benchmark.png       time against gradient error
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from scripts.bench.cases import LOOP, OURS, SEED, Row, full_rows, quick_rows, scaling_rows, write_case
from scripts.bench.check import check
from scripts.bench.docs import refresh
from scripts.bench.report import write_report
from scripts.bench.row import MARK, measure
from scripts.bench.sets import write_sets
from scripts.shared.command import RESULTS, ROOT, cores
from torch_dpc.solve.kernels import instructions

PROGRAM = ["-m", "scripts.benchmark"]  # what measures one row, given `--row`
MEASURED_BY = (
    "bench/row",
    "bench/timing",
    "bench/cases",
    "bench/daqp_loop",
    "bench/higher_precision",
    "experiments/masses",
    "experiments/quadrotor",
)
TIME_LIMIT = {"full": 60.0, "quick": 20.0}  # [s] a row, imports included

SOURCES = (".py", ".c", ".h")
KEYS = ("name", "plant", "horizon", "n_g", "batch", "scaling")
TIMES = [f"{stage}_{part}" for stage in ("forward", "both", "backward") for part in ("ms", "q1", "q3")]
MEASURED = ["status", "setup_ms", "first_ms", *TIMES, "repeats", "ratio", "peak_mb", "kkt_size"]
MEASURED += ["solution_error", "gradient_error", "checked", "reference_error", "message"]
FIELDS = [*KEYS, *MEASURED, "mode", "threads", "seed", "processor", "sources", "versions"]
PACKAGES = "torch numpy daqp cvxpylayers diffcp moreau qpth proxsuite clarabel ecos osqp piqp scs".split()

Line = dict[str, Any]


def run(rows: Iterable[Row], out: Path, mode: str, threads: int, fresh: bool = False, inputs: int = 1024) -> list[Line]:
    """Measure the rows that are not there yet; return all that the file holds for these rows, in their order.

    Args:
        rows: what to measure, small batches before large ones.
        out: the folder of benchmark.csv.
        mode: "full" or "quick": the time spent on a row, and its limit.
        threads: of every solver.
        fresh: forget what was measured before.
        inputs: problems to prepare for each plant and horizon.
    """
    out.mkdir(parents=True, exist_ok=True)
    path, rows = out / "benchmark.csv", list(dict.fromkeys(rows))
    lines = {} if fresh else {_key(line): line for line in read_lines(path)}
    stamps = {row: _stamp(row, mode, threads) for row in rows}
    todo = [row for row in rows if not _is_done(lines.get(_key(_strings(asdict(row)))), stamps[row])]
    _rewrite(path, lines.values())
    if len(todo) < len(rows):
        print(f"{len(rows) - len(todo)} rows were measured before (--fresh measures them again)", file=sys.stderr)
    with tempfile.TemporaryDirectory() as folder, tqdm(todo, desc="Benchmark", unit="row", disable=not todo) as bar:
        for row in bar:
            bar.set_postfix_str(f"{row.name}, {row.plant} {row.horizon}, batch {row.batch}")
            line = {**asdict(row), **stamps[row], **_one(row, Path(folder), mode, threads, lines, inputs)}
            lines[_key(_strings(line))] = _strings(line)
            with path.open("a", newline="") as file:
                csv.DictWriter(file, FIELDS, restval="").writerow(line)
    return [lines[_key(_strings(asdict(row)))] for row in rows]


def _one(row: Row, folder: Path, mode: str, threads: int, lines: dict[Any, Line], inputs: int) -> Line:
    """Return what was measured of one row, or why nothing was."""
    for batch in (1, 64):
        before = lines.get(_key(_strings({**asdict(row), "batch": batch})))
        if batch < row.batch and before is not None and before["status"] != "ok":
            return {"status": "not run", "message": f"{before['status']} at batch {before['batch']}"}
    case = folder / ("_".join(map(str, row.problem)) + ".npz")
    if not case.exists():
        try:
            write_case(case, *row.problem, count=inputs)
        except Exception as error:  # no PyBullet, say
            return {"status": "no problem", "message": f"{type(error).__name__}: {error}"}
    order = {**asdict(row), "case": str(case), "mode": mode, "threads": threads}
    return in_a_process(order, TIME_LIMIT[mode]) | {"reference_error": _reference_error(case)}


def in_a_process(order: Line, limit: float) -> Line:
    """Run `--row` in a process of its own; return the last thing it told, and how it ended if that was not well."""
    command = [sys.executable, *PROGRAM, "--row", json.dumps(order)]
    pools = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(pools, str(order["threads"]))}
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as complained:
        process = subprocess.Popen(
            command,
            stdout=said,
            stderr=complained,
            stdin=subprocess.DEVNULL,
            cwd=ROOT,
            env=environment,
            start_new_session=True,
        )
        ended, why = "", ""
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            ended, why = "time limit", f"stopped after {limit:g} s"
        finally:
            if process.poll() is None:  # at the limit, or when the run is interrupted: leave nothing behind
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        said.seek(0)
        complained.seek(0)
        told = [json.loads(line[len(MARK) :]) for line in said if line.startswith(MARK)]
        if not ended and code != 0:
            ended = "crashed"
            name = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            why = " ".join([name, *complained.read().strip().splitlines()[-1:]])
    result = told[-1] if told else {}
    return {**result, "status": ended, "message": why} if ended else result


# --- what is there already -------------------------------------------------------------------------------------------


def read_lines(path: Path) -> list[Line]:
    """Return the latest line of each row as strings; none where the file is not there or has other columns."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames != FIELDS:
            return []
        return list({_key(line): line for line in reader if None not in line.values()}.values())


def _rewrite(path: Path, lines: Iterable[Line]) -> None:
    """Write the file anew."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(lines)


def _strings(line: Line) -> Line:
    return {name: "" if value is None else str(value) for name, value in {**dict.fromkeys(FIELDS), **line}.items()}


def _key(line: Line) -> tuple[str, ...]:
    return tuple(line[name] for name in KEYS)


def _is_done(line: Line | None, stamp: Line) -> bool:
    """A line counts if what it was made with is the same; a full one counts for a quick run too."""
    if line is None or line["status"] in ("not run", "no problem"):
        return False
    same = all(line[name] == str(stamp[name]) for name in stamp if name != "mode")
    return same and line["mode"] in (stamp["mode"], "full")


def _stamp(row: Row, mode: str, threads: int) -> Line:
    """Return what a row is made with: the packages, and the sources that its numbers depend on."""
    folders = {"ours": ["torch_dpc"], "loop": [], "peers": ["baselines"]}
    made_of = folders["ours" if row.name in OURS else "loop" if row.name == LOOP else "peers"]
    files = [path for folder in made_of for path in sorted((ROOT / folder).rglob("*")) if path.suffix in SOURCES]
    files += [ROOT / "scripts" / f"{name}.py" for name in MEASURED_BY]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:8]
    return {
        "mode": mode,
        "threads": threads,
        "seed": SEED,
        "processor": processor(),
        "sources": digest,
        "versions": versions(),
    }


def versions() -> str:
    """Return the versions of Python and of every package that a row may use."""
    found = [f"Python {platform.python_version()}", f"torch_dpc {version('torch_dpc')}"]
    found.append(f"kernels {instructions()}")
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)


def processor() -> str:
    """Return the processor's name and the cores that may be used."""
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        models = [line.split(":")[1].strip() for line in Path("/proc/cpuinfo").open() if line.startswith("model name")]
        name = models[0] if models else name
    return f"{name}, {cores()} cores"


def _reference_error(case: Path) -> float | str:
    import numpy as np

    with np.load(case) as file:
        return float(file["error"].max()) if file["error"].size else ""


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the masses at horizon 25 and the fastest peers alone")
    parser.add_argument("--scaling", action="store_true", help="only the rows that let n_g grow")
    parser.add_argument("--docs", action="store_true", help="refresh every table and picture of docs/benchmarks.md")
    parser.add_argument("--check", action="store_true", help="only compare ratios of times with stored ones")
    parser.add_argument("--sets", action="store_true", help="only sets that are no boxes, and learnable weights")
    parser.add_argument("--only", default="", help="only the rows whose name contains this")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    parser.add_argument("--threads", type=int, default=cores(), help="of every solver (default: one a core)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default results/)")
    parser.add_argument("--row", type=json.loads, help="measure one row in this process; what the others call")
    args = parser.parse_args(argv)
    if args.row:
        order = dict(args.row)
        case, mode, threads = (order.pop(name) for name in ("case", "mode", "threads"))
        return measure(Row(**order), Path(case), mode, threads)

    if args.check or args.sets:
        torch.set_num_threads(1)
    if args.check:
        grown = check()
        sys.exit(f"slower than stored: {', '.join(grown)}" if grown else 0)
    if args.sets:
        print(write_sets(args.out))
        return

    from baselines import PEERS

    rows = scaling_rows() if args.scaling else quick_rows() if args.quick else full_rows(PEERS)
    mode = "quick" if args.quick else "full"
    run((row for row in rows if args.only in row.name), args.out, mode, args.threads, args.fresh)
    lines = read_lines(args.out / "benchmark.csv")
    print(write_report(args.out, lines))
    if args.docs:
        for script, threads in (("table1_sizes", []), ("profile_layer", ["--threads", str(args.threads)])):
            command = [sys.executable, "-m", f"scripts.{script}", "--out", str(args.out), *threads]
            subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        refresh(ROOT / "docs" / "benchmarks.md", args.out, lines)


if __name__ == "__main__":
    main()
