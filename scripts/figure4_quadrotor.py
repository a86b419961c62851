"""Figure 4: position error of a PyBullet quadrotor under Algorithm 1 and under random noise.

    python scripts/figure4_quadrotor.py     # about 1 minute on two cores (--no-gif: 20 s less)

Ten seeds, each with its own recorded flight and its own noise. The vehicle starts at rest on the circle, 6 steps before
the reference begins to move. The bounds on the outputs are our choice, wide enough not to matter.
A vehicle that crashes counts as lying where it crashed; a plan without a solution is replaced by the rest of the one
before. Both are counted. Leaves, in results/:

    figure4_quadrotor.csv   every flight: position, attitude, commands and position error at every step
    figure4_quadrotor.png   median over the seeds and the band between the 10th and the 90th percentile
    figure4_paths.png       the flown paths from above, and figure4_flight.gif, two of them filmed (_film.py)
    quad_poi.csv, quad_rand.csv     the medians, for pgfplots
    figure4_quadrotor.json  the numbers, for report.py
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_dpc as dpc
from _common import (
    ATTACK_SEED,
    NOMINAL,
    POISON,
    RANDOM,
    arguments,
    attacks,
    band,
    grid,
    read_rows,
    run_all,
    summarise,
    versions,
    write_json,
    write_pgf,
    write_rows,
)
from _film import film
from _plots import NAMES, crash_steps, error_panels, paths_from_above, percent

T_INI, HORIZON, N_G = 6, 25, 500
SAMPLES = N_G + T_INI + HORIZON - 1
Q, R = torch.block_diag(10 * torch.eye(3), torch.zeros(3, 3)), torch.eye(3)
LAMBDA_S, LAMBDA_G = 1e6, 100.0
U_MAX = 1.0  # [m/s]
Y_MIN = torch.tensor([-2.0, -2.0, 0.0, *3 * [-math.pi / 2]], dtype=torch.float64)  # x, y, z [m], angles [rad]
Y_MAX = torch.tensor([2.0, 2.0, 2.0, *3 * [math.pi / 2]], dtype=torch.float64)
CENTRE = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)  # [m]
RADIUS, PERIOD = 0.3, 10.0  # [m], [s]
TARGET = torch.tensor([0.0, 1.0, 0.0])  # [m/s]: fly towards +y
RHO = (0.001, 0.002, 0.003)
STEPS, REPLAN_EVERY = 500, 10  # of 0.04 s

# Commands that keep the vehicle flying while they excite it: held for 0.4 s, with a weak pull towards the centre.
AMPLITUDE, HOLD, PULL = 0.5, 10, 0.3  # [m/s], steps, [1/s]

COLUMNS = ("x", "y", "z", "roll", "pitch", "yaw", "ux", "uy", "uz")  # [m], [rad], [m/s]


class LiesWhereItCrashed:
    """The quadrotor, except that after a crash it stays where that happened, instead of tumbling on."""

    n_u, n_y, dt = dpc.systems.Quadrotor.n_u, dpc.systems.Quadrotor.n_y, dpc.systems.Quadrotor.dt

    def __init__(self, plant: dpc.systems.Quadrotor):
        self.plant = plant

    def reset(self, position: Any = CENTRE) -> Tensor:
        """Put the vehicle at rest in mid-air."""
        self.down: list[bool] = []  # after each step
        self.y = self.plant.reset(position=position)
        return self.y

    def step(self, u: Tensor) -> Tensor:
        """Fly on, if it still flies."""
        if not self.plant.crashed:
            self.y = self.plant.step(u)
        self.down.append(self.plant.crashed)
        return self.y


def circle(steps: int) -> Tensor:
    """Return the reference, `(steps, 6)`: once around in `PERIOD`, anticlockwise, at constant height."""
    angle = 2 * math.pi / PERIOD * dpc.systems.Quadrotor.dt * torch.arange(steps, dtype=torch.float64)
    offset = RADIUS * torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1)
    return torch.cat([CENTRE + offset, torch.zeros_like(offset)], dim=1)


def record(plant: Any, seed: int) -> tuple[Tensor, Tensor]:
    """Return the commands and outputs of a random flight around the centre."""

    def pull(y: Tensor) -> Tensor:
        return -PULL * (y[:3] - CENTRE)

    generator = torch.Generator().manual_seed(seed)
    return dpc.collect(plant, SAMPLES, amplitude=AMPLITUDE, hold=HOLD, feedback=pull, generator=generator)


def planner(u: Tensor, y: Tensor) -> dpc.DPCLayer:
    """Return the planning problem of the paper on a recorded flight."""
    return dpc.DPCLayer(
        dpc.HankelData.from_trajectories(u, y, t_ini=T_INI, horizon=HORIZON),
        Q=Q,
        R=R,
        lambda_g=LAMBDA_G,
        lambda_s=LAMBDA_S,
        u_set=dpc.Box(-U_MAX, U_MAX),
        y_set=dpc.Box(Y_MIN, Y_MAX),
    )


def run_seed(seed: int, rhos: Sequence[float] = RHO) -> list[dict[str, Any]]:
    """Return the columns of every flight of one seed."""
    runs = []
    with dpc.systems.Quadrotor() as quadrotor:
        plant = LiesWhereItCrashed(quadrotor)
        layer = planner(*record(plant, seed))
        for name, rho, attack in attacks(layer, dpc.attacks.TargetInput(TARGET), rhos):
            log = dpc.simulate(
                plant,
                dpc.DPCController(layer, REPLAN_EVERY, on_failure="hold"),
                circle(STEPS + HORIZON),
                steps=STEPS,
                attack=attack,
                generator=torch.Generator().manual_seed(ATTACK_SEED + seed),
                reset={"position": circle(1)[0, :3]},
            )
            down = torch.tensor(plant.down[T_INI - 1 : -1])  # at the time of each measurement
            columns = torch.cat([log.y, log.u], dim=1).T
            runs.append(
                {
                    "seed": seed,
                    "attack": name,
                    "rho": rho,
                    "t": log.t.numpy(),
                    "error": torch.linalg.vector_norm((log.y - log.y_ref)[:, :3], dim=1).numpy(),
                    "crashed": down.numpy(),
                    "unsolved": ((log.status != dpc.Status.SOLVED) & ~down).numpy(),
                    **dict(zip(COLUMNS, columns.numpy(), strict=True)),
                }
            )
    return runs


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--no-gif", action="store_true", help="leave the film out")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    began, note = time.perf_counter(), versions(args.seeds, args.workers)

    runs = run_all(run_seed, [(seed,) for seed in range(args.seeds)], args.workers, "Figure 4")
    write_rows(out / "figure4_quadrotor.csv", (run for seed in runs for run in seed), note)

    rows = read_rows(out / "figure4_quadrotor.csv")
    t = grid(rows, "t", NOMINAL, 0.0)[0]
    for attack, name in ((POISON, "quad_poi.csv"), (RANDOM, "quad_rand.csv")):
        write_pgf(out / name, t, [band(grid(rows, "error", attack, rho))[0] for rho in RHO])
    error_panels(out / "figure4_quadrotor.png", rows, RHO, "position error [m]")
    paths_from_above(out / "figure4_paths.png", rows, RHO[-1], circle(STEPS).numpy())
    if not args.no_gif:
        film(out / "figure4_flight.gif", rows, RHO[-1], circle(STEPS).numpy())

    crashes = {NAMES[NOMINAL]: len(crash_steps(rows, NOMINAL, 0.0))}
    for rho in RHO:
        crashes |= {f"{NAMES[a]} at {percent(rho)}": len(crash_steps(rows, a, rho)) for a in (RANDOM, POISON)}
    result = {
        "versions": note,
        "seconds": time.perf_counter() - began,
        "crashes": crashes,
        "unsolved": int(rows["unsolved"][::REPLAN_EVERY].sum()),
        **summarise(rows, RHO),
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
