"""Rows on disk: CSV tables with a note, tables for pgfplots, and JSON."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Rows = dict[str, Array]


def write_rows(path: Path, runs: Iterable[dict[str, Any]], note: str) -> None:
    """Write runs, dictionaries of columns, one row a time step; a scalar is repeated. The note comes first, after #."""
    with path.open("w", newline="") as file:
        file.write(f"# {note}\n")
        writer = csv.writer(file)
        for i, run in enumerate(runs):
            if i == 0:
                writer.writerow(run)
            steps = max(np.size(value) for value in run.values())
            writer.writerows(zip(*(_cells(value, steps) for value in run.values()), strict=True))


def _cells(value: Any, steps: int) -> list[str]:
    if isinstance(value, str):
        return [value] * steps
    return [f"{entry:.9g}" for entry in np.broadcast_to(np.asarray(value), (steps,))]


def read_rows(path: Path) -> Rows:
    """Return the columns of a file of `write_rows`: floats, and strings where a cell is no number."""
    with path.open(newline="") as file:
        names, *rows = csv.reader(line for line in file if not line.startswith("#"))
    return {name: _parsed(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def _parsed(column: tuple[str, ...]) -> Array:
    try:
        return np.array(column, dtype=float)
    except ValueError:
        return np.array(column)


def grid(rows: Rows, column: str, attack: str, rho: float) -> Array:
    """Return one column of the runs under one attack, `(seeds, steps)`."""
    chosen = (rows["attack"] == attack) & np.isclose(rows["rho"], rho, rtol=1e-6)
    return rows[column][chosen].reshape(len(np.unique(rows["seed"])), -1)


def write_pgf(path: Path, t: Array, columns: Sequence[Array]) -> None:
    """Write a table as the paper's plots read it: `iter rho1 rho2 ...`, separated by spaces; `iter` is the time [s]."""
    header = " ".join(["iter", *(f"rho{i + 1}" for i in range(len(columns)))])
    np.savetxt(path, np.column_stack([t, *columns]), fmt="%.6g", header=header, comments="")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write what `report.py` reads."""
    path.write_text(json.dumps(content, indent=1) + "\n")
