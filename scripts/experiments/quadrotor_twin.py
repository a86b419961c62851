"""The paper's quadrotor in torch: a thousand laps at once, with derivatives through the true dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.experiments.closed_loops import Windows
from scripts.experiments.quadrotor import Quadrotor

CHECKPOINT_EVERY = 10  # steps between two states that are kept for the backward pass


@dataclass(frozen=True)
class QuadrotorTwin(Quadrotor):
    """The experiment of Figure 4 on `TorchQuadrotor` in place of a linear model.

    Attributes:
        run_steps: length of a run; a lap has 250.
    """

    run_steps: int = 75

    def vehicles(self) -> dpc.systems.TorchQuadrotor:
        """Return the plant; a vehicle that touches the ground stays there."""
        return dpc.systems.TorchQuadrotor(self.physics_hz, ground="stop")

    def fly(
        self, layer: dpc.DPCLayer, attack: Any, starts: Tensor, steps: int, *, vehicles: Any = None, **options: Any
    ) -> dpc.ClosedLoopLog:
        """Return the log of runs from rest at some steps of the circle, all at once; crashed vehicles stay there."""
        circle = self.circle(self.lap + steps + self.horizon)
        references = circle[starts[:, None] + torch.arange(steps + self.horizon)]
        controller = dpc.DPCController(layer, self.replan_every, on_failure="hold")
        run = {"steps": steps, "attack": attack, "reset": {"position": references[:, 0, :3]}, **options}
        return dpc.simulate(vehicles or self.vehicles(), controller, references, **run)

    def replay(self, position: Tensor, commands: Tensor) -> Tensor:
        """Return the outputs, `(runs, steps, 6)`, of given commands `(runs, steps, 3)` from rest at a position."""
        plant, outputs = self.vehicles(), []
        y = plant.reset(position)
        for u in (torch.zeros_like(commands[:, 0]),) * self.t_ini:  # the first window, as `simulate` fills it
            y = plant.step(u)
        for u in commands.unbind(1):
            outputs.append(y)
            y = plant.step(u)
        return torch.stack(outputs, dim=1)

    def loop(self, layer: dpc.DPCLayer, attack: Any, starts: Tensor) -> tuple[Tensor, Windows]:
        """Fly runs of `run_steps` steps; the windows are those at which the controller planned."""
        log = self.fly(layer, attack, starts, self.run_steps, checkpoint_every=CHECKPOINT_EVERY)
        return log.y, self.windows(log)

    def mean_errors(self, outputs: Tensor, starts: Tensor) -> Tensor:
        """Return the mean distance from the circle over each run, `(runs,)` [m]."""
        steps = outputs.shape[-2]
        circle = self.circle(self.lap + steps)[starts[:, None] + torch.arange(steps)]
        return torch.linalg.vector_norm((outputs - circle)[..., :3], dim=-1).mean(-1)

    def windows(self, log: dpc.ClosedLoopLog) -> Windows:
        """Return what an attacker sees at the plans of some runs, the first ones after rest left out."""
        at = torch.arange(self.replan_every, log.steps - self.horizon, self.replan_every)
        past, ahead = at[:, None] + torch.arange(-self.t_ini, 0), at[:, None] + torch.arange(self.horizon)
        runs, u_ref = len(log), torch.zeros(self.horizon, self.n_u, dtype=torch.float64)
        u_ini, y_ini, y_ref = (x.detach().flatten(0, 1) for x in (log.u[:, past], log.y[:, past], log.y_ref[:, ahead]))
        return Windows(u_ini, y_ini, y_ref, u_ref, at.repeat(runs))

    @property
    def n_u(self) -> int:
        """Inputs."""
        return len(self.u_target)
