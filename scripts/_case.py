"""A setting in closed loop: record a system, pose the planning problem, run it under an attack, cut runs into windows.

Four kinds of recordings have seeds far apart: those tuned on, those behind the predictor that judges plans, those by
which one point is chosen, and the held-out ones by which it is judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_dpc as dpc
from torch_dpc import tuning

TRAINING, PREDICTOR, VALIDATION = (100, 101, 102), (200, 201, 202, 203), (110, 111, 112, 113, 114, 115)
HELD_OUT_FROM = 300
WINDOW_EVERY = 50  # steps between the windows that are cut from a run


class Run(NamedTuple):
    """One run in closed loop: what Figures 3 and 4 count as its error [m], and plans without a solution."""

    error: float
    largest: float
    unsolved: int


class Weights(NamedTuple):
    """lambda_g, lambda_s and the diagonals of Q and R."""

    lambda_g: float
    lambda_s: float
    Q: tuple[float, ...]
    R: tuple[float, ...]

    @staticmethod
    def of(layer: dpc.DPCLayer) -> Weights:
        """Read them off a layer that `tuning` made."""
        Q, R = layer.Q.diagonal().tolist(), layer.R.diagonal().tolist()
        return Weights(float(layer.lambda_g), float(layer.lambda_s), tuple(Q), tuple(R))


class Case:
    """One setting of a plant.

    Attributes:
        plant: "masses" or "quadrotor".
        name, title: of the setting.
        rho: of the attack that is tuned against.
        rhos: the paper's.
        channels: whose error counts.
        plans: of a run in the objective, `replan_every` steps each.
        steps: of a run in closed loop.
        replan_every: steps of a plan that are applied.
        other_target: an input [N, m/s] that an attacker wants against whom nothing was tuned.
    """

    plant: str
    name: str
    title: str
    rho: float
    rhos: tuple[float, ...]
    channels: list[int]
    plans: int
    steps: int
    replan_every: int = 10
    other_target: Tensor
    experiment: Any

    def record(self, plant: Any, seed: int) -> tuple[Tensor, Tensor]:
        """Return a recording, u and y."""
        raise NotImplementedError

    def paper(self) -> Weights:
        """Return the paper's weights."""
        f = self.experiment
        return Weights(f.LAMBDA_G, f.LAMBDA_S, tuple(f.Q.diagonal().tolist()), tuple(f.R.diagonal().tolist()))

    def start(self) -> Weights:
        """Return the weights at which tuning starts."""
        return self.paper()

    def sets(self) -> dict[str, dpc.Box]:
        """Return the bounds."""
        f = self.experiment
        return {"u_set": dpc.Box(-f.U_MAX, f.U_MAX), "y_set": dpc.Box(-f.Y_MAX, f.Y_MAX)}

    @contextmanager
    def system(self) -> Iterator[Any]:
        """Open the plant."""
        raise NotImplementedError
        yield

    def simulate(self, plant: Any, layer: dpc.DPCLayer, seed: int, attack: Any) -> dpc.ClosedLoopLog:
        """Run the plant under the layer."""
        raise NotImplementedError

    def target(self) -> dpc.attacks.TargetInput:
        """Return what the paper's attacker wants."""
        raise NotImplementedError

    def windows_target(self, starts: Tensor) -> Any:
        """Return the same for a batch of windows that start at different steps of a run."""
        return self.target()

    def references(self, steps: int) -> tuple[Tensor, Tensor | None]:
        """Return y_ref and u_ref, `(steps, n)`."""
        raise NotImplementedError

    # --- what all have in common -------------------------------------------------------------------------------------

    def layer(self, data: dpc.HankelData, weights: Weights) -> dpc.DPCLayer:
        """Return the planning problem with these weights."""
        Q, R = (torch.diag(torch.tensor(diagonal, dtype=torch.float64)) for diagonal in (weights.Q, weights.R))
        return dpc.DPCLayer(data, Q, R, weights.lambda_g, weights.lambda_s, **self.sets())

    def data(self, plant: Any, seed: int) -> dpc.HankelData:
        """Return the data of one recording."""
        sizes = {"t_ini": self.experiment.T_INI, "horizon": self.experiment.HORIZON}
        return dpc.HankelData.from_trajectories(*self.record(plant, seed), **sizes)

    def attack(self, kind: str, rho: float, layer: dpc.DPCLayer) -> Any:
        """Return an attack on a layer by name: its maker knows the weights."""
        budget = dpc.attacks.RelativeBall(rho)
        if kind == "nominal":
            return None
        if kind == "random":
            return dpc.attacks.RandomAttack(budget)
        cost = self.target() if kind == "algorithm1" else dpc.attacks.TargetInput(self.other_target)
        return dpc.attacks.LinearizedAttack(layer, cost, budget)

    def run(self, plant: Any, layer: dpc.DPCLayer, seed: int, kind: str, rho: float) -> Run:
        """Run in closed loop and sum up."""
        log = self.simulate(plant, layer, seed, self.attack(kind, rho, layer))
        error = torch.linalg.vector_norm((log.y - log.y_ref)[:, self.channels], dim=1)
        unsolved = (log.status != dpc.Status.SOLVED)[:: self.replan_every].sum()
        return Run(float(error.mean()), float(error.max()), int(unsolved))

    def objectives(self, plant: Any, start: Weights, **options: Any) -> list[tuning.RobustObjective]:
        """Return one objective for each training recording, on windows of closed-loop runs with the paper's weights."""
        predictor, recordings = self._prepared(plant)
        budget = dpc.attacks.RelativeBall(self.rho)
        return [
            tuning.RobustObjective(
                self.layer(data, start),
                windows,
                budget,
                psi=self.windows_target(starts),
                predictor=predictor,
                cost=tuning.MeanError(self.channels),
                plans=self.plans,
                replan_every=self.replan_every,
                **options,
            )
            for data, windows, starts in recordings
        ]

    def _prepared(self, plant: Any) -> Any:
        """Return the predictor that judges, and the data, windows and starts of each training recording; made once."""
        if not hasattr(self, "_ready"):
            recordings = [self.record(plant, seed) for seed in PREDICTOR]
            sizes = {"t_ini": self.experiment.T_INI, "horizon": self.experiment.HORIZON}
            pooled = dpc.HankelData.from_trajectories(*map(list, zip(*recordings, strict=True)), **sizes)
            training = []
            for seed in TRAINING:
                data = self.data(plant, seed)
                training.append((data, *self._windows(plant, self.layer(data, self.paper()), seed)))
            self._ready = tuning.DataPredictor(pooled), training
        return self._ready

    def _windows(self, plant: Any, layer: dpc.DPCLayer, seed: int) -> tuple[tuning.Windows, Tensor]:
        """Return windows from a run without and one under attack, and the steps at which their plans begin."""
        t_ini = self.experiment.T_INI
        kept = slice(t_ini, self.steps, WINDOW_EVERY)
        starts = torch.arange(self.steps)[kept]
        pieces = []
        for kind in ("nominal", "algorithm1"):
            log = self.simulate(plant, layer, seed, self.attack(kind, self.rho, layer))
            pieces += [(log.u[k - t_ini : k], log.y[k - t_ini : k]) for k in starts.tolist()]
        u_ini, y_ini = (torch.stack(part) for part in zip(*pieces, strict=True))
        starts = starts.repeat(2)
        length = self.plans * self.replan_every + self.experiment.HORIZON
        rows = starts[:, None] + torch.arange(length)
        y_ref, u_ref = self.references(int(rows.max()) + 1)
        return tuning.Windows(u_ini, y_ini, y_ref[rows], None if u_ref is None else u_ref[rows]), starts
