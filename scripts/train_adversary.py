"""Train adversaries by backprop, a network in place of Algorithm 1, and judge them on what they have not seen.

    python -m scripts.train_adversary --plant masses        # about 3 minutes on two cores
    python -m scripts.train_adversary --plant quadrotor     # about 6 minutes
    torchrun --nproc-per-node 2 -m scripts.train_adversary --plant masses       # the same, each batch on two processes

`--mode windows` trains through the layer on windows recorded in closed loop: Algorithm 1's direction is imitated, then
psi lowered. `--mode closed-loop` goes on from the imitation and makes the error of the whole run large, back through
every plan and the plant: the masses' own dynamics, or a linear model of the quadrotor fitted to the controller's
recording. Default is both, each with three training seeds: of the first weights, the recorded runs and the batches. A
run that was killed goes on where it was when started again; `--restart` begins anew.
Leaves, in results/:

    adversary_{plant}.csv       every comparison: decrease of psi and time on held-out windows, error in closed loop
    adversary_{plant}.md        the same as tables
    adversary_{plant}_training.png, _windows.png, _loop.png     one picture a story
    adversary_{plant}_curves.csv                the training, record by record
    adversary_{plant}_{mode}.safetensors        the network, and what is needed to go on training; _seed1, _seed2 others
    adversary_{plant}_recording.safetensors     the windows it is trained on; likewise
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from scripts.adversary import judge
from scripts.adversary.losses import LoopLoss, WindowLosses, psi_at
from scripts.adversary.report import pictures, windows_table, write_report
from scripts.adversary.training import Stage, process_group, rank, read_tensors, train, world, write_tensors
from scripts.experiments.closed_loops import HELD_OUT, TRAINING, Windows
from scripts.shared.command import arguments, run_all, versions
from scripts.shared.rows import read_rows, write_rows
from torch_dpc import attacks

HIDDEN = [16]
# Iterations of each stage, windows and closed loops an iteration, runs recorded for training and for judging.
FULL = {
    "masses": {
        "imitate": 1500,
        "lower": 200,
        "warm": 400,
        "loop": 60,
        "batch": 256,
        "loops": 48,
        "runs": 48,
        "kept": 48,
    },
    "quadrotor": {
        "imitate": 1500,
        "lower": 150,
        "warm": 400,
        "loop": 40,
        "batch": 256,
        "loops": 24,
        "runs": 48,
        "kept": 48,
    },
}
QUICK = {"imitate": 20, "lower": 4, "warm": 20, "loop": 3, "batch": 16, "loops": 6, "runs": 6, "kept": 6}
RATE = {"imitate": 3e-3, "lower": 1e-3, "loop": 3e-3}  # of Adam
LARGEST_GRADIENT = 1.0  # in closed loop, where a few runs may have large ones
VALIDATED_LOOPS = 8
TRAINING_SEEDS, QUICK_SEEDS = (0, 1, 2), (0,)
MODES = (judge.WINDOWS, judge.CLOSED_LOOP)


class Training:
    """One plant's controller, its recorded windows and its networks.

    Args:
        plant: the name of an experiment.
        out: the folder of the results.
        size: an entry of `FULL`, or `QUICK`.
        seed: of the first weights, the recorded runs and the batches.
        workers: processes that record.
        hidden: width of each hidden layer.
    """

    def __init__(
        self, plant: str, out: Path, size: dict[str, Any], seed: int, workers: int, hidden: Sequence[int] = HIDDEN
    ):
        self.plant, self.out, self.size, self.seed, self.workers = judge.PLANTS[plant](), out, size, seed, workers
        self.hidden = hidden
        self.layer = self.plant.planner(TRAINING)
        self.suffix = f"_seed{seed}" if seed else ""
        self.windows = self._recorded(f"recording{self.suffix}", 1000 * (1 + seed), size["runs"], every_step=True)
        self.held_out = self._recorded("held_out", HELD_OUT, size["kept"], every_step=False)

    def checkpoint(self, mode: str) -> Path:
        """Return where a network is kept."""
        return self.out / f"adversary_{self.plant.plant}_{mode}{self.suffix}.safetensors"

    def forget(self, modes: Sequence[str]) -> None:
        """Delete the checkpoints, by the first process for all."""
        if rank() == 0:
            for mode in modes:
                self.checkpoint(mode).unlink(missing_ok=True)
        if world() > 1:
            dist.barrier()

    def train(self, mode: str) -> list[dict[str, Any]]:
        """Train the network of a mode and return its curve."""
        w, size = self.windows, self.size
        policy = attacks.AttackPolicy.for_windows(
            self.layer.data,
            (w.u_ini, w.y_ini, w.y_ref, w.u_ref, w.step),
            hidden=self.hidden,
            context=self.plant.context,
            generator=torch.Generator().manual_seed(self.seed),
        )
        losses = WindowLosses(self.plant, self.layer, w, policy, size["batch"], self.seed)
        if mode == judge.WINDOWS:
            stages = [
                Stage("imitate", losses.imitate, size["imitate"], RATE["imitate"], every=100),
                Stage("lower psi", losses.lower, size["lower"], RATE["lower"], every=10),
            ]
            validate = self._validate_windows(policy)
        else:
            loss = LoopLoss(self.plant, self.layer, policy, size["loops"], self.seed)
            stages = [
                Stage("imitate", losses.imitate, size["warm"], RATE["imitate"], every=100),
                Stage("closed loop", loss, size["loop"], RATE["loop"], LARGEST_GRADIENT, every=5),
            ]
            validate = self._validate_loop(policy)
        settings = {"plant": self.plant.plant, "mode": mode, "seed": self.seed, "hidden": list(self.hidden)}
        settings |= {key: self.size[key] for key in ("batch", "loops", "runs")}
        path, label = self.checkpoint(mode), f"{self.plant.plant}, {mode}, seed {self.seed}"
        curve = train(policy, stages, path, settings=settings, validate=validate, label=label)
        before = list(itertools.accumulate((stage.iterations for stage in stages), initial=0))
        return [
            {
                "mode": mode,
                "trained": self.seed,
                "stage": stages[int(stage)].name,
                "total": before[int(stage)] + iteration,
                "loss": loss,
                "of_algorithm1": effect,
            }
            for stage, iteration, loss, effect in curve.tolist()
        ]

    def _recorded(self, name: str, seed: int, runs: int, *, every_step: bool) -> Windows:
        """Return recorded windows, from the disk if they are there; the first process records for all."""
        path = self.out / f"adversary_{self.plant.plant}_{name}.safetensors"
        made_with = {"seed": seed, "runs": runs, "every_step": every_step}
        if rank() == 0 and not (path.exists() and read_tensors(path)[1]["made_with"] == made_with):
            windows = self.plant.record_windows(seed, runs, self.workers, every_step=every_step)
            write_tensors(path, windows.tensors(), {"made_with": made_with})
        if world() > 1:
            dist.barrier()
        return Windows(**read_tensors(path)[0])

    def _validate_windows(self, policy: Any) -> Any:
        """Return what measures the decrease of psi on held-out windows, relative to Algorithm 1's, over all rho."""
        w, psi = self.held_out, psi_at(self.plant, self.held_out.step)
        nominal = psi(w.plan(self.layer))

        def lower(attack: Any) -> float:
            return float((nominal - psi(w.plan(self.layer, judge.add(w, attack)))).mean())

        budgets = [attacks.RelativeBall(rho) for rho in self.plant.rhos]
        base = [lower(attacks.LinearizedAttack(self.layer, psi, budget)) for budget in budgets]

        @torch.no_grad()
        def validate() -> float:
            share = [lower(attacks.PolicyAttack(policy, budget)) / b for budget, b in zip(budgets, base, strict=True)]
            return sum(share) / len(share)

        return validate

    def _validate_loop(self, policy: Any) -> Any:
        """Return what measures the error in closed loop from held-out states, relative to Algorithm 1's."""
        starts = self.plant.starts(VALIDATED_LOOPS, HELD_OUT)

        def error(attack: Any) -> float:
            outputs, _ = self.plant.loop(self.layer, attack, starts)
            return float(self.plant.mean_errors(outputs, starts).mean())

        budgets = [attacks.RelativeBall(rho) for rho in self.plant.rhos]
        base = [error(attacks.LinearizedAttack(self.layer, self.plant.target(), budget)) for budget in budgets]

        @torch.no_grad()
        def validate() -> float:
            share = [error(attacks.PolicyAttack(policy, budget)) / b for budget, b in zip(budgets, base, strict=True)]
            return sum(share) / len(share)

        return validate


