"""Study: who is seen: detection against false alarms, and damage against alarms, on both plants; beyond the paper.

    python -m scripts.study_detection               # about 30 minutes on two cores
    python -m scripts.study_detection --quick       # about 3 minutes: one seed, fewer clean runs

Recordings and runs without noise and with sensor noise of 1e-3 and 1e-2 of each output's standard deviation; every run
starts at a random place. A `ConsistencyDetector` of the controller's own recording is calibrated on clean runs at
stated rates of false alarms. It then watches fresh clean runs, random noise, Algorithm 1, and Algorithm 1 limited to
what the detector passes (`attacks.StealthyBudget`), at the paper's rhos. Rows are saved as they are made; a run that is
stopped goes on where it was (`--fresh` begins anew; `--quick` has files of its own). Leaves, in results/:

    study_detection.csv             one row a closed-loop run and stated rate
    study_detection_roc.csv         detection at a grid of false alarms
    study_detection_rates.csv       false alarms on fresh clean runs
    study_detection.md              tables
    study_detection_roc.png         false alarms against detection
    study_detection_damage.png      closed-loop error against alarms
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from scripts.defence.detection import CASES, CLEAN_RUNS, NOISES, QUICK_RUNS, measure
from scripts.defence.detection_report import draw_damage, draw_roc, report
from scripts.shared.command import arguments, versions
from scripts.shared.tables import Table, as_they_finish

LOOP = ("plant", "noise", "seed", "attack", "rho", "rate", "error", "plans", "alarms", "raised")
ROC = ("plant", "noise", "seed", "attack", "rho", "false_alarms", "detected")
RATE = ("plant", "noise", "seed", "rate", "windows", "alarms")


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=5)
    parser.add_argument("--plants", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--quick", action="store_true", help="one seed, fewer clean runs")
    parser.add_argument("--fresh", action="store_true", help="forget what was run before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, began = range(1 if args.quick else args.seeds), time.perf_counter()
    runs, stem = (QUICK_RUNS, "study_detection_quick") if args.quick else (CLEAN_RUNS, "study_detection")
    if args.fresh:
        for path in out.glob(f"{stem}*.csv"):
            path.unlink()
    loops, roc = Table(out / f"{stem}.csv", LOOP), Table(out / f"{stem}_roc.csv", ROC)
    rates = Table(out / f"{stem}_rates.csv", RATE)
    done = {(row["plant"], float(row["noise"]), int(row["seed"])) for row in rates.rows()}  # written last
    jobs: list[tuple[Any, ...]] = [
        (plant, noise, seed, runs[plant])
        for seed in seeds
        for plant in args.plants
        for noise in NOISES
        if (plant, noise, seed) not in done
    ]
    for found in tqdm(as_they_finish(measure, jobs, args.workers), total=len(jobs), desc="Detection", unit="setting"):
        loops.add(found["loops"])
        roc.add(found["roc"])
        rates.add(found["rates"])
    lines = report(loops.rows(), roc.rows(), rates.rows(), len(seeds))
    note = versions(len(seeds), args.workers)
    (out / f"{stem}.md").write_text("\n".join([*lines[:1], "", f"{note}.", *lines[1:]]) + "\n")
    draw_roc(out / f"{stem}_roc.png", roc.rows())
    draw_damage(out / f"{stem}_damage.png", loops.rows())
    print(f"Detection: {out / f'{stem}.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
