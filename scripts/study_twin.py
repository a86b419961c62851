"""Adversaries trained in closed loop on a thousand quadrotors at once, judged in PyBullet.

    python -m scripts.study_twin            # about 5 minutes on one core (--quick: 1 minute)

A network in place of Algorithm 1 first imitates its direction on recorded windows; then the mean distance from the
circle is made large by backprop through every plan of a run, (a) through a linear model fitted to the controller's
recording, as `train_adversary` does, and (b) through `TorchQuadrotor`, whose equations are PyBullet's. Both have the
same iterations, vehicles, starts and steps of the optimiser. Judged on held-out laps in PyBullet, beside no attack,
random noise and Algorithm 1; the same commands given to `TorchQuadrotor` say how far the twin is off under attack. A
run that was killed goes on from its last checkpoint. Leaves, in results/:

    study_twin.csv, .md             every lap, and the tables
    study_twin_signal.csv           a signal that foresees the run on the twin (`SignalAttack`), replayed to PyBullet
    study_twin_{model}.safetensors  the networks
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.adversary.losses import LoopLoss, WindowLosses
from scripts.adversary.training import Stage, policy_tensors, read_tensors, train
from scripts.experiments.closed_loops import HELD_OUT, TRAINING, Windows, closed_loops
from scripts.experiments.quadrotor import fly_lap, linear_model, regressors
from scripts.experiments.quadrotor_twin import QuadrotorTwin
from scripts.shared.command import arguments, run_all, versions
from scripts.shared.rows import read_rows, write_rows
from scripts.shared.statistics import NOMINAL, POISON, RANDOM
from torch_dpc import attacks

FULL = {"recorded": 200, "imitate": 400, "loop": 20, "vehicles": 1000, "run_steps": 60}
QUICK = {"recorded": 20, "imitate": 20, "loop": 2, "vehicles": 30, "run_steps": 45}
BATCH = 256  # windows an iteration of the imitation
RATE = {"imitate": 3e-3, "loop": 5e-3}  # of Adam
LARGEST_GRADIENT = 1.0
HIDDEN = (16,)
MODELS = ("linear model", "twin")
SIGNAL = {"flown": 100, "plans": 2, "steps": 6}  # steps of each lap, plans looked ahead, gradient steps at each plan


class LinearTwin(QuadrotorTwin):
    """The same runs on the linear model that is fitted to the controller's recording."""

    def loop(self, layer: Any, attack: Any, starts: Tensor) -> tuple[Tensor, Windows]:
        """Run on the linear model."""
        model, circle = linear_model(self, TRAINING), self.circle(self.lap + self.run_steps + self.horizon)
        u_ref = torch.zeros(self.horizon, self.n_u, dtype=torch.float64)

        def references(k: int) -> dict[str, Tensor]:
            return {"y_ref": circle[starts[:, None] + k + torch.arange(self.horizon)], "u_ref": u_ref}

        def step(us: list[Tensor], ys: list[Tensor]) -> Tensor:
            return regressors(us, ys) @ model

        at_rest = ([u_ref[:1].expand(len(starts), -1)] * self.t_ini, [circle[starts]] * self.t_ini)
        lengths = {"steps": self.run_steps, "replan_every": self.replan_every}
        return closed_loops(layer, attack, step, at_rest, references, **lengths)


def learn(model: str, size: dict[str, int], out: Path, windows: Windows) -> Path:
    """Train one network and return its checkpoint."""
    case = {"twin": QuadrotorTwin, "linear model": LinearTwin}[model](run_steps=size["run_steps"])
    layer = case.planner(TRAINING)
    assert isinstance(layer.data, dpc.HankelData)
    seen = (windows.u_ini, windows.y_ini, windows.y_ref, windows.u_ref, windows.step)
    generator = torch.Generator().manual_seed(0)
    policy = attacks.AttackPolicy.for_windows(layer.data, seen, hidden=HIDDEN, generator=generator)
    imitate = WindowLosses(case, layer, windows, policy, BATCH, 0).imitate
    loop = LoopLoss(case, layer, policy, size["vehicles"], 0)
    stages = [
        Stage("imitate", imitate, size["imitate"], RATE["imitate"], every=100),
        Stage("closed loop", loop, size["loop"], RATE["loop"], LARGEST_GRADIENT, every=2),
    ]
    path = out / f"study_twin_{model.replace(' ', '_')}.safetensors"
    train(policy, stages, path, settings={"model": model, **size}, label=model)
    return path


