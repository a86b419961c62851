"""Rows on disk: one Parquet file a finished chunk, put in place by one rename, and one table at the end."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from scripts.campaigns.config import RunConfig

SCHEMA = pa.schema(
    [
        ("id", pa.string()),
        ("plant", pa.string()),
        ("weights", pa.string()),
        ("seed", pa.int64()),
        ("attack", pa.string()),
        ("rho", pa.float64()),
        ("steps", pa.int64()),
        ("replan_every", pa.int64()),
        ("lambda_g", pa.float64()),
        ("lambda_s", pa.float64()),
        ("Q", pa.list_(pa.float64())),
        ("R", pa.list_(pa.float64())),
        ("error", pa.float64()),
        ("error_second_half", pa.float64()),
        ("largest", pa.float64()),
        ("input", pa.float64()),
        ("perturbation", pa.float64()),
        ("unsolved", pa.int64()),
        ("crashed", pa.bool_()),
    ]
)


class Store:
    """The rows of a campaign in a folder.

    A part is written under another name, synchronised and renamed, so that it is there whole or not at all. Its name
    is made of the ids of its rows, so a chunk that is run twice leaves one part.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        for leftover in folder.glob("*.tmp"):  # of a kill in the middle of writing
            leftover.unlink(missing_ok=True)

    def add(self, rows: Sequence[dict[str, Any]]) -> None:
        """Save the rows of a finished chunk."""
        name = hashlib.sha256("".join(sorted(row["id"] for row in rows)).encode()).hexdigest()[:20]
        unfinished = self.folder / f"{name}.{os.getpid()}.tmp"
        pq.write_table(pa.Table.from_pylist(list(rows), schema=SCHEMA), unfinished)
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, self.folder / f"{name}.parquet")

    def parts(self) -> list[Path]:
        """Return the parts, in a fixed order."""
        return sorted(self.folder.glob("*.parquet"))

    def finished(self) -> set[str]:
        """Return the ids of the rows that are there."""
        return {i for part in self.parts() for i in pq.read_table(part, columns=["id"])["id"].to_pylist()}

    def missing(self, configs: Sequence[RunConfig]) -> list[RunConfig]:
        """Return what is still to be run."""
        finished = self.finished()
        return [config for config in configs if config.id not in finished]

    def merge(self, configs: Sequence[RunConfig], path: Path, note: str) -> pa.Table:
        """Write the rows of a campaign to one file, each once and in the order of the campaign, and return them.

        Rows that an earlier version of the configuration left in the folder stay out; the names of the weights are
        those of the present one.
        """
        rows = {row["id"]: row for part in self.parts() for row in pq.read_table(part).to_pylist()}
        ordered = [rows[config.id] | {"weights": config.weights} for config in configs if config.id in rows]
        table = pa.Table.from_pylist(ordered, schema=SCHEMA.with_metadata({"note": note}))
        unfinished = path.with_suffix(".tmp")
        pq.write_table(table, unfinished)
        os.replace(unfinished, path)
        return table
