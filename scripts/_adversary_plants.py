"""What an adversary is trained and judged on: the experiments of Figures 3 and 4, and windows recorded in them.

Windows are those that a controller sees in closed loop without an attack, under random noise and under Algorithm 1, a
third each, every run at a rho of its own. Recordings, starts and noise of training have seeds of their own.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

import figure3_masses
import figure4_quadrotor
import torch_dpc as dpc
from _common import run_all
from torch_dpc import attacks

TRAINING, HELD_OUT = 100, 200  # seeds of the trained controller's data, and of what is kept back
START_SPREAD = 0.1  # [m, m/s]: standard deviation of the masses' initial states around rest
LAP = 250  # steps of a recorded flight, once around
LAPS_A_JOB = 6  # recorded by one process before the next job


@dataclass(frozen=True, eq=False)
class Windows:
    """What an attacker sees when a controller plans.

    Attributes:
        u_ini, y_ini: `(n, t_ini, n_u)`, `(n, t_ini, n_y)`.
        y_ref, u_ref: `(n, horizon, n)`, or `(horizon, n)` where all are the same.
        step: of the run, `(n,)`.
    """

    u_ini: Tensor
    y_ini: Tensor
    y_ref: Tensor
    u_ref: Tensor
    step: Tensor

    def __len__(self) -> int:
        return len(self.step)

    def __getitem__(self, index: Any) -> Windows:
        """Return some of the windows; references that all share are not indexed."""
        return Windows(**{k: v if v.ndim == 2 else v[index] for k, v in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def attacked_by(self, attack: Any, **options: Any) -> Tensor:
        """Return what an attack that takes a step for each sample adds."""
        return attack(self.u_ini, self.y_ini, y_ref=self.y_ref, u_ref=self.u_ref, **options)

    def plan(self, layer: dpc.DPCLayer, p: Tensor | float = 0.0) -> dpc.DPCSolution:
        """Return what the controller plans when p is added."""
        return layer(self.u_ini, self.y_ini + p, y_ref=self.y_ref, u_ref=self.u_ref)

    @staticmethod
    def joined(parts: list[Windows]) -> Windows:
        """Return all windows of several recordings; what is shared stays shared."""
        first = parts[0].tensors()
        whole = {k: v if v.ndim == 2 else torch.cat([part.tensors()[k] for part in parts]) for k, v in first.items()}
        return Windows(**{**whole, "step": torch.cat([part.step for part in parts])})


@functools.cache
def masses_layer(seed: int) -> dpc.DPCLayer:
    """Return the planning problem of Figure 3 on the recording of a seed."""
    f = figure3_masses
    recording = dpc.collect(dpc.systems.OscillatingMasses(), f.SAMPLES, generator=torch.Generator().manual_seed(seed))
    data = dpc.HankelData.from_trajectories(*recording, t_ini=f.T_INI, horizon=f.HORIZON)
    weights = {"Q": f.Q, "R": f.R, "lambda_g": f.LAMBDA_G, "lambda_s": f.LAMBDA_S}
    return dpc.DPCLayer(data, **weights, u_set=dpc.Box(-f.U_MAX, f.U_MAX), y_set=dpc.Box(-f.Y_MAX, f.Y_MAX))


@functools.cache
def quadrotor_layer(seed: int) -> dpc.DPCLayer:
    """Return the planning problem of Figure 4 on the recorded flight of a seed."""
    f = figure4_quadrotor
    with dpc.systems.Quadrotor() as quadrotor:
        return f.planner(*f.record(f.LiesWhereItCrashed(quadrotor), seed))


class Masses:
    """Figure 3: two masses held at 1 m; the attacker wants the input sin(t)."""

    name = "masses"
    layer = staticmethod(masses_layer)
    rhos = figure3_masses.RHO
    cost = attacks.TargetInput(trajectory=figure3_masses.target(0.1))
    context = cost.target
    settings = ("at rest", "disturbed")

    def __init__(self) -> None:
        self.plant = dpc.systems.OscillatingMasses()
        self.y_ref, self.u_ref = figure3_masses.Y_REF.double(), figure3_masses.U_REF.double()

    def starts(self, n: int, seed: int) -> Tensor:
        """Return initial states, `(n, 4)`: the first at rest, the others disturbed."""
        generator = torch.Generator().manual_seed(seed)
        disturbance = START_SPREAD * torch.randn(n, 4, dtype=torch.float64, generator=generator)
        disturbance[0] = 0.0
        return self.y_ref + disturbance

    def loop(self, layer: dpc.DPCLayer, attack: Any, starts: Tensor) -> tuple[Tensor, Windows]:
        """Run many closed loops at once, differentiably, as `dpc.simulate` runs one.

        Args:
            layer: of the controller.
            attack: with the call of every attack, on batches; None for none.
            starts: initial states, `(runs, 4)`.

        Returns:
            The true outputs, `(runs, steps, 4)`, and the windows of every step, one batch a step in turn.
        """
        f, A, B = figure3_masses, self.plant.A.mT, self.plant.B.mT
        x, us, ys, windows = starts, [], [], []
        refs = {"y_ref": self.y_ref.expand(f.HORIZON, -1), "u_ref": self.u_ref.expand(f.HORIZON, -1)}
        for k in range(-f.T_INI, f.STEPS):
            if k >= 0:
                u_ini, y_ini = torch.stack(us[-f.T_INI :], dim=1), torch.stack(ys[-f.T_INI :], dim=1)
                windows.append(Windows(u_ini, y_ini, **refs, step=torch.full((len(x),), k)))
                if k % f.REPLAN_EVERY == 0:
                    p = 0.0 if attack is None else attack(u_ini, y_ini, **refs, step=k)
                    plan = layer(u_ini, y_ini + p, **refs).u
            us.append(self.u_ref.expand(len(x), -1) if k < 0 else plan[:, k % f.REPLAN_EVERY])
            ys.append(x)
            x = x @ A + us[-1] @ B
        return torch.stack(ys[f.T_INI :], dim=1), Windows.joined(windows)

    def error(self, y: Tensor) -> Tensor:
        """Return the mean error of the first mass over each run, |y1 - 1 m|, `(runs,)` [m]."""
        return (y[..., 0] - self.y_ref[0]).abs().mean(-1)

    def record(self, seed: int, runs: int, workers: int, *, every_step: bool) -> Windows:
        """Return the windows of many runs, of every step or of those at which the controller plans."""
        layer, generator = self.layer(TRAINING), torch.Generator().manual_seed(seed)
        budget = attacks.RelativeBall(drawn(self.rhos, runs, generator))
        algorithm1, noise = attacks.LinearizedAttack(layer, self.cost, budget), attacks.RandomAttack(budget)
        kind = (torch.arange(runs) % 3)[:, None, None]

        def third_each(u_ini: Tensor, y_ini: Tensor, **call: Any) -> Tensor:
            worst, random = algorithm1(u_ini, y_ini, **call), noise(u_ini, y_ini, generator=generator)
            return torch.where(kind == 1, worst, torch.where(kind == 2, random, 0.0))

        _, windows = self.loop(layer, third_each, self.starts(runs, seed))
        return windows if every_step else windows[windows.step % figure3_masses.REPLAN_EVERY == 0]

    def target(self, step: Tensor) -> Tensor:
        """Return the inputs that the attacker wants of the plans made at these steps, `(n, horizon, n_u)`."""
        rows = step[:, None] + torch.arange(figure3_masses.HORIZON)
        return self.cost.target[rows.clamp_max(len(self.cost.target) - 1)]

    def run(self, setting: str, seed: int, make_attacks: Any) -> list[dict[str, Any]]:
        """Return the mean error of one held-out seed under every attack, as `dpc.simulate` has it.

        Args:
            setting: "at rest", Figure 3, or "disturbed", from a random initial state.
            seed: of the controller's recording, of the state and of the noise.
            make_attacks: (layer, cost, rhos) -> the name, rho and attack of every run.
        """
        f, layer = figure3_masses, self.layer(seed)
        state = self.y_ref if setting == self.settings[0] else self.starts(2, HELD_OUT + seed)[1]
        rows = []
        for name, rho, attack in make_attacks(layer, self.cost, self.rhos):
            log = dpc.simulate(
                self.plant,
                dpc.DPCController(layer, f.REPLAN_EVERY),
                self.y_ref,
                steps=f.STEPS,
                u_ref=self.u_ref,
                attack=attack,
                generator=torch.Generator().manual_seed(f.ATTACK_SEED + seed),
                reset={"state": state},
                u_warmup=self.u_ref,
            )
            rows.append({"attack": name, "rho": rho, "mean_error": float(self.error(log.y)), "failed": 0.0})
        return rows


class Quadrotor:
    """Figure 4: a quadrotor flies a circle; the attacker wants it to fly towards +y."""

    name = "quadrotor"
    layer = staticmethod(quadrotor_layer)
    rhos = figure4_quadrotor.RHO
    cost = attacks.TargetInput(figure4_quadrotor.TARGET.double())
    context = None
    settings = ("known controller", "unknown controller")

    def record(self, seed: int, runs: int, workers: int, *, every_step: bool) -> Windows:
        """Return the windows of many laps, of every step or of those at which the controller plans."""
        jobs = [(seed, tuple(range(first, min(first + LAPS_A_JOB, runs)))) for first in range(0, runs, LAPS_A_JOB)]
        windows = Windows.joined([w for part in run_all(record_laps, jobs, workers, "flights") for w in part])
        return windows if every_step else windows[windows.step % figure4_quadrotor.REPLAN_EVERY == 0]

    def target(self, step: Tensor) -> Tensor:
        """Return the inputs that the attacker wants of the plans made at these steps, `(horizon, n_u)`."""
        return self.cost.target.expand(figure4_quadrotor.HORIZON, -1)

    def run(self, setting: str, seed: int, make_attacks: Any) -> list[dict[str, Any]]:
        """Return the mean error of one held-out seed under every attack; arguments as for the masses.

        "known controller": the one of the training data, from a place on the circle that the seed draws. "unknown
        controller": the flight of Figure 4, planned on the seed's own recording.
        """
        known = setting == self.settings[0]
        layer = self.layer(TRAINING if known else seed)
        rows = []
        for name, rho, attack in make_attacks(layer, self.cost, self.rhos):
            generator = torch.Generator().manual_seed(figure4_quadrotor.ATTACK_SEED + seed)
            offset = place_on_circle(HELD_OUT + seed) if known else 0
            log, down = fly(layer, attack, offset, figure4_quadrotor.STEPS, generator)
            error = torch.linalg.vector_norm((log.y - log.y_ref)[:, :3], dim=1).mean()
            rows.append({"attack": name, "rho": rho, "mean_error": float(error), "failed": float(down.any())})
        return rows


PLANTS = {"masses": Masses, "quadrotor": Quadrotor}


def drawn(rhos: Any, n: int, generator: torch.Generator) -> Tensor:
    """Return n values of rho, `(n,)`."""
    return torch.tensor(rhos, dtype=torch.float64)[torch.randint(len(rhos), (n,), generator=generator)]


def place_on_circle(seed: int) -> int:
    """Return a step of the lap at which a flight begins."""
    return int(torch.randint(LAP, (1,), generator=torch.Generator().manual_seed(seed)))


def fly(layer: dpc.DPCLayer, attack: Any, offset: int, steps: int, generator: Any) -> tuple[dpc.ClosedLoopLog, Tensor]:
    """Return the log of a flight that begins at rest at a place on the circle, and when the vehicle is down."""
    f = figure4_quadrotor
    reference = f.circle(offset + steps + f.HORIZON)[offset:]
    with dpc.systems.Quadrotor() as quadrotor:
        plant = f.LiesWhereItCrashed(quadrotor)
        controller = dpc.DPCController(layer, f.REPLAN_EVERY, on_failure="hold")
        run = {"attack": attack, "generator": generator, "reset": {"position": reference[0, :3]}}
        log = dpc.simulate(plant, controller, reference, steps=steps, **run)
        return log, torch.tensor(plant.down[f.T_INI - 1 : -1])


def record_laps(seed: int, laps: tuple[int, ...]) -> list[Windows]:
    """Return the windows of some laps of the training controller, until the vehicle is down."""
    f, plant = figure4_quadrotor, Quadrotor()
    layer, recorded = plant.layer(TRAINING), []
    for lap in laps:
        generator = torch.Generator().manual_seed(1000 * seed + lap)
        budget = attacks.RelativeBall(float(drawn(f.RHO, 1, generator)))
        kinds = (None, attacks.LinearizedAttack(layer, plant.cost, budget), attacks.RandomAttack(budget))
        offset = int(torch.randint(LAP, (1,), generator=generator))
        log, down = fly(layer, kinds[lap % 3], offset, LAP, generator)
        steps = torch.arange(f.T_INI, int(down.long().argmax()) if down.any() else LAP)
        past, ahead = steps[:, None] + torch.arange(-f.T_INI, 0), steps[:, None] + torch.arange(f.HORIZON)
        reference = f.circle(offset + LAP + f.HORIZON)[offset:]
        u_ref = torch.zeros(f.HORIZON, 3, dtype=torch.float64)
        recorded.append(Windows(log.u[past], log.y[past], reference[ahead], u_ref, steps))
    return recorded
