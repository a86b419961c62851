"""Study: how much damage few poisoned samples of the recording do, on both plants; beyond the paper.

    python -m scripts.study_poisoned_data               # about 20 minutes on two cores
    python -m scripts.study_poisoned_data --quick       # about 2 minutes: one seed, two counts

k of 530 recorded samples are changed by at most a tenth of each output's standard deviation, so that the plans made
with the recording truly track worse (`attacks.PoisonedRecording` with `TrackingError`). The samples are random, or
chosen by influence, or greedily; beside them stands noise of the same size. The controller is then judged on windows
that the attacker has not seen, and in closed loop with true measurements; and once more with the ridge of
study_noise.py on the poisoned data, of which the attacker does not know. Rows are saved as they are made; a run that
is stopped goes on where it was (`--fresh` begins anew; `--quick` has files of its own). Leaves, in results/:

    study_poisoned_data.csv         one row for each recording, way to poison it and k
    study_poisoned_data.md, .png    tables and picture
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from scripts.defence.poison import CASES, COUNTS, NOISES, measure
from scripts.defence.poison_report import draw, report
from scripts.shared.command import arguments, versions
from scripts.shared.tables import Table, as_they_finish

QUICK_COUNTS = (5, 100)
ROW = ("plant", "noise", "seed", "method", "count", "seen", "held_out", "error", "unsolved")


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=5)
    parser.add_argument("--plants", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--quick", action="store_true", help="one seed, two counts")
    parser.add_argument("--fresh", action="store_true", help="forget what was run before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, began = range(1 if args.quick else args.seeds), time.perf_counter()
    counts, stem = (QUICK_COUNTS, "study_poisoned_data_quick") if args.quick else (COUNTS, "study_poisoned_data")
    if args.fresh:
        (out / f"{stem}.csv").unlink(missing_ok=True)
    table = Table(out / f"{stem}.csv", ROW)
    done = {(row["plant"], float(row["noise"]), int(row["seed"])) for row in table.rows()}
    jobs: list[tuple[Any, ...]] = [
        (plant, noise, seed, counts)
        for seed in seeds
        for plant in args.plants
        for noise in NOISES
        if (plant, noise, seed) not in done
    ]
    for rows in tqdm(as_they_finish(measure, jobs, args.workers), total=len(jobs), desc="Poisoned", unit="recording"):
        table.add(rows)
    lines = report(table.rows())
    note = versions(len(seeds), args.workers)
    (out / f"{stem}.md").write_text("\n".join([*lines[:1], "", f"{note}.", *lines[1:]]) + "\n")
    draw(out / f"{stem}.png", table.rows())
    print(f"Poisoned data: {out / f'{stem}.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
