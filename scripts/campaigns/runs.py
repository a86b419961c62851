"""What the workers of a campaign run: some rows that share a recording, in one process."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import torch

import torch_dpc as dpc
from scripts.campaigns.config import RunConfig
from scripts.experiments.all_cases import CASES
from scripts.experiments.case import Case

CASE_OF = {"masses": "held", "masses_moving": "moving", "quadrotor": "circle"}


def run_chunk(configs: list[RunConfig]) -> list[dict[str, Any]]:
    """Return the row of every run; a row depends on its own configuration alone."""
    torch.set_num_threads(1)
    plant_name, seed = configs[0].plant, configs[0].seed
    assert all((c.plant, c.seed) == (plant_name, seed) for c in configs)
    with CASES[CASE_OF[plant_name]].system() as plant:
        data = CASES[CASE_OF[plant_name]].data(plant, seed)
        return [run(plant, data, config) for config in configs]


def run(plant: Any, data: dpc.HankelData, config: RunConfig) -> dict[str, Any]:
    """Run one row in closed loop."""
    case = CASES[CASE_OF[config.plant]]
    steps, replan_every = config.steps or case.steps, config.replan_every or case.replan_every
    case = replace(case, steps=steps, replan_every=replan_every)
    chosen = {name: getattr(config, name) for name in ("lambda_g", "lambda_s", "Q", "R")}
    weights = case.paper()._replace(**{name: value for name, value in chosen.items() if value is not None})
    layer = case.layer(data, weights)
    log = case.simulate(plant, layer, config.seed, attack_of(config, case, layer))
    error = case.error(log)
    plans = slice(None, None, case.replan_every)
    return {
        "id": config.id,
        **asdict(config),
        **weights._asdict(),
        "steps": case.steps,
        "replan_every": case.replan_every,
        "error": float(error.mean()),
        "error_second_half": float(error[case.steps // 2 :].mean()),
        "largest": float(error.max()),
        "input": float(torch.linalg.vector_norm(log.u, dim=1).mean()),
        "perturbation": float(torch.linalg.vector_norm(log.p[plans], dim=(1, 2)).mean()),
        "unsolved": int((log.status[plans] != dpc.Status.SOLVED).sum()),
        "crashed": bool(getattr(plant, "down", [False])[-1]),
    }


def attack_of(config: RunConfig, case: Case, layer: dpc.DPCLayer) -> Any:
    """Return the attack of a row; it knows the weights."""
    if config.attack == "none":
        return None
    budget = dpc.attacks.RelativeBall(config.rho)
    if config.attack == "random":
        return dpc.attacks.RandomAttack(budget)
    kinds = {
        "algorithm1": dpc.attacks.LinearizedAttack,
        "projected_gradient": dpc.attacks.ProjectedGradientAttack,
        "frank_wolfe": dpc.attacks.FrankWolfeAttack,
    }
    return kinds[config.attack](layer, case.target(), budget)
