"""What tuned weights must stand: every scenario without an attack, and every attack, on recordings kept back.

Other weights are only called better if no trial gets worse and at least one gets better, each by the interval of its
paired difference over the seeds. A controller that no longer controls does not pass: it fails from other starts, under
pushes and where the reference changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import torch_dpc as dpc
from scripts.experiments.case import Case
from scripts.experiments.scenario import AWAY, CHANGING, FIGURE, PUSHED, RANDOM_START, SCENARIOS, Scenario
from scripts.shared import bootstrap
from scripts.shared.rows import Array
from torch_dpc import attacks


@dataclass(frozen=True)
class PolicySettings:
    """How the trained attacker is trained."""

    hidden: tuple[int, ...] = (16,)  # width of each hidden layer
    iterations: int = 300  # of Adam; the loss is flat after about 200
    batch: int = 128  # windows an iteration
    rate: float = 3e-3  # of Adam
    every: int = 2  # steps between the windows that it is trained on
    seed: int = 0  # of weights and batches


POLICY = PolicySettings()
QUERIES = 100  # a window, of the black-box attack
SAME = 0.02  # of the mean error before: less than this, and less than TINY, is no change worth the name
TINY = 1e-4  # [m]


@dataclass(frozen=True)
class Trial:
    """One column of the judgement: a scenario under an attack.

    Attributes:
        scenario: of the run.
        attack: its name, a key of `ATTACKS`; "nominal" is none.
    """

    scenario: Scenario
    attack: str

    @property
    def name(self) -> str:
        """For tables and rows."""
        return f"{self.scenario.name}, {ATTACKS[self.attack]}"


ATTACKS = {
    "nominal": "no attack",
    "random": "random noise",
    "algorithm1": "Algorithm 1",
    "projected": "projected gradient",
    "tracking": "projected gradient at the tracking error",
    "query": f"black box, {QUERIES} queries",
    "policy": "a policy trained against these weights",
}
TRIALS = (
    *(Trial(scenario, "nominal") for scenario in SCENARIOS),
    *(Trial(FIGURE, attack) for attack in list(ATTACKS)[1:]),
    *(Trial(scenario, "algorithm1") for scenario in (AWAY, RANDOM_START, PUSHED, CHANGING)),
)
QUICK_TRIALS = TRIALS[: len(SCENARIOS)] + tuple(t for t in TRIALS if t == Trial(FIGURE, "algorithm1"))
Maker = Callable[[dpc.DPCLayer, Any, attacks.Budget], Any]


def makers(case: Case) -> dict[str, Maker]:
    """Return what makes each attack from a layer, the attacker's cost and the budget; the policy is made apart."""
    judged = torch.zeros(len(case.Q), dtype=torch.float64)
    judged[case.channels] = 1.0

    def tracking(layer: dpc.DPCLayer, cost: Any, budget: attacks.Budget) -> Any:
        assert isinstance(layer.data, dpc.HankelData)
        error = attacks.TrackingError(layer.data, torch.diag(judged))
        return attacks.ProjectedGradientAttack(layer, error, budget, restarts=2)  # no gradient on the reference

    return {
        "nominal": lambda *problem: None,
        "random": lambda layer, cost, budget: attacks.RandomAttack(budget),
        "algorithm1": attacks.LinearizedAttack,
        "projected": lambda *problem: attacks.ProjectedGradientAttack(*problem, restarts=2),
        "tracking": tracking,
        "query": lambda layer, cost, budget: attacks.RandomSearchAttack(layer, cost, budget, queries=QUERIES),
    }


def run_trials(
    case: Case, plant: Any, layer: dpc.DPCLayer, seed: int, trials: Sequence[Trial] = TRIALS
) -> list[dict[str, Any]]:
    """Return one row for each trial of one recording; every attacker knows the layer."""
    budget, rows, make = attacks.RelativeBall(case.rho), [], makers(case)
    for trial in trials:
        if trial.attack == "policy":
            attack = trained_policy(case, plant, layer, seed, budget)
        else:
            attack = make[trial.attack](layer, case.target(), budget)
        run = case.summed_up(case.simulate(plant, layer, seed, attack, trial.scenario))
        rows.append({"trial": trial.name, "seed": seed, **run._asdict()})
    return rows


