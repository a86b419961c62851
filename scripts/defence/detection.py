"""The runs of study_detection.py: a detector is calibrated on clean runs, and watches clean and attacked ones."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.defence.noisy import Noisy
from scripts.experiments.case import Case
from scripts.experiments.masses import MovingMasses
from scripts.experiments.quadrotor import Quadrotor
from scripts.experiments.scenario import RANDOM_START
from torch_dpc import attacks
from torch_dpc.detection import ConsistencyDetector

CASES: dict[str, Case] = {"masses": replace(MovingMasses(), noise=0.0), "quadrotor": Quadrotor()}
NOISES = (0.0, 1e-3, 1e-2)  # of recording and run, relative to the standard deviation of each recorded output
RATES = (0.01, 0.05, 0.2)  # stated false alarms
WATCHED = 0.05  # the rate at which the pictures are drawn
#: Clean runs for the calibration and for the fresh ones, each from a start and with noise of its own.
CLEAN_RUNS = {"masses": (24, 16), "quadrotor": (12, 8)}
QUICK_RUNS = {"masses": (6, 4), "quadrotor": (3, 2)}
CALIBRATION_SEED, FRESH_SEED = 20_000, 40_000  # + 1000 x the seed of the recording
RECORDING_NOISE = 60_000
GRID = (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.35, 0.5, 0.75, 1.0)  # shares of the ROC
NONE, RANDOM, POISON, STEALTHY = "no attack", "random noise", "Algorithm 1", "Algorithm 1, stealthy"


class Watched(NamedTuple):
    """A run as a monitor sees it.

    Attributes:
        u_ini, y_ini: the windows at which the controller planned, as it saw them, `(plans, t_ini, n)`.
        clean: y_ini without the attack.
        error: mean distance of the true outputs to the reference [m].
    """

    u_ini: Tensor
    y_ini: Tensor
    clean: Tensor
    error: float


class Setting:
    """One plant with one noise level: the controller of one recording, and its runs."""

    def __init__(self, case: Case, plant: Any, noise: float, seed: int):
        self.case = case
        u, y = case.record(plant, seed)
        deviation = noise * y.std(0)
        generator = torch.Generator().manual_seed(RECORDING_NOISE + seed)
        self.data = case.hankel(u, y + deviation * torch.randn(y.shape, dtype=y.dtype, generator=generator))
        self.layer = case.layer(self.data)
        self.plant = Noisy(plant, deviation)

    def run(self, seed: int, attack: Any = None, every: int | None = None) -> Watched:
        """Run from a random start; the windows are those of every plan, or of every so many steps."""
        case = self.case
        self.plant.generator = torch.Generator().manual_seed(seed)
        log = case.simulate(self.plant, self.layer, seed, attack, RANDOM_START)
        truth = torch.stack(self.plant.truth)[case.t_ini : case.t_ini + case.steps]
        off = (truth - log.y_ref)[:, case.channels]
        first = math.ceil(case.t_ini / case.replan_every) * case.replan_every
        steps = torch.arange(first, case.steps, every or case.replan_every)
        past = steps[:, None] + torch.arange(-case.t_ini, 0)
        return Watched(log.u[past], log.y[past] + log.p[steps], log.y[past], float(off.norm(dim=1).mean()))


def measure(plant: str, noise: float, seed: int, runs: tuple[int, int]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of one recording: false alarms, ROC and closed loops; `runs` for calibration and fresh."""
    torch.set_num_threads(1)
    case = CASES[plant]
    head = {"plant": plant, "noise": noise, "seed": seed}
    with case.system() as system:
        setting = Setting(case, system, noise, seed)
        usual = [setting.run(CALIBRATION_SEED + 1000 * seed + i, every=1) for i in range(runs[0])]
        fresh = [setting.run(FRESH_SEED + 1000 * seed + i, every=1) for i in range(runs[1])]
        detectors = {rate: calibrated(setting.data, usual, rate) for rate in RATES}
        of_clean = torch.cat([detectors[WATCHED].score(run.u_ini, run.y_ini) for run in fresh])
        alarms = []
        for rate, detector in detectors.items():
            found = torch.cat([detector.alarms(run.u_ini, run.y_ini) for run in fresh])
            alarms.append(head | {"rate": rate, "windows": len(found), "alarms": int(found.sum())})
        roc, loops = [], []
        for name, rho, known, attack in attacks_on(setting, detectors):
            run = setting.run(seed, attack)
            loops += [head | row for row in loop_rows(name, rho, known, run, detectors)]
            if rho == case.rho and known in (None, WATCHED):
                seen = detection(detectors[WATCHED].score(run.u_ini, run.y_ini), of_clean)
                keys = head | {"attack": name, "rho": rho}
                roc += [keys | {"false_alarms": f, "detected": d} for f, d in zip(GRID, seen, strict=True)]
    return {"rates": alarms, "roc": roc, "loops": loops}


def calibrated(data: dpc.HankelData, clean: list[Watched], rate: float) -> ConsistencyDetector:
    """Return a detector whose level comes from the windows of clean runs."""
    u_ini, y_ini = (list(torch.cat(part)) for part in ([r.u_ini for r in clean], [r.y_ini for r in clean]))
    return ConsistencyDetector(data).calibrate(u_ini, y_ini, false_alarms=rate)


def attacks_on(
    setting: Setting, detectors: dict[float, ConsistencyDetector]
) -> list[tuple[str, float, float | None, Any]]:
    """Return name, rho, rate and attack of every run; the stealthy ones know the detector of their rate."""
    layer, cost = setting.layer, setting.case.target()
    found: list[tuple[str, float, float | None, Any]] = [(NONE, 0.0, None, None)]
    for rho in setting.case.rhos:
        budget = attacks.RelativeBallBudget(rho)
        found.append((RANDOM, rho, None, attacks.RandomAttack(budget)))
        found.append((POISON, rho, None, attacks.LinearizedAttack(layer, cost, budget)))
        for rate, detector in detectors.items():
            stealthy = attacks.StealthyBudget(budget, detector)
            found.append((STEALTHY, rho, rate, attacks.LinearizedAttack(layer, cost, stealthy)))
    return found


def loop_rows(
    name: str, rho: float, rate: float | None, run: Watched, detectors: dict[float, ConsistencyDetector]
) -> list[dict[str, Any]]:
    """Return one row for each rate at which a run was watched.

    `raised` counts the windows that alarm under attack and not without it: none, for an attack limited to the level.
    """
    rows = []
    for level, detector in detectors.items():
        if rate in (None, level):
            alarms, own = detector.alarms(run.u_ini, run.y_ini), detector.alarms(run.u_ini, run.clean)
            counts = {"plans": len(alarms), "alarms": int(alarms.sum()), "raised": int((alarms & ~own).sum())}
            rows.append({"attack": name, "rho": rho, "rate": level, "error": run.error, **counts})
    return rows


def detection(attacked: Tensor, clean: Tensor) -> list[float]:
    """Return the share of attacked windows above the level that each share of `GRID` of the clean ones exceeds."""
    ordered = clean.sort(descending=True).values
    share = []
    for false_alarms in GRID:
        allowed = int(false_alarms * len(ordered))
        level = ordered[allowed] if allowed < len(ordered) else ordered.new_tensor(-torch.inf)
        share.append(float((attacked > level).double().mean()))
    return share
