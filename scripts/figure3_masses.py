"""Figure 3: tracking error of the oscillating masses under Algorithm 1 and under random noise.

    python -m scripts.figure3_masses        # about 15 s on two cores

Ten seeds, each with its own data and its own noise, in the setting of `scripts/experiments/masses.py`. Two masses are
held at 1 m by the input (1, 1), which lies on its bound; every run starts there, so the error is the attacker's work
alone. Leaves, in results/:

    figure3_masses.csv      every run: inputs, outputs and the error of the first mass, |y1 - 1 m|, at every step
    figure3_masses.png      median over the seeds and the band between the 10th and the 90th percentile
    mass_poi.csv, mass_rand.csv     the medians, for pgfplots
    figure3_masses.json     the numbers, for report.py
"""

from __future__ import annotations

import time
from pathlib import Path

from scripts.experiments.case import run_seed
from scripts.experiments.masses import Masses
from scripts.shared.command import arguments, run_all, versions
from scripts.shared.plots import error_panels
from scripts.shared.rows import grid, read_rows, write_json, write_pgf, write_rows
from scripts.shared.statistics import NOMINAL, POISON, RANDOM, band, summarise

CASE = Masses()
SETTLED = 5.0  # [s]: the first swing is over


def main(argv: list[str] | None = None) -> None:
    args = arguments(__doc__).parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    began, note = time.perf_counter(), versions(args.seeds, args.workers)

    runs = run_all(run_seed, [(CASE, seed) for seed in range(args.seeds)], args.workers, "Figure 3")
    write_rows(out / "figure3_masses.csv", (run for seed in runs for run in seed), note)

    rows = read_rows(out / "figure3_masses.csv")
    t = grid(rows, "t", NOMINAL, 0.0)[0]
    for attack, name in ((POISON, "mass_poi.csv"), (RANDOM, "mass_rand.csv")):
        write_pgf(out / name, t, [band(grid(rows, "error", attack, rho))[0] for rho in CASE.rhos])
    error_panels(out / "figure3_masses.png", rows, CASE.rhos, "error of the first mass [m]")

    settled = t >= SETTLED
    means = {a: [grid(rows, "error", a, rho)[:, settled].mean() for rho in CASE.rhos] for a in (RANDOM, POISON)}
    result = {
        "versions": note,
        "seconds": time.perf_counter() - began,
        "largest": float(rows["error"].max()),
        "unsolved": int(rows["unsolved"][:: CASE.replan_every].sum()),
        "settled_from": SETTLED,
        "settled": {attack: [float(mean) for mean in values] for attack, values in means.items()},
        **summarise(rows, CASE.rhos),
    }
    write_json(out / "figure3_masses.json", result)
    for level in result["levels"]:
        print(
            f"rho {level['rho']:.0%}: mean error {level['random']['mean']:.4f} m under random noise, "
            f"{level['poison']['mean']:.4f} m under Algorithm 1 ({level['ratio']:.1f} times)"
        )
    print(f"Figure 3: {out / 'figure3_masses.png'}, {result['seconds']:.0f} s")


if __name__ == "__main__":
    main()
