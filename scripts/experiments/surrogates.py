"""What `study_transfer.py` attacks: a controller, its attacker's recording, held-out windows, and surrogates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.experiments.case import Case
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor

CASES: dict[str, Case] = {"masses": Masses(), "quadrotor": Quadrotor()}
OTHER_SEED, HELD_OUT_SEED = 100, 200  # the attacker's recording and the held-out one, besides the controller's own

#: What the attacker holds in place of the controller's own: arguments of `surrogate`.
SURROGATES: dict[str, dict[str, Any]] = {
    "everything": {},
    "other recording": {"other": True},
    "other recording, 0.1 % noise": {"other": True, "noise": 1e-3},
    "other recording, 1 % noise": {"other": True, "noise": 1e-2},
    "other recording, 10 % noise": {"other": True, "noise": 1e-1},
    "half the windows (250)": {"n_g": 250},
    "150 windows": {"n_g": 150},
    "lambda_g / 100": {"lambda_g": 0.01},
    "lambda_g / 10": {"lambda_g": 0.1},
    "lambda_g x 10": {"lambda_g": 10.0},
    "lambda_g x 100": {"lambda_g": 100.0},
    "lambda_s / 100": {"lambda_s": 0.01},
    "lambda_s / 10": {"lambda_s": 0.1},
    "lambda_s x 10": {"lambda_s": 10.0},
    "lambda_s x 100": {"lambda_s": 100.0},
    "horizon 10 for 25": {"horizon": 10},
    "horizon 20 for 25": {"horizon": 20},
    "horizon 35 for 25": {"horizon": 35},
    "past of 4 for 6": {"t_ini": 4},
    "Q / 100": {"Q": 0.01},
    "Q / 10": {"Q": 0.1},
    "Q x 10": {"Q": 10.0},
    "Q x 100": {"Q": 100.0},
    "all of it off": {"other": True, "noise": 1e-2, "horizon": 20, "lambda_s": 0.1, "lambda_g": 10.0, "Q": 0.5},
}


class Plant(NamedTuple):
    """A controller under attack, and what an attacker may know of it."""

    case: Case
    own: tuple[Tensor, Tensor]  # the controller's recording
    other: tuple[Tensor, Tensor]  # the attacker's
    windows: tuple[Tensor, Tensor]  # held out, (B, t_ini, n)
    refs: dict[str, Tensor]
    cost: Any
    rho: float


def load(name: str, seed: int, every: int) -> Plant:
    """Record everything that one seed needs."""
    case = CASES[name]
    with case.system() as plant:
        own, other, held_out = (case.record(plant, s) for s in (seed, seed + OTHER_SEED, seed + HELD_OUT_SEED))
    y_ref, u_ref = case.references(case.horizon)
    refs = {"y_ref": y_ref} if u_ref is None else {"y_ref": y_ref, "u_ref": u_ref}
    starts = range(0, case.samples - case.t_ini, every)
    u_ini, y_ini = (torch.stack([w[k : k + case.t_ini] for k in starts]) for w in held_out)
    return Plant(case, own, other, (u_ini, y_ini), refs, case.target(), case.rho)


def surrogate(
    plant: Plant,
    *,
    other: bool = False,
    noise: float = 0.0,
    n_g: int | None = None,
    t_ini: int | None = None,
    horizon: int | None = None,
    Q: float = 1.0,
    lambda_g: float = 1.0,
    lambda_s: float = 1.0,
    seed: int = 0,
) -> dpc.DPCLayer:
    """Return the controller's planning problem, changed.

    The noise, drawn by the seed, is relative to each output's own spread; Q, lambda_g and lambda_s are factors.
    """
    t_ini, horizon = t_ini or plant.case.t_ini, horizon or plant.case.horizon
    u, y = plant.other if other else plant.own
    y = y + noise * y.std(0) * torch.randn(y.shape, dtype=y.dtype, generator=torch.Generator().manual_seed(seed))
    samples = len(u) if n_g is None else n_g + t_ini + horizon - 1
    case = replace(plant.case, t_ini=t_ini, horizon=horizon)
    paper = case.paper()
    weights = paper._replace(
        lambda_g=lambda_g * paper.lambda_g, lambda_s=lambda_s * paper.lambda_s, Q=tuple(Q * q for q in paper.Q)
    )
    return case.layer(case.hankel(u[:samples], y[:samples]), weights)


def closed_loop(plant: Plant, victim: dpc.DPCLayer, attack: Any, seed: int) -> tuple[float, bool]:
    """Return the mean error of a run of the plant's figure [m], and whether the vehicle crashed.

    The error is that of the first mass, which is 0 without an attack, or of the quadrotor's position.
    """
    with plant.case.system() as system:
        log = plant.case.simulate(system, victim, seed, attack)
        return float(plant.case.error(log).mean()), bool(getattr(system, "down", [False])[-1])
