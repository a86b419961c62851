"""The searches that tune_regularization.py compares: by the gradient, and by Optuna at the same budget."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from scripts.experiments.all_cases import CASES
from scripts.experiments.case import Weights
from scripts.regularization.objectives import objectives, start
from torch_dpc import tuning

STEPS, RATE = 60, 0.4  # of Adam
LIMIT = math.log(1e3)  # how far each logarithm may move
ATTACKED_WEIGHTS = (0.3, 1.0, 3.0)
RIDGE_SIZE = 1e-2  # of the spread of each output, what study_noise.py recommends
SAMPLES = 150  # evaluations of a guarded search by samples
ONLY_LAMBDAS, GUARDED, RIDGED, SAMPLED, REFINED = "lambdas", "guarded", "ridged", "sampled", "refined"
METHODS = {
    GUARDED: "gradient, guarded",
    SAMPLED: f"Optuna, TPE, guarded, {SAMPLES} evaluations",
    REFINED: "the same, then the gradient",
    RIDGED: "gradient, guarded, on data with the ridge",
    "attack": "gradient through the attack",
    "danskin": "gradient with the attack held (Danskin)",
    ONLY_LAMBDAS: "gradient, lambda_g and lambda_s only",
    "tpe": "Optuna, TPE, at the gradient's processor time",
}


class Found(NamedTuple):
    """What one search found, and its course."""

    method: str
    attacked_weight: float
    weights: Weights
    history: list[dict[str, float]]  # evaluation, seconds of processor time, nominal, attacked, total

    @property
    def best(self) -> dict[str, float]:
        """The row of the best evaluation."""
        return min(self.history, key=lambda row: row["total"])

    @property
    def seconds(self) -> float:
        """Processor time of the whole search."""
        return self.history[-1]["seconds"]


def searches(case_name: str, attacked_weight: float, methods: Sequence[str], steps: int = STEPS) -> list[Found]:
    """Run several searches in turn: "tpe" has the time of the first, `REFINED` starts at the point of the last."""
    torch.set_num_threads(1)
    case = CASES[case_name]
    found: list[Found] = []
    with case.system() as plant:
        for method in methods:
            weights = case.paper() if method == ONLY_LAMBDAS else start(case)
            through = "danskin" if method == "danskin" else "attack"
            guard: dict[str, Any] = {
                "guarded": method in (GUARDED, RIDGED, SAMPLED, REFINED),
                "ridge": RIDGE_SIZE if method == RIDGED else 0.0,
            }
            goals = objectives(case, plant, weights, **guard, attacked_weight=attacked_weight, through=through)
            if method == "tpe":
                scales, history = by_optuna(goals, seconds=found[0].seconds)
            elif method == SAMPLED:
                scales, history = by_optuna(goals, evaluations=SAMPLES if steps == STEPS else steps)
            elif method == REFINED:
                scales, history = by_gradient(goals, scales, steps)
            else:
                scales = tuning.WeightScales(goals[0].layer)
                for free in (scales.Q, scales.R):
                    free.requires_grad_(method != ONLY_LAMBDAS)
                scales, history = by_gradient(goals, scales, steps)
            tuned = Weights.of(scales.apply_to(goals[0].layer))
            found.append(Found(method, attacked_weight, tuned, history))
    return found


def by_gradient(
    objectives: list[tuning.RobustObjective], start: tuning.WeightScales, steps: int
) -> tuple[tuning.WeightScales, list[dict[str, float]]]:
    """Tune by the gradient, and return the best scales and the course."""
    course = _Course()
    result = tuning.tune(objectives, steps=steps, lr=RATE, scales=start, limit=LIMIT, progress=course.add)
    return result.scales, course.rows


def by_optuna(
    objectives: list[tuning.RobustObjective], seconds: float = math.inf, evaluations: int | None = None
) -> tuple[tuning.WeightScales, list[dict[str, float]]]:
    """Tune by Optuna's TPE for so much processor time, its own included, or so many evaluations, from the same start.

    The first logarithm of R is left at 0, which takes the common factor out of the search.
    """
    try:
        import optuna
    except ImportError as error:
        raise ImportError("the comparison with Optuna needs it: pip install '.[tuning]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    scales = tuning.WeightScales(objectives[0].layer)
    names = [f"s{i}" for i in range(len(scales.vector))]
    pinned = 2 + objectives[0].layer.data.n_y
    course = _Course()

    def set_to(params: dict[str, float]) -> None:
        vector = torch.tensor([params.get(name, 0.0) for name in names], dtype=torch.float64)
        torch.nn.utils.vector_to_parameters(vector, scales.parameters())

    def value(trial: Any) -> float:
        set_to({name: trial.suggest_float(name, -LIMIT, LIMIT) for i, name in enumerate(names) if i != pinned})
        with torch.no_grad():
            values = [objective(scales) for objective in objectives]
        mean = {k: torch.stack([v[k] for v in values]).mean().item() for k in ("nominal", "attacked", "total")}
        course.add({"step": trial.number, **mean})
        return mean["total"]

    def stop(study: Any, _trial: Any) -> None:
        if course.seconds() > seconds:
            study.stop()

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
    study.enqueue_trial({name: 0.0 for i, name in enumerate(names) if i != pinned})
    study.optimize(value, n_trials=evaluations, callbacks=[stop])
    set_to(study.best_params)
    return scales, course.rows


class _Course:
    """The rows of a search, with the processor time since it began."""

    def __init__(self) -> None:
        self.began = time.process_time()
        self.rows: list[dict[str, float]] = []

    def seconds(self) -> float:
        return time.process_time() - self.began

    def add(self, row: Any) -> None:
        kept = {"evaluation": row["step"], "seconds": self.seconds()}
        self.rows.append(kept | {name: row[name] for name in ("nominal", "attacked", "total")})
