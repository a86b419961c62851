"""What sets that are no boxes, and weights that learn, cost: `make bench ARGS=--sets` leaves results/sets.md."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from scripts.bench.ball import rows as ball_rows
from scripts.bench.ratios import latencies, learning_steps, sets_beside_boxes
from scripts.shared.command import versions

PLANTS = ("masses", "quadrotor")


def write_sets(out: Path) -> str:
    """Measure everything, write sets.md, and return it. About 3 minutes on an idle core."""
    lines = [f"{versions(1, 1).split(';')[0]}; one thread; processor time.", ""]
    for table in tqdm((_latencies(), _learning(), _ball(), _sets()), desc="Sets", unit="table"):
        lines += [*table, ""]
    text = "\n".join(lines)
    out.mkdir(parents=True, exist_ok=True)
    (out / "sets.md").write_text(text)
    return text


def _sets() -> Iterator[str]:
    yield "| plant | set | batch | both [ms] | to a box, forward | to a box, both |"
    yield "|---|---|---:|---:|---:|---:|"
    for plant in PLANTS:
        for name, batch, time, forward, both in sets_beside_boxes(plant):
            yield f"| {plant} | {name} | {batch} | {time:.3g} | {forward:.2g} | {both:.2g} |"


def _latencies() -> Iterator[str]:
    yield "| 20,000 calls, masses, batch 1 | median [ms] | 99 % | 99.9 % | worst |"
    yield "|---|---:|---:|---:|---:|"
    for name, times in latencies():
        yield f"| {name} | {' | '.join(f'{time:.3g}' for time in times)} |"


def _learning() -> Iterator[str]:
    yield "| a training step, masses | [ms] |"
    yield "|---|---:|"
    for name, time in learning_steps().items():
        yield f"| {name} | {time:.3g} |"


def _ball() -> Iterator[str]:
    yield "| masses, ball on u, batch 1 | forward [ms] | both [ms] | ratio | error of u | error of the gradient |"
    yield "|---|---:|---:|---:|---:|---:|"
    ours = None
    for name, forward, both, of_u, of_gradient in ball_rows():
        ours = both if ours is None else ours
        yield f"| {name} | {forward:.3g} | {both:.3g} | {both / ours:.3g} | {of_u:.0e} | {of_gradient:.0e} |"
