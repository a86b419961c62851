"""Figure 3: tracking error of the oscillating masses under Algorithm 1 and under random noise.

    python scripts/figure3_masses.py        # about 15 s on two cores

Ten seeds, each with its own data and its own noise. Two masses are held at 1 m by the input (1, 1), which lies on its
bound; every run starts there, so the error is the attacker's work alone. Leaves, in results/:

    figure3_masses.csv      every run: inputs, outputs and the error of the first mass, |y1 - 1 m|, at every step
    figure3_masses.png      median over the seeds and the band between the 10th and the 90th percentile
    mass_poi.csv, mass_rand.csv     the medians, for pgfplots
    figure3_masses.json     the numbers, for report.py
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

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
from _plots import error_panels

T_INI, HORIZON, N_G = 6, 25, 500
SAMPLES = N_G + T_INI + HORIZON - 1
Q, R = 10 * torch.eye(4), torch.eye(2)
LAMBDA_S, LAMBDA_G = 1e6, 100.0
U_MAX, Y_MAX = 1.0, 5.0  # [N], [m, m/s]
U_REF = torch.tensor([1.0, 1.0])  # [N]
Y_REF = torch.tensor([1.0, 1.0, 0.0, 0.0])  # [m, m/s]
RHO = (0.02, 0.04, 0.10)
STEPS, REPLAN_EVERY = 200, 10  # of 0.1 s
SETTLED = 5.0  # [s]: the first swing is over


def target(dt: float) -> torch.Tensor:
    """Return the input the attacker wants, sin(t) [N] on both masses, as far as the last plan reaches."""
    return torch.sin(dt * torch.arange(STEPS + HORIZON, dtype=torch.float64))[:, None].expand(-1, 2)


def run_seed(seed: int, rhos: Sequence[float] = RHO) -> list[dict[str, Any]]:
    """Return the columns of every run of one seed."""
    plant = dpc.systems.OscillatingMasses()
    recording = dpc.collect(plant, SAMPLES, generator=torch.Generator().manual_seed(seed))
    layer = dpc.DPCLayer(
        dpc.HankelData.from_trajectories(*recording, t_ini=T_INI, horizon=HORIZON),
        Q=Q,
        R=R,
        lambda_g=LAMBDA_G,
        lambda_s=LAMBDA_S,
        u_set=dpc.Box(-U_MAX, U_MAX),
        y_set=dpc.Box(-Y_MAX, Y_MAX),
    )
    cost = dpc.attacks.TargetInput(trajectory=target(plant.dt))
    runs = []
    for name, rho, attack in attacks(layer, cost, rhos):
        log = dpc.simulate(
            plant,
            dpc.DPCController(layer, REPLAN_EVERY, on_failure="hold"),
            Y_REF,
            steps=STEPS,
            u_ref=U_REF,
            attack=attack,
            generator=torch.Generator().manual_seed(ATTACK_SEED + seed),
            reset={"state": Y_REF},
            u_warmup=U_REF,
        )
        runs.append(
            {
                "seed": seed,
                "attack": name,
                "rho": rho,
                "t": log.t.numpy(),
                "error": (log.y[:, 0] - Y_REF[0]).abs().numpy(),
                "unsolved": (log.status != dpc.Status.SOLVED).numpy(),
                **{f"u{i + 1}": log.u[:, i].numpy() for i in range(plant.n_u)},
                **{f"y{i + 1}": log.y[:, i].numpy() for i in range(plant.n_y)},
            }
        )
    return runs


def main(argv: list[str] | None = None) -> None:
    args = arguments(__doc__).parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    began, note = time.perf_counter(), versions(args.seeds, args.workers)

    runs = run_all(run_seed, [(seed,) for seed in range(args.seeds)], args.workers, "Figure 3")
    write_rows(out / "figure3_masses.csv", (run for seed in runs for run in seed), note)

    rows = read_rows(out / "figure3_masses.csv")
    t = grid(rows, "t", NOMINAL, 0.0)[0]
    for attack, name in ((POISON, "mass_poi.csv"), (RANDOM, "mass_rand.csv")):
        write_pgf(out / name, t, [band(grid(rows, "error", attack, rho))[0] for rho in RHO])
    error_panels(out / "figure3_masses.png", rows, RHO, "error of the first mass [m]")

    settled = t >= SETTLED
    means = {a: [grid(rows, "error", a, rho)[:, settled].mean() for rho in RHO] for a in (RANDOM, POISON)}
    result = {
        "versions": note,
        "seconds": time.perf_counter() - began,
        "largest": float(rows["error"].max()),
        "unsolved": int(rows["unsolved"][::REPLAN_EVERY].sum()),
        "settled_from": SETTLED,
        "settled": {attack: [float(mean) for mean in values] for attack, values in means.items()},
        **summarise(rows, RHO),
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
