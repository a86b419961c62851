"""Fuzz the layer against the independent reference: `make fuzz` (10,000 problems take about an hour on two cores).

Finished problems are kept, one a line, in results/fuzz/; a run that was interrupted goes on. The table and the list of
findings, each replayed by `tests.fuzz.run.run(stream, index)`, lie beside them; `--page` writes docs/fuzz.md.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import torch
from tqdm import tqdm

from scripts.shared.command import cores
from scripts.shared.tables import as_they_finish

from .page import page
from .run import run
from .table import failures, markdown, read

ROOT = Path(__file__).resolve().parents[2]


def one(stream: str, index: int) -> str:
    """Return the report of one case as a line of JSON."""
    torch.set_num_threads(1)
    return json.dumps(dataclasses.asdict(run(stream, index)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=10_000, help="problems of any kind (default 10000)")
    parser.add_argument("--sensible", type=int, default=None, help="sensible problems (default a quarter as many)")
    parser.add_argument("--stream", default="any", help="any, or a number: a held-out stream of the same kind")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "fuzz")
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--page", action="store_true", help="write docs/fuzz.md")
    parser.add_argument("--held-out", type=Path, help="rows of a held-out stream, made before, for the page")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    reports = []
    for stream, n in (
        (asked.stream, asked.n),
        ("sensible", asked.n // 4 if asked.sensible is None else asked.sensible),
    ):
        path = asked.out / f"{stream}.jsonl"
        done = {report["index"] for report in read(path)}
        jobs = [(stream, i) for i in range(n) if i not in done]
        with path.open("a") as file, tqdm(total=n, initial=n - len(jobs), desc=stream, unit="problem") as bar:
            if path.stat().st_size and not path.read_bytes().endswith(b"\n"):
                file.write("\n")  # what a kill cut short stays a line of its own
            for line in as_they_finish(one, jobs, asked.workers):
                file.write(line + "\n")
                file.flush()
                bar.update()
        reports += [report for report in read(path) if report["index"] < n]
    table = markdown(reports)
    (asked.out / "table.md").write_text(table)
    (asked.out / "failures.txt").write_text("\n".join(failures(reports)) + "\n")
    if asked.page:
        other = asked.held_out and (asked.held_out.stem, markdown(read(asked.held_out)))
        (ROOT / "docs" / "fuzz.md").write_text(page(table, other))
    print(table)


if __name__ == "__main__":
    main()
