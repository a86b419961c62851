"""An adversary's experiment on the quadrotor: laps of Figure 4's circle, and windows recorded on them.

Windows are those that a controller sees without an attack, under random noise and under Algorithm 1, a third each,
every lap at a rho and from a place on the circle of its own. PyBullet has no derivative; closed loops that have one run
on a linear model fitted to the controller's own recording, which is all that the attacker then needs.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

import figure4_quadrotor
import torch_dpc as dpc
from _adversary_loop import HELD_OUT, TRAINING, Windows, closed_loops, drawn
from _common import run_all
from torch_dpc import attacks

LAP = 250  # steps, once around
LAPS_A_JOB = 6  # flown by one process before the next job
LAGS = 6  # past steps that the linear model looks at


@functools.cache
def recording(seed: int) -> tuple[Tensor, Tensor]:
    """Return the commands and outputs of the random flight of a seed."""
    with dpc.systems.Quadrotor() as quadrotor:
        return figure4_quadrotor.record(figure4_quadrotor.LiesWhereItCrashed(quadrotor), seed)


@functools.cache
def quadrotor_layer(seed: int) -> dpc.DPCLayer:
    """Return the planning problem of Figure 4 on the recorded flight of a seed."""
    return figure4_quadrotor.planner(*recording(seed))


@functools.cache
def linear_model(seed: int) -> Tensor:
    """Return the least-squares fit of the next output to 1 and the last `LAGS` commands and outputs, `(1 + 54, 6)`."""
    u, y = recording(seed)
    n = len(y) - LAGS
    past = regressors([u[i : i + n] for i in range(LAGS)], [y[i : i + n] for i in range(LAGS)])
    size = past.abs().amax(0)
    return torch.linalg.lstsq(past / size, y[LAGS:], driver="gelsd").solution / size[:, None]


def regressors(us: list[Tensor], ys: list[Tensor]) -> Tensor:
    """Return what the model looks at, `(runs, 1 + 54)`."""
    return torch.cat([torch.ones_like(ys[-1][:, :1]), *us[-LAGS:], *ys[-LAGS:]], dim=1)


class Quadrotor:
    """Figure 4: a quadrotor flies a circle; the attacker of the paper wants it to fly towards +y."""

    name = "quadrotor"
    layer = staticmethod(quadrotor_layer)
    rhos = figure4_quadrotor.RHO
    cost = attacks.TargetInput(figure4_quadrotor.TARGET.double())
    context = None
    settings = ("known controller", "unknown controller")
    judged = torch.diag(torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))  # weights of the outputs in the error

    def starts(self, n: int, seed: int) -> Tensor:
        """Return the steps of the circle at which laps begin, `(n,)`."""
        return torch.randint(LAP, (n,), generator=torch.Generator().manual_seed(seed))

    def loop(self, layer: dpc.DPCLayer, attack: Any, starts: Tensor) -> tuple[Tensor, Windows]:
        """Run laps from rest on the linear model; see `closed_loops`."""
        f, model = figure4_quadrotor, linear_model(TRAINING)
        circle = f.circle(2 * LAP + f.HORIZON)
        u_ref = torch.zeros(f.HORIZON, 3, dtype=torch.float64)

        def references(k: int) -> dict[str, Tensor]:
            return {"y_ref": circle[starts[:, None] + k + torch.arange(f.HORIZON)], "u_ref": u_ref}

        def step(us: list[Tensor], ys: list[Tensor]) -> Tensor:
            return regressors(us, ys) @ model

        at_rest = ([u_ref[:1].expand(len(starts), -1)] * f.T_INI, [circle[starts]] * f.T_INI)
        return closed_loops(layer, attack, step, at_rest, references, steps=LAP, replan_every=f.REPLAN_EVERY)

    def error(self, outputs: Tensor, starts: Tensor) -> Tensor:
        """Return the mean distance from the circle over each lap, `(runs,)` [m]."""
        circle = figure4_quadrotor.circle(2 * LAP)[starts[:, None] + torch.arange(LAP)]
        return torch.linalg.vector_norm((outputs - circle)[..., :3], dim=-1).mean(-1)

    def record(self, seed: int, runs: int, workers: int, *, every_step: bool) -> Windows:
        """Return the windows of many laps in PyBullet, of every step or of those at which the controller plans."""
        jobs = [(seed, range(first, min(first + LAPS_A_JOB, runs))) for first in range(0, runs, LAPS_A_JOB)]
        windows = Windows.joined([lap for job in run_all(record_laps, jobs, workers, "laps") for lap in job])
        return windows if every_step else windows[windows.step % figure4_quadrotor.REPLAN_EVERY == 0]

    def target(self, step: Tensor) -> Tensor:
        """Return the inputs that the attacker wants of the plans made at any step, `(horizon, n_u)`."""
        return self.cost.target.expand(figure4_quadrotor.HORIZON, -1)

    def run(self, setting: str, seed: int, make_attacks: Any) -> list[dict[str, Any]]:
        """Return the mean error of one held-out seed's lap in PyBullet under every attack; arguments as for the masses.

        "known controller": the one of the training data, from a place on the circle that the seed draws. "unknown
        controller": Figure 4's start, planned on the seed's own recording.
        """
        known = setting == self.settings[0]
        layer, rows = self.layer(TRAINING if known else seed), []
        start = int(self.starts(1, HELD_OUT + seed)) if known else 0
        for name, rho, attack in make_attacks(layer, self.cost, self.rhos):
            generator = torch.Generator().manual_seed(figure4_quadrotor.ATTACK_SEED + seed)
            log, down = fly(layer, attack, start, generator)
            error = torch.linalg.vector_norm((log.y - log.y_ref)[:, :3], dim=1).mean()
            rows.append({"attack": name, "rho": rho, "mean_error": float(error), "failed": float(down.any())})
        return rows


def fly(layer: dpc.DPCLayer, attack: Any, start: int, generator: Any) -> tuple[dpc.ClosedLoopLog, Tensor]:
    """Return the log of a lap in PyBullet, from rest at a place on the circle, and when the vehicle is down."""
    f = figure4_quadrotor
    reference = f.circle(start + LAP + f.HORIZON)[start:]
    with dpc.systems.Quadrotor() as quadrotor:
        plant = f.LiesWhereItCrashed(quadrotor)
        controller = dpc.DPCController(layer, f.REPLAN_EVERY, on_failure="hold")
        run = {"attack": attack, "generator": generator, "reset": {"position": reference[0, :3]}}
        log = dpc.simulate(plant, controller, reference, steps=LAP, **run)
        return log, torch.tensor(plant.down[f.T_INI - 1 : -1])


def record_laps(seed: int, laps: range) -> list[Windows]:
    """Return the windows of some laps of the training controller, until the vehicle is down."""
    f, layer, recorded = figure4_quadrotor, quadrotor_layer(TRAINING), []
    for lap in laps:
        generator = torch.Generator().manual_seed(1000 * seed + lap)
        budget = attacks.RelativeBall(float(drawn(f.RHO, 1, generator)))
        kinds = (None, attacks.LinearizedAttack(layer, Quadrotor.cost, budget), attacks.RandomAttack(budget))
        start = int(torch.randint(LAP, (1,), generator=generator))
        log, down = fly(layer, kinds[lap % 3], start, generator)
        steps = torch.arange(f.T_INI, int(down.long().argmax()) if down.any() else LAP)
        past, ahead = steps[:, None] + torch.arange(-f.T_INI, 0), steps[:, None] + torch.arange(f.HORIZON)
        reference = f.circle(start + LAP + f.HORIZON)[start:]
        u_ref = torch.zeros(f.HORIZON, 3, dtype=torch.float64)
        recorded.append(Windows(log.u[past], log.y[past], reference[ahead], u_ref, steps))
    return recorded
