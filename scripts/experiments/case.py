"""An experiment in closed loop: record a plant, pose the planning problem, run it under an attack.

A case is its numbers, one field each, and what is done with them. `dataclasses.replace(case, replan_every=1)` is the
same experiment with one number changed.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.experiments.scenario import FIGURE, Scenario
from scripts.shared.statistics import NOMINAL, POISON, RANDOM

ATTACK_SEED = 1000  # the noise of seed s is drawn from ATTACK_SEED + s, the same directions at every rho


class Run(NamedTuple):
    """One run in closed loop: its mean and largest error [m], and how many plans had no solution."""

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
        """Read them off a layer with diagonal weights."""
        Q, R = layer.Q.diagonal().tolist(), layer.R.diagonal().tolist()
        return Weights(float(layer.lambda_g), float(layer.lambda_s), tuple(Q), tuple(R))


@dataclass(frozen=True)
class Case:
    """One experiment on one plant; its subclasses set the numbers.

    Attributes:
        plant: "masses" or "quadrotor".
        name, title: of the experiment.
        t_ini, horizon: of the planning problem [steps].
        n_g: recorded windows.
        lambda_g, lambda_s: weights of the regularisation.
        Q, R: diagonals of the weights on outputs and inputs.
        u_max: the inputs stay within +-u_max [N, m/s].
        y_min, y_max: bounds on the outputs.
        replan_every: steps of a plan that are applied.
        steps: of a run in closed loop.
        rhos: sizes of the attack.
        channels: outputs whose distance to the reference is the error.
        other_target: an input that another attacker wants, against whom nothing was tuned.
    """

    plant: ClassVar[str]
    name: ClassVar[str]
    title: ClassVar[str]
    channels: ClassVar[list[int]]
    other_target: ClassVar[Tensor]

    t_ini: int
    horizon: int
    n_g: int
    lambda_g: float
    lambda_s: float
    Q: tuple[float, ...]
    R: tuple[float, ...]
    u_max: float
    y_min: tuple[float, ...]
    y_max: tuple[float, ...]
    replan_every: int
    steps: int
    rhos: tuple[float, ...]

    # --- what each experiment says of itself --------------------------------------------------------------------------

    def system(self) -> AbstractContextManager[Any]:
        """Open the plant."""
        raise NotImplementedError

    def record(self, plant: Any, seed: int, samples: int | None = None) -> tuple[Tensor, Tensor]:
        """Return a recording, u and y; by default `n_g` windows long."""
        raise NotImplementedError

    def references(self, steps: int) -> tuple[Tensor, Tensor | None]:
        """Return y_ref and u_ref, `(steps, n)`."""
        raise NotImplementedError

    def target(self) -> dpc.attacks.TargetInput:
        """Return what the paper's attacker wants."""
        raise NotImplementedError

    def simulate(
        self, plant: Any, layer: dpc.DPCLayer, seed: int, attack: Any, scenario: Scenario = FIGURE
    ) -> dpc.ClosedLoopLog:
        """Run the plant under the layer; the seed draws the noise, the start and the pushes of a scenario."""
        raise NotImplementedError

    def wanted_inputs(self) -> Tensor:
        """Return the inputs that the paper's attacker wants of each step, `(steps + horizon, n_u)`."""
        raise NotImplementedError

    def columns(self, plant: Any, log: dpc.ClosedLoopLog) -> dict[str, Any]:
        """Return a run's inputs and outputs by name, and where it has no plan."""
        raise NotImplementedError

    def middle(self) -> Tensor:
        """Return the output about which a changing reference is halved, `(n_y,)`."""
        raise NotImplementedError

    # --- what all have in common --------------------------------------------------------------------------------------

    def references_in(self, scenario: Scenario, steps: int) -> tuple[Tensor, Tensor | None]:
        """Return y_ref and u_ref of a scenario, `(steps, n)`."""
        return scenario.references(*self.references(steps), self.steps, self.middle())

    @property
    def rho(self) -> float:
        """The largest of the paper's rhos."""
        return self.rhos[-1]

    @property
    def samples(self) -> int:
        """The length of a recording with `n_g` windows."""
        return self.n_g + self.t_ini + self.horizon - 1

    def paper(self) -> Weights:
        """Return the paper's weights."""
        return Weights(self.lambda_g, self.lambda_s, self.Q, self.R)

    def hankel(self, u: Any, y: Any, *, ridge: float = 0.0) -> dpc.HankelData:
        """Return the data of one recording, or of a list of recordings; a ridge is relative to each output's spread."""
        return dpc.HankelData.from_trajectories(u, y, t_ini=self.t_ini, horizon=self.horizon, ridge=ridge)

    def data(self, plant: Any, seed: int) -> dpc.HankelData:
        """Return the data of the recording of a seed."""
        return self.hankel(*self.record(plant, seed))

    def layer(self, data: dpc.HankelData, weights: Weights | None = None, **options: Any) -> dpc.DPCLayer:
        """Return the planning problem on some data, by default with the paper's weights."""
        lambda_g, lambda_s, *diagonals = weights or self.paper()
        Q, R = (torch.diag(torch.tensor(diagonal, dtype=torch.float64)) for diagonal in diagonals)
        lower, upper = (torch.tensor(bound, dtype=torch.float64) for bound in (self.y_min, self.y_max))
        u_set, y_set = dpc.Box(-self.u_max, self.u_max), dpc.Box(lower, upper)
        return dpc.DPCLayer(data, Q, R, lambda_g, lambda_s, u_set, y_set, **options)

    def planner(self, seed: int) -> dpc.DPCLayer:
        """Return the planning problem on the recording of a seed; made once."""
        return _planner(self, seed)

    def error(self, log: dpc.ClosedLoopLog) -> Tensor:
        """Return the distance to the reference at every step [m]."""
        return torch.linalg.vector_norm((log.y - log.y_ref)[:, self.channels], dim=1)

    def attack(self, kind: str, rho: float, layer: dpc.DPCLayer) -> Any:
        """Return an attack on a layer by name: its maker knows the weights."""
        budget = dpc.attacks.RelativeBall(rho)
        if kind == NOMINAL:
            return None
        if kind == RANDOM:
            return dpc.attacks.RandomAttack(budget)
        cost = self.target() if kind == POISON else dpc.attacks.TargetInput(self.other_target)
        return dpc.attacks.LinearizedAttack(layer, cost, budget)

    def run(self, plant: Any, layer: dpc.DPCLayer, seed: int, kind: str, rho: float) -> Run:
        """Run in closed loop and sum up."""
        return self.summed_up(self.simulate(plant, layer, seed, self.attack(kind, rho, layer)))

    def summed_up(self, log: dpc.ClosedLoopLog) -> Run:
        """Return the errors of a run and its plans without a solution."""
        error = self.error(log)
        unsolved = (log.status != dpc.Status.SOLVED)[:: self.replan_every].sum()
        return Run(float(error.mean()), float(error.max()), int(unsolved))


