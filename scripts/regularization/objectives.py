"""What tuning minimises: one objective for each training recording, on windows of closed-loop runs.

The runs start on the reference, away from it and at random, are pushed, and change their reference: weights that no
longer control cost much in most of them. The sum of the costs without and under attack still allows to pay for
robustness with tracking. `GuardedObjective` puts a price on every scenario that costs more than the paper's weights do.

Four kinds of recordings have seeds far apart: those tuned on, those behind the predictor that judges plans, those by
which one point is chosen, and the held-out ones by which it is judged.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.experiments.case import Case, Weights
from scripts.experiments.masses import Masses, MovingTarget
from scripts.experiments.scenario import FIGURE, RANDOM_START, SCENARIOS
from scripts.shared.statistics import NOMINAL, POISON
from torch_dpc import tuning

TRAINING, PREDICTOR, VALIDATION = (100, 101, 102), (200, 201, 202, 203), (110, 111, 112, 113)
HELD_OUT_FROM = 9100
WINDOW_EVERY = 60  # steps between the windows that are cut from a run
ATTACKED = (FIGURE, RANDOM_START)  # scenarios whose runs under attack give windows too
PARTS = len(SCENARIOS) + len(ATTACKED)  # of the windows, of equal length
PLANS = {"masses": 10, "quadrotor": 8}  # of a run in the objective, `replan_every` steps each
#: The paper's weight of the attitude is 0, whose logarithm cannot move: tuning starts from this one.
ATTITUDE = 1.0  # [1/rad^2], beside 10 / m^2 on the position
PRICE = 10.0  # of an excess in `GuardedObjective`: above any exchange of tracking for robustness seen (about 2)


class GuardedObjective(tuning.RobustObjective):
    """The sum of a `RobustObjective`, plus `PRICE` times what each scenario costs above the paper's weights.

    Only the cost without an attack is guarded. The excess has a kink at zero, so its minimum lies on the guard and not
    beyond it (an exact penalty).
    """

    allowed: Tensor  # cost of each part of the windows under the paper's weights, `(parts,)`

    def __call__(self, scales: tuning.WeightScales) -> dict[str, Tensor]:
        nominal, attacked = self.costs(scales)
        parts = nominal.reshape(len(self.allowed), -1).mean(1)
        excess = (parts - self.allowed).clamp_min(0.0).sum()
        total = nominal.mean() + self.attacked_weight * attacked.mean() + PRICE * excess
        return {"nominal": nominal.mean(), "attacked": attacked.mean(), "total": total}


def start(case: Case) -> Weights:
    """Return the weights at which tuning starts: the paper's, and `ATTITUDE` where they are 0."""
    paper = case.paper()
    return paper._replace(Q=tuple(q or ATTITUDE for q in paper.Q))


def objectives(
    case: Case, plant: Any, weights: Weights, *, ridge: float = 0.0, guarded: bool = False, **options: Any
) -> list[tuning.RobustObjective]:
    """Return one objective for each training recording, on windows of closed-loop runs with the paper's weights.

    Args:
        case: the experiment.
        plant: its system, open.
        weights: where tuning starts.
        ridge: size of the ridge in the data of the layers, relative to the spread of each output.
        guarded: whether no scenario without an attack may cost more than under the paper's weights.
        options: of `tuning.RobustObjective`.
    """
    predictor, recordings = _prepared(case, plant)
    kind, found = GuardedObjective if guarded else tuning.RobustObjective, []
    for data, y, windows, starts in recordings:
        run = {"psi": _windows_target(case, starts), "predictor": predictor, "cost": tuning.MeanError(case.channels)}
        run |= {"plans": PLANS[case.plant], "replan_every": case.replan_every}
        budget = dpc.attacks.RelativeBall(case.rho)
        ridged = data.with_ridge(ridge * y.std(0)) if ridge else data
        objective = kind(case.layer(ridged, weights), windows, budget, **run, **options)
        if isinstance(objective, GuardedObjective):
            paper = tuning.RobustObjective(case.layer(data), windows, budget, **run)
            with torch.no_grad():
                nominal, _ = paper.costs(tuning.WeightScales(paper.layer))
            objective.allowed = nominal.reshape(PARTS, -1).mean(1)
        found.append(objective)
    return found


@functools.cache
def _prepared(case: Case, plant: Any) -> Any:
    """Return the predictor that judges, and data, outputs, windows and starts of each training recording; made once."""
    recordings = [case.record(plant, seed) for seed in PREDICTOR]
    pooled = case.hankel(*map(list, zip(*recordings, strict=True)))
    training = []
    for seed in TRAINING:
        u, y = case.record(plant, seed)
        data = case.hankel(u, y)
        training.append((data, y, *_windows(case, plant, case.layer(data), seed)))
    return tuning.DataPredictor(pooled), training


def _windows(case: Case, plant: Any, layer: dpc.DPCLayer, seed: int) -> tuple[tuning.Windows, Tensor]:
    """Return windows from runs of every scenario, two of them under attack too, and the steps at which they begin."""
    first = slice(case.t_ini, case.steps, WINDOW_EVERY)
    steps = torch.arange(case.steps)[first]
    rows = steps[:, None] + torch.arange(PLANS[case.plant] * case.replan_every + case.horizon)
    past = steps[:, None] + torch.arange(-case.t_ini, 0)
    parts: list[tuple[Tensor, Tensor, Tensor, Tensor | None]] = []
    for scenario in SCENARIOS:
        y_ref, u_ref = case.references_in(scenario, int(rows.max()) + 1)
        for kind in (NOMINAL, POISON) if scenario in ATTACKED else (NOMINAL,):
            log = case.simulate(plant, layer, seed, case.attack(kind, case.rho, layer), scenario)
            parts.append((log.u[past], log.y[past], y_ref[rows], None if u_ref is None else u_ref[rows]))
    u_ini, y_ini, wanted, held = zip(*parts, strict=True)
    inputs = None if held[0] is None else torch.cat(held)
    windows = tuning.Windows(torch.cat(u_ini), torch.cat(y_ini), torch.cat(wanted), inputs)
    return windows, steps.repeat(len(parts))


def _windows_target(case: Case, starts: Tensor) -> Any:
    """Return what the paper's attacker wants of a batch of windows that start at different steps of a run."""
    if not isinstance(case, Masses):
        return case.target()
    return MovingTarget(replace(case, steps=2 * case.steps).wanted_inputs(), starts)
