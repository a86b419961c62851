"""Rows on disk: one Parquet file with a checksum for each finished chunk, and one table at the end."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from scripts.campaigns.config import RunConfig
from torch_dpc.files import write_whole

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

    A part is there whole or not at all. Its name is made of the ids of its rows and of a checksum of its content. A
    part whose content does not match its checksum is set aside with a warning, under the ending `.damaged`, and its
    rows are run again.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        for leftover in folder.glob("*.tmp"):  # of a kill in the middle of writing
            leftover.unlink(missing_ok=True)

    def add(self, rows: Sequence[dict[str, Any]]) -> None:
        """Save the rows of a finished chunk."""
        name = _digest("".join(sorted(row["id"] for row in rows)).encode())
        content = _as_bytes(pa.Table.from_pylist(list(rows), schema=SCHEMA))
        write_whole(self.folder / f"{name}-{_digest(content)}.parquet", content)

    def parts(self) -> list[Path]:
        """Return the parts that are whole, in a fixed order; damaged ones are set aside."""
        return [part for part in sorted(self.folder.glob("*.parquet")) if self._is_whole(part)]

    def _is_whole(self, part: Path) -> bool:
        if part.stem.rpartition("-")[2] == _digest(part.read_bytes()):
            return True
        aside = part.with_suffix(".damaged")
        os.replace(part, aside)
        logging.getLogger(__name__).warning("%s is damaged: set aside as %s, its rows run again", part, aside.name)
        return False

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
        write_whole(path, _as_bytes(table))
        return table


def _as_bytes(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return sink.getvalue().to_pybytes()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:20]
