"""Read recordings from CSV files: named columns, with errors that say which line is wrong."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

Source = str | os.PathLike[str]


def read_csv(
    path: Source, inputs: Sequence[str], outputs: Sequence[str], *, delimiter: str = ","
) -> tuple[Tensor, Tensor]:
    """Return the inputs `(T, n_u)` and outputs `(T, n_y)` of one file, float64.

    Args:
        path: of the file; its first line names the columns, and each further line is one sample.
        inputs, outputs: names of columns.
        delimiter: between columns.

    Raises:
        ValueError: a column that is missing or named twice, a line with too few or too many entries, an entry that is
            no finite number, or no samples.
        OSError: the file cannot be read.
    """
    names = [*_names("inputs", inputs), *_names("outputs", outputs)]
    with Path(path).open(newline="", encoding="utf-8-sig") as file:  # a byte order mark is no part of a name
        lines = csv.reader(file, delimiter=delimiter)
        header = [name.strip() for name in next(lines, [])]
        places = [_place(name, header, path) for name in names]
        samples = list(_samples(lines, header, places, path))
    if not samples:
        raise ValueError(f"{path} must hold one sample a line under its header, got none.")
    table = torch.tensor(samples, dtype=torch.float64)
    return table[:, : len(inputs)].contiguous(), table[:, len(inputs) :].contiguous()


def _names(argument: str, names: Sequence[str]) -> list[str]:
    if isinstance(names, str) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"`{argument}` must be a list of column names, got {names!r}.")
    return list(names)


def _place(name: str, header: list[str], path: Source) -> int:
    if header.count(name) != 1:
        count = "no column" if name not in header else f"{header.count(name)} columns"
        named = ", ".join(map(repr, header)) or "none"
        raise ValueError(f"{path} has {count} named {name!r}; its header names {named}.")
    return header.index(name)


def _samples(lines: Iterator[list[str]], header: list[str], places: list[int], path: Source) -> Iterator[list[float]]:
    for number, entries in enumerate(lines, start=2):
        if not entries:  # an empty line, usually the last
            continue
        if len(entries) != len(header):
            raise ValueError(
                f"{path}, line {number}: must have {len(header)} entries like the header, got {len(entries)}."
            )
        yield [_number(entries[place], header[place], number, path) for place in places]


def _number(entry: str, name: str, line: int, path: Source) -> float:
    try:
        value = float(entry)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"{path}, line {line}, column {name!r}: must be a finite number, got {entry!r}. Cut the recording there "
            "and give the pieces as a list of files: windows do not run across a seam."
        )
    return value
