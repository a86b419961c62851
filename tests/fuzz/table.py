"""The counted table of a fuzz: rows of verdicts, columns of units."""

import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

COLUMNS = {"sensible": "sensible", "none": "one unit system", "one for all": "one odd unit for all",
           "per channel": "odd units per channel"}  # fmt: skip
SLOW = 2.0  # seconds of processor time for a problem: its layer, its call, its g


def read(path: Path) -> list[dict[str, Any]]:
    """Return the reports of a file, one a line; a line that a kill cut short is left out."""
    if not path.exists():
        return []
    reports = []
    for line in path.read_text().splitlines():
        try:
            reports.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return reports


def column(report: dict[str, Any]) -> str:
    return COLUMNS["sensible" if report["stream"] == "sensible" else report["traits"]["units"]]


def counts(reports: Iterable[dict[str, Any]]) -> dict[str, Counter[str]]:
    """Return what was counted in each column."""
    table: dict[str, Counter[str]] = {name: Counter() for name in COLUMNS.values()}
    for report in reports:
        count = table[column(report)]
        count["problems"] += 1
        count["raw exceptions (problems)"] += bool(report["error"])
        count[f"above {SLOW:g} s (problems)"] += report["seconds"] > SLOW
        for sample in report["samples"]:
            count["samples"] += 1
            verdict = sample["verdict"]
            if verdict.startswith("wrong"):
                verdict = "SOLVED and wrong, marked as a selection" if sample["selection"] else "SOLVED and wrong"
            count[verdict] += 1
    return table


ROWS = ["problems", "samples", "right", "marked, no plan exists", "SOLVED and wrong",
        "SOLVED and wrong, marked as a selection", "FAILED though feasible", "INFEASIBLE though feasible",
        "raw exceptions (problems)", f"above {SLOW:g} s (problems)", "undecided"]  # fmt: skip


def markdown(reports: list[dict[str, Any]]) -> str:
    """Return the table; a share is given where it is not nothing."""
    table = counts(reports)
    names = [name for name in COLUMNS.values() if table[name]["problems"]]
    lines = ["| | " + " | ".join(names) + " | all |", "|---|" + "---:|" * (len(names) + 1)]
    total: Counter[str] = sum((table[name] for name in names), Counter())
    for row in ROWS:
        cells = []
        for count in [*(table[name] for name in names), total]:
            share = 100 * count[row] / max(count["samples"], 1)
            failure = count[row] and ("wrong" in row or "though" in row)
            cells.append(f"{count[row]}" + (f" ({share:.2g} %)" if failure else ""))
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def failures(reports: Iterable[dict[str, Any]]) -> list[str]:
    """Return a line for each finding, enough to replay it: `run(stream, index)`."""
    lines = []
    for r in reports:
        if r["error"]:
            lines.append(f"{r['stream']} {r['index']}: {r['error']}")
        if r["seconds"] > SLOW:
            lines.append(f"{r['stream']} {r['index']}: {r['seconds']:.1f} s")
        for i, s in enumerate(r["samples"]):
            if s["verdict"] not in ("right", "marked, no plan exists"):
                lines.append(
                    f"{r['stream']} {r['index']}/{i}: {s['verdict']}{' (selection)' if s['selection'] else ''}; "
                    f"rows {s['equality']:.0e}, sets {s['outside']:.0e}, cost {s['cost']:.4g}, "
                    f"optimum {s['optimum']:.4g}, residual {s['residual']:.0e}; {r['traits']}; {s['note']}"
                )
    return lines
