"""An adversary's experiment on the masses: Figure 3, and windows recorded in its closed loops.

Windows are those that a controller sees without an attack, under random noise and under Algorithm 1, a third each,
every run at a rho and from an initial state of its own.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

import figure3_masses
import torch_dpc as dpc
from _adversary_loop import HELD_OUT, TRAINING, Windows, closed_loops, drawn
from torch_dpc import attacks

START_SPREAD = 0.1  # [m, m/s]: standard deviation of the initial states around rest


@functools.cache
def masses_layer(seed: int) -> dpc.DPCLayer:
    """Return the planning problem of Figure 3 on the recording of a seed."""
    f = figure3_masses
    recording = dpc.collect(dpc.systems.OscillatingMasses(), f.SAMPLES, generator=torch.Generator().manual_seed(seed))
    data = dpc.HankelData.from_trajectories(*recording, t_ini=f.T_INI, horizon=f.HORIZON)
    weights = {"Q": f.Q, "R": f.R, "lambda_g": f.LAMBDA_G, "lambda_s": f.LAMBDA_S}
    return dpc.DPCLayer(data, **weights, u_set=dpc.Box(-f.U_MAX, f.U_MAX), y_set=dpc.Box(-f.Y_MAX, f.Y_MAX))


class Masses:
    """Figure 3: two masses held at 1 m; the attacker of the paper wants the input sin(t)."""

    name = "masses"
    layer = staticmethod(masses_layer)
    rhos = figure3_masses.RHO
    cost = attacks.TargetInput(trajectory=figure3_masses.target(0.1))
    context = cost.target
    settings = ("at rest", "disturbed")
    judged = torch.diag(torch.tensor([1.0, 0.0, 0.0, 0.0]))  # weights of the outputs in the error

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
        """Run closed loops from initial states, through the plant's own dynamics; see `closed_loops`."""
        f, A, B = figure3_masses, self.plant.A.mT, self.plant.B.mT
        refs = {"y_ref": self.y_ref.expand(f.HORIZON, -1), "u_ref": self.u_ref.expand(f.HORIZON, -1)}

        def step(us: list[Tensor], ys: list[Tensor]) -> Tensor:
            return ys[-1] @ A + us[-1] @ B

        us, ys = [self.u_ref.expand(len(starts), -1)] * f.T_INI, [starts]
        while len(ys) < f.T_INI:
            ys.append(step(us, ys))
        lengths = {"steps": f.STEPS, "replan_every": f.REPLAN_EVERY}
        return closed_loops(layer, attack, step, (us, ys), lambda k: refs, **lengths)

    def error(self, outputs: Tensor, starts: Tensor) -> Tensor:
        """Return the mean error of the first mass over each run, |y1 - 1 m|, `(runs,)` [m]."""
        return (outputs[..., 0] - self.y_ref[0]).abs().mean(-1)

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
            rows.append({"attack": name, "rho": rho, "mean_error": float(self.error(log.y, state)), "failed": 0.0})
        return rows
