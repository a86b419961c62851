"""Figure 4: position error of a PyBullet quadrotor under Algorithm 1 and under random noise.

    python -m scripts.figure4_quadrotor     # about 1 minute on two cores (--no-gif: 20 s less)

Ten seeds, each with its own recorded flight and its own noise, in the setting of `scripts/experiments/quadrotor.py`.
The vehicle starts at rest on the circle, 6 steps before the reference begins to move. A vehicle that crashes counts as
lying where it crashed; a plan without a solution is replaced by the rest of the one before. Both are counted. Leaves,
in results/:

    figure4_quadrotor.csv   every flight: position, attitude, commands and position error at every step
    figure4_quadrotor.png   median over the seeds and the band between the 10th and the 90th percentile
    figure4_paths.png       the flown paths from above, and figure4_flight.gif, two of them filmed (shared/film.py)
    quad_poi.csv, quad_rand.csv     the medians, for pgfplots
    figure4_quadrotor.json  the numbers, for report.py
"""

from __future__ import annotations

import time
from pathlib import Path

from scripts.experiments.case import run_seed
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared.command import arguments, run_all, versions
from scripts.shared.film import film
from scripts.shared.plots import NAMES, crash_steps, error_panels, paths_from_above, percent
from scripts.shared.rows import grid, read_rows, write_json, write_pgf, write_rows
from scripts.shared.statistics import NOMINAL, POISON, RANDOM, band, summarise

CASE = Quadrotor()


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--no-gif", action="store_true", help="leave the film out")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    began, note = time.perf_counter(), versions(args.seeds, args.workers)

    runs = run_all(run_seed, [(CASE, seed) for seed in range(args.seeds)], args.workers, "Figure 4")
    write_rows(out / "figure4_quadrotor.csv", (run for seed in runs for run in seed), note)

    rows, rho = read_rows(out / "figure4_quadrotor.csv"), CASE.rho
    t = grid(rows, "t", NOMINAL, 0.0)[0]
    for attack, name in ((POISON, "quad_poi.csv"), (RANDOM, "quad_rand.csv")):
        write_pgf(out / name, t, [band(grid(rows, "error", attack, rho))[0] for rho in CASE.rhos])
    error_panels(out / "figure4_quadrotor.png", rows, CASE.rhos, "position error [m]")
    circle = CASE.circle(CASE.steps).numpy()
    paths_from_above(out / "figure4_paths.png", rows, rho, circle)
    if not args.no_gif:
        film(out / "figure4_flight.gif", rows, rho, circle)

    crashes = {NAMES[NOMINAL]: len(crash_steps(rows, NOMINAL, 0.0))}
    for rho in CASE.rhos:
        crashes |= {f"{NAMES[a]} at {percent(rho)}": len(crash_steps(rows, a, rho)) for a in (RANDOM, POISON)}
    result = {
        "versions": note,
        "seconds": time.perf_counter() - began,
        "crashes": crashes,
        "unsolved": int(rows["unsolved"][:: CASE.replan_every].sum()),
        **summarise(rows, CASE.rhos),
    }
    write_json(out / "figure4_quadrotor.json", result)
    print(f"no attack: mean error {result['nominal']['mean']:.4f} m")
    for level in result["levels"]:
        print(
            f"rho {level['rho']:.1%}: {level['random']['mean']:.4f} m under random noise, "
            f"{level['poison']['mean']:.4f} m under Algorithm 1 ({level['ratio']:.1f} times)"
        )
    print(f"{sum(crashes.values())} crashes. Figure 4: {out / 'figure4_quadrotor.png'}, {result['seconds']:.0f} s")


if __name__ == "__main__":
    main()
