"""Judge trained adversaries beside random noise, Algorithm 1 and projected gradient, on held-out data."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scripts.adversary.losses import psi_at
from scripts.adversary.training import policy_tensors, read_tensors
from scripts.experiments.closed_loops import Windows
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared.statistics import NOMINAL, POISON, RANDOM
from torch_dpc import attacks

PLANTS = {"masses": Masses, "quadrotor": Quadrotor}
PROJECTED, WINDOWS, CLOSED_LOOP = "projected_gradient", "windows", "closed-loop"
AIMED, AIMED_PROJECTED = "algorithm1_tracking", "projected_gradient_tracking"
TIMED_BATCH, REPEATS = 1024, 15
NOISE_SEED = 1000
HELD_OUT_WINDOWS = "held-out windows"
JUDGED_FROM = 7000  # seeds of the judged runs: their recordings, starts and noise were never looked at in development
UNTRAINED = -1  # in the column of training seeds: an attack without a network
Policies = dict[tuple[str, int], attacks.AttackPolicy]  # by mode and training seed


def load_policies(paths: dict[tuple[str, int], Path], layer: Any) -> Policies:
    """Return the trained networks by mode and training seed, without graphs."""
    tensors = {key: policy_tensors(read_tensors(path)[0]) for key, path in paths.items()}
    return {k: attacks.AttackPolicy.from_state_dict(layer.data, t).requires_grad_(False) for k, t in tensors.items()}


def contenders(layer: Any, cost: Any, budget: attacks.Budget, policies: Policies) -> dict[tuple[str, int], Any]:
    """Return the attacks that are compared, by name and training seed."""
    made = {
        RANDOM: attacks.RandomAttack(budget),
        POISON: attacks.LinearizedAttack(layer, cost, budget),
        PROJECTED: attacks.ProjectedGradientAttack(layer, cost, budget),
    }
    trained = {key: attacks.PolicyAttack(policy, budget) for key, policy in policies.items()}
    return {**{(name, UNTRAINED): attack for name, attack in made.items()}, **trained}


def aimed_at_the_error(layer: Any, judged: Any, budget: attacks.Budget) -> dict[tuple[str, int], Any]:
    """Return attacks that push the predicted true output away from its reference, as closed-loop training does."""
    cost = attacks.TrackingError(layer.data, Q=judged)
    return {
        (AIMED, UNTRAINED): attacks.LinearizedAttack(layer, cost, budget),
        # At rest the tracking error has no gradient: only a restart finds a direction.
        (AIMED_PROJECTED, UNTRAINED): attacks.ProjectedGradientAttack(layer, cost, budget, restarts=2),
    }


# --- held-out windows ------------------------------------------------------------------------------------------------


def judge_windows(plant: Any, layer: Any, windows: Windows, policies: Policies) -> list[dict[str, Any]]:
    """Return a row for every rho and attack: the mean decrease of psi, and the time a sample in batch."""
    psi, rows = psi_at(plant, windows.step), []
    nominal = psi(windows.plan(layer))
    budget = attacks.RelativeBall(plant.rhos[0])
    one_a_mode = {mode: (mode, seed) for mode, seed in reversed(policies)}  # networks of one mode have one size
    timed = {key: policies[key] for key in one_a_mode.values()}
    batch, single = (time_attacks(plant, layer, windows, budget, timed, size) for size in (TIMED_BATCH, 1))
    for rho in plant.rhos:
        lower = {}
        for key, attack in contenders(layer, psi, attacks.RelativeBall(rho), policies).items():
            lower[key] = nominal - psi(windows.plan(layer, add(windows, attack)))
        base = lower[POISON, UNTRAINED]
        helped = base > 0
        for (name, trained), value in lower.items():
            measured = {
                "decrease": float(value.mean()),
                "of_psi": float((value / nominal).mean()),
                "of_algorithm1": float(value.mean() / base.mean()),
                "median_of_algorithm1": float((value / base)[helped].median()),
                "microseconds": batch[name],
                "microseconds_alone": single[name],
            }
            keys = {"setting": HELD_OUT_WINDOWS, "seed": -1, "attack": name, "trained": trained, "rho": rho}
            rows.append(keys | measured)
    return rows


def add(windows: Windows, attack: Any) -> torch.Tensor:
    """Return what an attack adds to each window, each at its own step; the costs know the steps already."""
    return windows.attacked_by(attack, step=windows.step, generator=torch.Generator().manual_seed(NOISE_SEED))


def time_attacks(
    plant: Any, layer: Any, windows: Windows, budget: Any, policies: Policies, size: int
) -> dict[str, float]:
    """Return the time of each attack a sample [us] in batches of a size, the median over calls that alternate."""
    batch = windows[torch.arange(size) % len(windows)]
    made = contenders(layer, psi_at(plant, batch.step), budget, policies)
    chosen = {name: attack for (name, _), attack in made.items()}
    spent: dict[str, list[float]] = {name: [] for name in chosen}
    for repeat in range(REPEATS + 1):
        for name, attack in chosen.items():
            if name == PROJECTED and repeat > 3:
                continue  # twenty times the work
            for _ in range(1 if name == PROJECTED else 2):  # the first call finds the caches as others left them
                began = time.perf_counter()
                add(batch, attack)
                took = time.perf_counter() - began
            spent[name].append(took)
    return {name: 1e6 * float(np.median(calls[1:])) / size for name, calls in spent.items()}


# --- held-out closed loops -------------------------------------------------------------------------------------------


def judge_run(plant_name: str, setting: str, seed: int, paths: dict[tuple[str, int], Path]) -> list[dict[str, Any]]:
    """Return a row for every attack and rho in closed loop, on one held-out seed."""
    plant = PLANTS[plant_name]()

    def all_attacks(layer: Any, cost: Any, rhos: Sequence[float]) -> Iterator[tuple[tuple[str, int], float, Any]]:
        policies = load_policies(paths, layer)
        yield (NOMINAL, UNTRAINED), 0.0, None
        for rho in rhos:
            budget = attacks.RelativeBall(rho)
            both = contenders(layer, cost, budget, policies) | aimed_at_the_error(layer, plant.judged, budget)
            yield from ((key, rho, attack) for key, attack in both.items())

    rows = []
    for row in plant.judge(setting, seed, all_attacks):
        name, trained = row["attack"]
        rows.append({"setting": setting, "seed": seed, "trained": trained, **row, "attack": name})
    return rows