def record(size: dict[str, int]) -> Windows:
    """Return the windows of laps with no attack, random noise and Algorithm 1, at the largest rho."""
    case = QuadrotorTwin()
    layer, budget = case.planner(TRAINING), attacks.RelativeBallBudget(case.rho)
    kinds = (None, attacks.RandomAttack(budget), attacks.LinearizedAttack(layer, case.target(), budget))
    parts = []
    with torch.no_grad():
        for i, attack in enumerate(kinds):
            generator = torch.Generator().manual_seed(i)
            log = case.fly(layer, attack, case.starts(size["recorded"] // 3 + 1, i), case.lap, generator=generator)
            parts.append(case.windows(log))
    return Windows.joined(parts)


def contenders(layer: Any, case: QuadrotorTwin, paths: dict[str, Path]) -> Iterator[tuple[str, float, Any]]:
    """Yield name, rho and attack of everything that is judged."""
    yield NOMINAL, 0.0, None
    for rho in case.rhos:
        budget = attacks.RelativeBallBudget(rho)
        yield RANDOM, rho, attacks.RandomAttack(budget)
        yield POISON, rho, attacks.LinearizedAttack(layer, case.target(), budget)
        for model, path in paths.items():
            policy = attacks.AttackPolicy.from_state_dict(layer.data, policy_tensors(read_tensors(path)[0]))
            yield model, rho, attacks.PolicyAttack(policy.requires_grad_(False), budget)


def judge(seed: int, paths: dict[str, Path]) -> list[dict[str, Any]]:
    """Return a row for each attack on one held-out lap in PyBullet, with its commands and path."""
    case, rows = QuadrotorTwin(), []
    layer, start = case.planner(TRAINING), int(case.starts(1, HELD_OUT + seed))
    for name, rho, attack in contenders(layer, case, paths):
        log, down = fly_lap(case, layer, attack, start, torch.Generator().manual_seed(seed))
        row = {"seed": seed, "attack": name, "rho": rho, "error": float(case.error(log).mean())}
        rows.append(row | {"crashed": float(down.any()), "path": log.y[:, :3], "commands": log.u})
    return rows


def signals(seeds: int, paths: dict[str, Path]) -> list[dict[str, Any]]:
    """Return a row for each attack on the first steps of the held-out laps, at the largest rho, in PyBullet.

    The signal attack foresees the run on the twin, all laps at once; what it reported is then replayed to PyBullet.
    """
    case = QuadrotorTwin()
    layer, steps = case.planner(TRAINING), SIGNAL["flown"]
    starts = torch.cat([case.starts(1, HELD_OUT + seed) for seed in range(seeds)])
    vehicles, controller = case.vehicles(), dpc.DPCController(layer, case.replan_every, on_failure="hold")
    error, budget = attacks.RunError(case.channels), attacks.RelativeBallBudget(case.rho)
    plans, walk = SIGNAL["plans"], SIGNAL["steps"]
    attack = attacks.SignalAttack(vehicles, controller, error, budget, plans=plans, steps=walk)
    foreseen = case.fly(layer, attack, starts, steps, vehicles=vehicles).p.detach()

    rows = []
    for seed, start in enumerate(starts.tolist()):

        def replayed(u_ini: Tensor, y_ini: Tensor, *, step: int, seed: int = seed, **_: Any) -> Tensor:
            return foreseen[seed, min(step, steps - 1)]

        chosen = {name: one for name, rho, one in contenders(layer, case, paths) if rho in (0.0, case.rho)}
        for name, one in {**chosen, "signal": replayed}.items():
            log, _ = fly_lap(case, layer, one, start, torch.Generator().manual_seed(seed))
            rows.append({"seed": seed, "attack": name, "error": float(case.error(log)[:steps].mean())})
    return rows


def largest_gap(rows: list[dict[str, Any]]) -> float:
    """Return how far the twin is from PyBullet under the same commands [m], laps that ended in a crash left out."""
    flown = [row for row in rows if not row["crashed"]]
    commands, paths = (torch.stack([row[name] for row in flown]) for name in ("commands", "path"))
    return float((QuadrotorTwin().replay(paths[:, 0], commands)[..., :3] - paths).abs().max())


def table(rows: dict[str, Any], rhos: tuple[float, ...], seconds: dict[str, float], gap: float, note: str) -> str:
    """Return the report in Markdown."""
    times = ", ".join(f"{model} {value:.0f} s of processor time" for model, value in seconds.items())
    lines = [
        "# Adversaries trained on a thousand quadrotors",
        f"{note}. Training: {times}.",
        "Mean distance from the circle over a held-out lap in PyBullet [m]: mean (least to largest) over the laps.",
    ]
    cells = ["| attack | " + " | ".join(f"rho {100 * rho:g} %" for rho in rhos) + " |", "|---" * (len(rhos) + 1) + "|"]
    for name in (NOMINAL, RANDOM, POISON, *MODELS):
        row = []
        for rho in rhos:
            chosen = (rows["attack"] == name) & (rows["rho"] == (0.0 if name == NOMINAL else rho))
            error, crashed = rows["error"][chosen], int(rows["crashed"][chosen].sum())
            fell = f", {crashed} crashed" if crashed else ""
            row.append(f"{error.mean():.3f} ({error.min():.3f} to {error.max():.3f}){fell}")
        cells.append(f"| {name} | " + " | ".join(row) + " |")
    end = f"The twin under the commands of these laps, those with a crash left out: {gap:.1e} m from PyBullet at most."
    return "\n\n".join([*lines, "\n".join(cells), end]) + "\n"


def signal_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of the signal attack in Markdown."""
    lines = [
        f"First {SIGNAL['flown']} steps of the laps, at the largest rho, in PyBullet [m].\n",
        "| attack | mean (least to largest) |",
        "|---|---|",
    ]
    for name in dict.fromkeys(row["attack"] for row in rows):
        errors = [row["error"] for row in rows if row["attack"] == name]
        lines.append(f"| {name} | {sum(errors) / len(errors):.3f} ({min(errors):.3f} to {max(errors):.3f}) |")
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=6)
    parser.add_argument("--quick", action="store_true", help="a few iterations and vehicles, to see that it works")
    args = parser.parse_args(argv)
    size, out = QUICK if args.quick else FULL, args.out
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    windows, paths, seconds = record(size), {}, {}
    for model in MODELS:
        began = time.process_time()
        paths[model] = learn(model, size, out, windows)
        seconds[model] = time.process_time() - began
    laps = run_all(judge, [(seed, paths) for seed in range(args.seeds)], args.workers, "laps in PyBullet")
    gap = largest_gap([row for lap in laps for row in lap])
    loop = f"{size['vehicles']} vehicles, {size['loop']} iterations of {size['run_steps']} steps"
    note = f"{versions(args.seeds, args.workers)}; {loop}"
    kept = ("seed", "attack", "rho", "error", "crashed")
    write_rows(out / "study_twin.csv", [{key: row[key] for key in kept} for lap in laps for row in lap], note)
    text = table(read_rows(out / "study_twin.csv"), QuadrotorTwin().rhos, seconds, gap, note)
    foreseen = signals(args.seeds, paths)
    write_rows(out / "study_twin_signal.csv", foreseen, note)
    text = f"{text}\n{signal_table(foreseen)}"
    (out / "study_twin.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
