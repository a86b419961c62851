"""The settings of tune_regularization.py and campaign.py: Figures 3 and 4, and the masses on a sinusoid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

import figure3_masses
import figure4_quadrotor
import torch_dpc as dpc
from _case import Case, Weights

NOISE, START = 0.01, 0.1  # [m, m/s]: standard deviations, of the noise on each output and of the start
AMPLITUDE, PERIOD = 0.5, 10.0  # [m], [s]


class MovingTarget:
    """psi(u) = 1/2 |u - target|^2 for a batch of plans that begin at different steps of a run."""

    def __init__(self, trajectory: Tensor, starts: Tensor):
        self.trajectory, self.starts = trajectory, starts

    def at(self, step: int) -> Callable[[dpc.DPCSolution], Tensor]:
        """Return the cost of the plans made `step` steps after each start."""

        def psi(plan: dpc.DPCSolution) -> Tensor:
            rows = self.starts[:, None] + step + torch.arange(plan.u.shape[-2])
            return 0.5 * (plan.u - self.trajectory[rows.clamp_max(len(self.trajectory) - 1)]).square().sum((-2, -1))

        return psi


class Masses(Case):
    """Figure 3: the masses start where they are to stay, noise-free."""

    plant, name, title = "masses", "held", "masses, started at the reference (Figure 3)"
    rho, rhos = figure3_masses.RHO[-1], figure3_masses.RHO
    channels, plans, steps = [0], 10, figure3_masses.STEPS
    other_target = torch.tensor([-1.0, 1.0])
    experiment = figure3_masses
    noise = 0.0

    @contextmanager
    def system(self) -> Iterator[Any]:
        yield dpc.systems.OscillatingMasses(noise=self.noise)

    def record(self, plant: Any, seed: int) -> tuple[Tensor, Tensor]:
        plant.generator = torch.Generator().manual_seed(seed)
        return dpc.collect(plant, figure3_masses.SAMPLES, generator=plant.generator)

    def simulate(self, plant: Any, layer: dpc.DPCLayer, seed: int, attack: Any) -> dpc.ClosedLoopLog:
        f = figure3_masses
        generator = torch.Generator().manual_seed(1000 + seed)
        state = self.state(generator)
        plant.generator = generator
        y_ref, u_ref = self.references(self.steps + f.HORIZON)
        return dpc.simulate(
            plant,
            dpc.DPCController(layer, self.replan_every, on_failure="hold"),
            y_ref,
            steps=self.steps,
            u_ref=u_ref,
            attack=attack,
            generator=torch.Generator().manual_seed(1000 + seed),
            reset={"state": state},
            u_warmup=u_ref[0],
        )

    def state(self, generator: torch.Generator) -> Tensor:
        return figure3_masses.Y_REF

    def target(self) -> dpc.attacks.TargetInput:
        return dpc.attacks.TargetInput(trajectory=figure3_masses.target(0.1))

    def windows_target(self, starts: Tensor) -> MovingTarget:
        angle = 0.1 * torch.arange(2 * self.steps + figure3_masses.HORIZON, dtype=torch.float64)
        return MovingTarget(angle.sin()[:, None].expand(-1, 2), starts)

    def references(self, steps: int) -> tuple[Tensor, Tensor | None]:
        return figure3_masses.Y_REF.double().expand(steps, -1), figure3_masses.U_REF.double().expand(steps, -1)


class MovingMasses(Masses):
    """The masses follow a sinusoid from wherever they start, and every measurement, recorded or not, has noise."""

    name, title = "moving", f"masses on a sinusoid, noise of {NOISE:g} m"
    channels = [0, 1]
    noise = NOISE

    def state(self, generator: torch.Generator) -> Tensor:
        return START * torch.randn(4, dtype=torch.float64, generator=generator)

    def references(self, steps: int) -> tuple[Tensor, Tensor]:
        angle = 2 * math.pi / PERIOD * 0.1 * torch.arange(steps, dtype=torch.float64)[:, None]
        position = AMPLITUDE * angle.sin().expand(-1, 2)
        speed = 2 * math.pi / PERIOD * AMPLITUDE * angle.cos().expand(-1, 2)
        return torch.cat([position, speed], dim=1), torch.zeros(steps, 2, dtype=torch.float64)


class Quadrotor(Case):
    """Figure 4: the circle."""

    plant, name, title = "quadrotor", "circle", "quadrotor on the circle (Figure 4)"
    rho, rhos = figure4_quadrotor.RHO[-1], figure4_quadrotor.RHO
    channels, plans, steps = [0, 1, 2], 8, figure4_quadrotor.STEPS
    other_target = torch.tensor([1.0, 0.0, 0.0])
    experiment = figure4_quadrotor
    #: The paper's weight of the attitude is 0, whose logarithm cannot move: tuning starts from this one.
    ATTITUDE = 1.0  # [1/rad^2], beside 10 / m^2 on the position

    @contextmanager
    def system(self) -> Iterator[Any]:
        with dpc.systems.Quadrotor() as vehicle:
            yield figure4_quadrotor.LiesWhereItCrashed(vehicle)

    def record(self, plant: Any, seed: int) -> tuple[Tensor, Tensor]:
        return figure4_quadrotor.record(plant, seed)

    def start(self) -> Weights:
        paper = self.paper()
        return paper._replace(Q=(*paper.Q[:3], *3 * (self.ATTITUDE,)))

    def sets(self) -> dict[str, dpc.Box]:
        f = figure4_quadrotor
        return {"u_set": dpc.Box(-f.U_MAX, f.U_MAX), "y_set": dpc.Box(f.Y_MIN, f.Y_MAX)}

    def simulate(self, plant: Any, layer: dpc.DPCLayer, seed: int, attack: Any) -> dpc.ClosedLoopLog:
        f = figure4_quadrotor
        return dpc.simulate(
            plant,
            dpc.DPCController(layer, self.replan_every, on_failure="hold"),
            f.circle(self.steps + f.HORIZON),
            steps=self.steps,
            attack=attack,
            generator=torch.Generator().manual_seed(1000 + seed),
            reset={"position": f.circle(1)[0, :3]},
        )

    def target(self) -> dpc.attacks.TargetInput:
        return dpc.attacks.TargetInput(figure4_quadrotor.TARGET)

    def references(self, steps: int) -> tuple[Tensor, Tensor | None]:
        return figure4_quadrotor.circle(steps), None


CASES: dict[str, Case] = {case.name: case for case in (Masses(), MovingMasses(), Quadrotor())}
