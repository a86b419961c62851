"""Tables that grow row by row on disk: what a killed script has finished is not done again."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import joblib


class Table:
    """A CSV file with fixed columns to which finished rows are added.

    A line that a kill cut short is dropped when the file is opened again.
    """

    def __init__(self, path: Path, columns: Sequence[str]):
        self.path, self.columns = path, list(columns)
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        if not lines or lines[0].rstrip("\n") != ",".join(columns):
            path.write_text(",".join(columns) + "\n")
        elif not lines[-1].endswith("\n"):
            path.write_text("".join(lines[:-1]))

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Write rows at the end, in one go."""
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self.columns, lineterminator="\n")
            writer.writerows({k: f"{v:.9g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)

    def rows(self) -> list[dict[str, str]]:
        """Return all rows, as strings."""
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))


def missing(table: Table, pairs: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return the pairs of plant and seed that have no rows yet."""
    done = {(row["plant"], int(row["seed"])) for row in table.rows()}
    return [pair for pair in pairs if pair not in done]


def as_they_finish(function: Any, jobs: Sequence[tuple[Any, ...]], workers: int) -> Iterator[Any]:
    """Yield `function(*job)` of every job in the order in which they finish, one process a worker."""
    if workers <= 1 or len(jobs) <= 1:
        yield from (function(*job) for job in jobs)
        return
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=min(workers, len(jobs)), return_as="generator_unordered", batch_size=1)
        yield from parallel(joblib.delayed(function)(*job) for job in jobs)