@functools.cache
def _planner(case: Case, seed: int) -> dpc.DPCLayer:
    with case.system() as plant:
        return case.layer(case.data(plant, seed))


def paper_attacks(layer: dpc.DPCLayer, cost: Any, rhos: Iterable[float]) -> Iterator[tuple[str, float, Any]]:
    """Yield the name, rho and attack of every run: no attack first, then random noise and Algorithm 1 at each rho."""
    yield NOMINAL, 0.0, None
    for rho in rhos:
        budget = dpc.attacks.RelativeBall(rho)
        yield RANDOM, rho, dpc.attacks.RandomAttack(budget)
        yield POISON, rho, dpc.attacks.LinearizedAttack(layer, cost, budget)


def run_seed(case: Case, seed: int, rhos: Sequence[float] | None = None) -> list[dict[str, Any]]:
    """Return the columns of every run of one seed: no attack, and at each rho random noise and Algorithm 1."""
    runs = []
    with case.system() as plant:
        layer = case.layer(case.data(plant, seed))
        for name, rho, attack in paper_attacks(layer, case.target(), case.rhos if rhos is None else rhos):
            log = case.simulate(plant, layer, seed, attack)
            head = {"seed": seed, "attack": name, "rho": rho, "t": log.t.numpy(), "error": case.error(log).numpy()}
            runs.append(head | case.columns(plant, log))
    return runs
