"""What `study_transfer.py` attacks: a controller, its attacker's recording, held-out windows, and surrogates."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

import figure3_masses
import figure4_quadrotor
import torch_dpc as dpc
from _common import ATTACK_SEED

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
    "Q / 100": {"Q": 0.01},
    "Q / 10": {"Q": 0.1},
    "Q x 10": {"Q": 10.0},
    "Q x 100": {"Q": 100.0},
    "past of 4 for 6": {"t_ini": 4},
    "all of it off": {"other": True, "noise": 1e-2, "horizon": 20, "lambda_s": 0.1, "lambda_g": 10.0, "Q": 0.5},
}


class Plant(NamedTuple):
    """A controller under attack, and what an attacker may know of it."""

    settings: Any  # the module of its figure
    own: tuple[Tensor, Tensor]  # the controller's recording
    other: tuple[Tensor, Tensor]  # the attacker's
    windows: tuple[Tensor, Tensor]  # held out, (B, t_ini, n)
    refs: dict[str, Tensor]
    cost: Any
    rho: float


def load(name: str, seed: int, every: int) -> Plant:
    """Record everything that one seed needs."""
    settings = {"masses": figure3_masses, "quadrotor": figure4_quadrotor}[name]
    seeds = (seed, seed + OTHER_SEED, seed + HELD_OUT_SEED)
    if name == "masses":
        plant = dpc.systems.OscillatingMasses()
        sources = [torch.Generator().manual_seed(s) for s in seeds]
        own, other, held_out = (dpc.collect(plant, settings.SAMPLES, generator=source) for source in sources)
        cost = dpc.attacks.TargetInput(trajectory=settings.target(plant.dt))
        refs = {"y_ref": settings.Y_REF, "u_ref": settings.U_REF}
    else:
        with dpc.systems.Quadrotor() as quadrotor:
            flights = settings.LiesWhereItCrashed(quadrotor)
            own, other, held_out = (settings.record(flights, s) for s in seeds)
        cost, refs = dpc.attacks.TargetInput(settings.TARGET), {"y_ref": settings.circle(settings.HORIZON)}
    starts = range(0, settings.SAMPLES - settings.T_INI, every)
    windows = tuple(torch.stack([w[k : k + settings.T_INI] for k in starts]) for w in held_out)
    return Plant(settings, own, other, windows, refs, cost, settings.RHO[-1])


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
    s = plant.settings
    t_ini, horizon = t_ini or s.T_INI, horizon or s.HORIZON
    u, y = plant.other if other else plant.own
    y = y + noise * y.std(0) * torch.randn(y.shape, dtype=y.dtype, generator=torch.Generator().manual_seed(seed))
    samples = len(u) if n_g is None else n_g + t_ini + horizon - 1
    return dpc.DPCLayer(
        dpc.HankelData.from_trajectories(u[:samples], y[:samples], t_ini=t_ini, horizon=horizon),
        Q=Q * s.Q,
        R=s.R,
        lambda_g=lambda_g * s.LAMBDA_G,
        lambda_s=lambda_s * s.LAMBDA_S,
        u_set=dpc.Box(-s.U_MAX, s.U_MAX),
        y_set=dpc.Box(getattr(s, "Y_MIN", -s.Y_MAX), s.Y_MAX),
    )


def closed_loop(plant: Plant, victim: dpc.DPCLayer, attack: Any, seed: int) -> tuple[float, bool]:
    """Return the mean error of a run of the plant's figure [m], and whether the vehicle crashed.

    The error is that of the first mass, which is 0 without an attack, or of the quadrotor's position.
    """
    s = plant.settings
    options = {
        "steps": s.STEPS,
        "attack": attack,
        "generator": torch.Generator().manual_seed(ATTACK_SEED + seed),
    }
    controller = dpc.DPCController(victim, s.REPLAN_EVERY, on_failure="hold")
    if s is figure3_masses:
        options |= {"u_ref": s.U_REF, "reset": {"state": s.Y_REF}, "u_warmup": s.U_REF}
        log = dpc.simulate(dpc.systems.OscillatingMasses(), controller, s.Y_REF, **options)
        return float((log.y - log.y_ref)[:, 0].abs().mean()), False
    with dpc.systems.Quadrotor() as quadrotor:
        options["reset"] = {"position": s.circle(1)[0, :3]}
        flight = s.LiesWhereItCrashed(quadrotor)
        log = dpc.simulate(flight, controller, s.circle(s.STEPS + s.HORIZON), **options)
        return float(torch.linalg.vector_norm((log.y - log.y_ref)[:, :3], dim=1).mean()), flight.down[-1]