def compare(trainings: Sequence[Training], modes: Sequence[str], seeds: int, workers: int) -> list[dict[str, Any]]:
    """Return the rows of every comparison, on held-out windows and in closed loop."""
    first = trainings[0]
    paths = {(mode, training.seed): training.checkpoint(mode) for mode in modes for training in trainings}
    rows = judge.judge_windows(first.plant, first.layer, first.held_out, judge.load_policies(paths, first.layer))
    held_out = range(judge.JUDGED_FROM, judge.JUDGED_FROM + seeds)
    jobs = [(first.plant.plant, setting, seed, paths) for setting in first.plant.settings for seed in held_out]
    runs = [row for job in run_all(judge.judge_run, jobs, workers, "closed loop") for row in job]
    columns = dict.fromkeys(key for row in [*rows, *runs] for key in row)
    return [{key: row.get(key, float("nan")) for key in columns} for row in [*rows, *runs]]


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=6)
    parser.add_argument("--plant", choices=sorted(judge.PLANTS), default="masses")
    parser.add_argument("--mode", choices=[*MODES, "all"], default="all")
    parser.add_argument("--seed", type=int, nargs="+", help="of weights, recorded runs and batches (default 0 1 2)")
    parser.add_argument("--hidden", type=int, nargs="*", default=HIDDEN, help="width of each hidden layer")
    parser.add_argument("--quick", action="store_true", help="a few iterations and runs, to see that it works")
    parser.add_argument("--restart", action="store_true", help="forget the checkpoints")
    parser.add_argument("--no-judging", action="store_true", help="train only")
    args = parser.parse_args(argv)
    modes = MODES if args.mode == "all" else (args.mode,)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    began, size = time.perf_counter(), QUICK if args.quick else FULL[args.plant]
    with process_group():
        trainings = [
            Training(args.plant, args.out, size, seed, args.workers, args.hidden)
            for seed in args.seed or (QUICK_SEEDS if args.quick else TRAINING_SEEDS)
        ]
        curves = []
        for training in trainings:
            if args.restart:
                training.forget(modes)
            curves += [record for mode in modes for record in training.train(mode)]
        last = judge.JUDGED_FROM + args.seeds - 1
        note = f"{versions(args.seeds, args.workers).split(';')[0]}; held-out seeds {judge.JUDGED_FROM} to {last}; "
        note += f"trained with seeds {', '.join(str(t.seed) for t in trainings)} on {world()} process(es)"
        if rank() > 0 or args.no_judging:
            return

    name = args.out / f"adversary_{args.plant}"
    write_rows(name.with_name(name.name + "_curves.csv"), curves, note)
    write_rows(name.with_suffix(".csv"), compare(trainings, modes, args.seeds, args.workers), note)
    rows = read_rows(name.with_suffix(".csv"))
    write_report(name.with_suffix(".md"), rows, args.plant, trainings[0].plant.rhos, note, judge.TIMED_BATCH)
    pictures(name, rows, read_rows(name.with_name(name.name + "_curves.csv")), trainings[0].plant.rhos)
    print("\n".join(windows_table(rows, trainings[0].plant.rhos)))
    print(f"Adversaries of the {args.plant}: {name.with_suffix('.md')}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
