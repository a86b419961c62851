"""The measured parts of docs/benchmarks.md, between marks that name them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from scripts.bench.cases import FASTEST, LOOP
from scripts.bench.report import Line, cvxpylayers, each, made_with, number, of, ratio, ratios, remark, scaling, table

END = "<!-- end -->"
NAMES = {LOOP: "DAQP in a Python loop, forward only, set up once"}


def refresh(page: Path, results: Path, lines: list[Line]) -> None:
    """Write the lines of benchmark.csv, Table I and the profile into the page, and the picture beside it.

    Raises:
        ValueError: the page lacks a mark, or something else is marked.
    """
    text, blocks = page.read_text(), _blocks(results, lines)
    marked = re.findall(r"<!-- measured: (.*?) -->", text)
    if sorted(marked) != sorted(blocks):
        raise ValueError(f"{page} must mark {', '.join(sorted(blocks))}, got {', '.join(sorted(marked))}.")
    for name, block in blocks.items():
        head, old = text.split(f"<!-- measured: {name} -->", 1)
        text = f"{head}<!-- measured: {name} -->\n{block.strip()}\n{END}{old.split(END, 1)[1]}"
    page.write_text(text)
    shutil.copy(results / "benchmark.png", page.parent / "images" / "benchmark.png")


def _blocks(results: Path, lines: list[Line]) -> dict[str, str]:
    shown = [line for line in lines if line["scaling"] == "False"]
    sizes = (results / "table1_sizes.md").read_text().splitlines()[2:]
    profile = (results / "profile.md").read_text().replace("\n## ", "\n### ").splitlines()[2:]
    blocks = {
        "sizes": sizes,
        "time and error": [*made_with(lines), "", *_chosen(shown), "", *cvxpylayers(shown), *_against(shown)],
        "every configuration": _configurations(shown),
        "both plants": ratios(shown),
        "scaling": scaling([line for line in lines if line["scaling"] == "True"])[2:],
        "profile": profile,
    }
    return {name: "\n".join(block) for name, block in blocks.items()}


def _chosen(lines: list[Line]) -> list[str]:
    """The masses at horizon 25: the layer, the fastest peers and the loop at every batch."""
    header = ["solver", "batch", "forward [ms]", "both [ms]", "a problem [us]", "memory [MB]", "solution error"]
    rows = []
    for name in ("torch_dpc", *FASTEST, LOOP):
        for line in of(lines, plant="masses", horizon="25", name=name):
            row = [NAMES.get(name, name), line["batch"], number(line["forward_ms"]), number(line["both_ms"])]
            row += [each(line, "both_ms") or each(line, "forward_ms"), number(line["peak_mb"])]
            row += [number(line[f"{kind}_error"], ".0e") for kind in ("solution", "gradient")]
            rows.append([*row, remark(line)])
    return table([*header, "gradient error", "remarks"], rows, left=("solver", "remarks"))


def _against(lines: list[Line]) -> list[str]:
    """How many times as long the best differentiable peer and the loop take."""
    told = []
    for ours in of(lines, name="torch_dpc", plant="masses", horizon="25"):
        same = of(lines, plant="masses", horizon="25", batch=ours["batch"])
        peers = [line for line in same if line["name"] in FASTEST and line["both_ms"] and line["status"] == "ok"]
        peer = min(peers, key=lambda line: float(line["both_ms"]), default=None)
        if peer is not None:
            times = ratio(peer, ours, "both_ms")
            best = f"the best differentiable peer, {peer['name']}"
            told.append(f"at batch {ours['batch']} {best}, takes {times} times as long")
        for loop in of(same, name=LOOP):
            times = ratio(loop, ours, "forward_ms")
            told.append(f"at batch {ours['batch']} the loop over DAQP takes {times} times as long forward")
    return [f"Given our reduced problem: {'; '.join(told)}."] if told else []


def _configurations(lines: list[Line]) -> list[str]:
    """Every configuration on the masses at horizon 25, batch 1, the fastest first."""
    header = ["solver", *(f"{stage} [ms]" for stage in ("setup", "forward", "both")), "size"]
    header += ["solution error", "gradient error", "remarks"]
    chosen = of(lines, plant="masses", horizon="25", batch="1")
    rows = []
    for line in sorted(chosen, key=lambda line: float(line["both_ms"] or line["forward_ms"] or "inf")):
        row = [line["name"], *(number(line[f"{stage}_ms"]) for stage in ("setup", "forward", "both"))]
        errors = (number(line[f"{kind}_error"], ".0e") for kind in ("solution", "gradient"))
        rows.append([*row, line["kkt_size"], *errors, remark(line)])
    return table(header, rows, left=("solver", "remarks"))