def trained_policy(case: Case, plant: Any, layer: dpc.DPCLayer, seed: int, budget: attacks.Budget) -> Any:
    """Train a network in place of Algorithm 1, to lower the attacker's cost on windows of runs without an attack."""
    t_ini, horizon = case.t_ini, case.horizon
    log = case.simulate(plant, layer, seed + 50, None)  # another noise than in the trial
    steps = torch.arange(t_ini, case.steps, POLICY.every)
    past, ahead = steps[:, None] + torch.arange(-t_ini, 0), steps[:, None] + torch.arange(horizon)
    y_ref, u_ref = case.references(case.steps + horizon)
    u_ref = torch.zeros(case.steps + horizon, layer.data.n_u, dtype=torch.float64) if u_ref is None else u_ref
    windows = (log.u[past], log.y[past], y_ref[ahead], u_ref[ahead], steps)
    wanted = case.wanted_inputs()
    assert isinstance(layer.data, dpc.HankelData)
    policy = attacks.AttackPolicy.for_windows(
        layer.data,
        windows,
        hidden=POLICY.hidden,
        context=wanted,
        generator=torch.Generator().manual_seed(POLICY.seed),
    )
    attack, generator = attacks.PolicyAttack(policy, budget), torch.Generator().manual_seed(POLICY.seed)
    optimiser = torch.optim.Adam(policy.parameters(), lr=POLICY.rate)
    for _ in range(POLICY.iterations):
        chosen = torch.randint(len(steps), (POLICY.batch,), generator=generator)
        u_ini, y_ini, y, u, k = (part[chosen] for part in windows)
        p = attack(u_ini, y_ini, y_ref=y, u_ref=u, step=k)
        plan = layer(u_ini, y_ini + p, y_ref=y, u_ref=u, on_failure="nan").u
        target = wanted[(k[:, None] + torch.arange(horizon)).clamp_max(len(wanted) - 1)]
        loss = 0.5 * (plan - target).square().sum((-2, -1)).nanmean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return attacks.PolicyAttack(policy.requires_grad_(False), budget)


# --- the verdict ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """Before and after in one trial: errors of each seed [m], and the interval of their paired difference."""

    trial: str
    before: Array
    after: Array
    change: bootstrap.Interval

    @property
    def says(self) -> str:
        """Return better or worse where the interval leaves no doubt and the change is worth the name, else same."""
        least = max(SAME * self.before.mean(), TINY)
        if self.change.high < 0 and self.change.value < -least:
            return "better"
        return "worse" if self.change.low > 0 and self.change.value > least else "same"

    @property
    def may_be_worse(self) -> bool:
        """Whether the interval reaches a worsening that is worth the name."""
        return self.change.high > max(SAME * self.before.mean(), TINY)


def verdicts(rows: list[dict[str, Any]], case: str, before: str, after: str) -> list[Verdict]:
    """Return the verdict of every trial, from rows with case, point, trial, seed and error."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    for row in rows:
        if row["case"] == case:
            found.setdefault((row["point"], row["trial"]), {})[int(row["seed"])] = float(row["error"])
    result = []
    for trial in TRIALS:
        old, new = found[before, trial.name], found[after, trial.name]
        seeds = sorted(set(old) & set(new))
        a, b = (np.array([errors[seed] for seed in seeds]) for errors in (old, new))
        result.append(Verdict(trial.name, a, b, bootstrap.difference(b, a)))
    return result


def dominates(found: list[Verdict]) -> bool:
    """Return whether no trial may be worse and at least one is better."""
    return not any(v.may_be_worse for v in found) and any(v.says == "better" for v in found)
