"""The runs of study_poisoned_data.py: a recording with few changed samples, and what its controller then does."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.experiments.case import Case
from scripts.experiments.masses import MovingMasses
from scripts.experiments.quadrotor import Quadrotor
from scripts.experiments.sensitivity import with_noise
from scripts.shared.statistics import NOMINAL
from torch_dpc import attacks

CASES: dict[str, Case] = {"masses": replace(MovingMasses(), noise=0.0), "quadrotor": Quadrotor()}
NOISES = (0.0, 1e-2)  # of the recording, relative to the standard deviation of each output
COUNTS = (1, 5, 20, 100)  # poisoned samples, of 530
SIZE = 0.1  # of the change of each output of a sample, relative to its standard deviation
STEPS = 10  # of the attack after the first
WINDOWS = 20  # that the attacker plans for, and as many held out
ATTACKER_SEED, HELD_OUT_SEED, ATTACK_SEED = 100, 200, 8000  # + the seed of the recording
RIDGE = 1e-2  # of the spread of each output, what study_noise.py recommends
CLEAN, NOISE = "clean", "noise at random samples"
METHODS = {"random": "random samples, chosen changes", "influence": "samples by influence", "greedy": "greedy samples"}
WITH_RIDGE = ", ridge"  # after the name of a way to poison
RIDGED = ("influence", "greedy")


class Judge(NamedTuple):
    """Where plans are judged: windows of a clean recording, and the true outputs that the same recording predicts."""

    u_ini: Tensor
    y_ini: Tensor
    refs: dict[str, Any]
    cost: attacks.TrackingError

    def error(self, layer: dpc.DPCLayer) -> float:
        """Return the root mean square of the true distance to the reference over the plans [m]."""
        plan = layer(self.u_ini, self.y_ini, **self.refs)
        psi = self.cost.given(u_ini=self.u_ini, y_ini=self.y_ini, y_ref=self.refs["y_ref"])(plan)
        return math.sqrt(-2 * float(psi.mean()) / plan.u.shape[-2])


def judge(case: Case, plant: Any, seed: int) -> Judge:
    """Return the windows of one clean recording, evenly spaced, with the experiment's references from its start on."""
    u, y = case.record(plant, seed)
    first = torch.linspace(0, len(u) - case.t_ini - case.horizon, WINDOWS).long()
    rows = first[:, None] + torch.arange(case.t_ini)
    y_ref, u_ref = case.references(case.horizon)
    weight = torch.zeros(y.shape[1], dtype=torch.float64)
    weight[case.channels] = 1.0
    refs = {"y_ref": y_ref} if u_ref is None else {"y_ref": y_ref, "u_ref": u_ref}
    return Judge(u[rows], y[rows], refs, attacks.TrackingError(case.hankel(u, y), torch.diag(weight)))


def measure(plant: str, noise: float, seed: int, counts: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return one row for each way to poison one recording."""
    torch.set_num_threads(1)
    case, rows = CASES[plant], []
    with case.system() as system:
        u, y = case.record(system, seed)
        y = with_noise(y, noise, seed) if noise else y
        layer = case.layer(case.hankel(u, y))
        mine, held_out = (judge(case, system, first + seed) for first in (ATTACKER_SEED, HELD_OUT_SEED))

        def add(method: str, count: int, planner: dpc.DPCLayer) -> None:
            run = case.run(system, planner, seed, NOMINAL, 0.0)
            errors = {"seen": mine.error(planner), "held_out": held_out.error(planner), "error": run.error}
            head = {"plant": plant, "noise": noise, "seed": seed, "method": method, "count": count}
            rows.append(head | errors | {"unsolved": run.unsolved})

        def ridged(data: dpc.HankelData) -> dpc.DPCLayer:
            return case.layer(data.with_ridge(RIDGE * y.std(0)))

        assert isinstance(layer.data, dpc.HankelData)
        add(CLEAN, 0, layer)
        add(CLEAN + WITH_RIDGE, 0, ridged(layer.data))
        budget = attacks.BoxBudget(SIZE * y.std(0))
        for count in counts:
            generator = torch.Generator().manual_seed(ATTACK_SEED + seed)
            p = torch.zeros_like(y)
            p[torch.randperm(len(y), generator=generator)[:count]] = budget.random(y[:count, None], generator)[:, 0]
            add(NOISE, count, case.layer(case.hankel(u, y + p)))
            for choose in METHODS:
                attack = attacks.PoisonedRecording(layer, mine.cost, budget, samples=count, choose=choose, steps=STEPS)
                generator = torch.Generator().manual_seed(ATTACK_SEED + seed)
                poisoned = attack(u, y, mine.u_ini, mine.y_ini, **mine.refs, generator=generator)
                add(choose, count, poisoned.layer)
                if choose in RIDGED:
                    assert isinstance(poisoned.layer.data, dpc.HankelData)
                    add(choose + WITH_RIDGE, count, ridged(poisoned.layer.data))
    return rows
