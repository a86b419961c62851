"""Runs that start elsewhere, are pushed, or change their reference: what a controller must also do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

START_SEED, PUSH_SEED = 2000, 3000  # a run of seed s draws its start and its pushes from these + s
PUSH_EVERY, PUSH_STEPS = 100, 10  # a push begins every 100 steps and lasts 10


@dataclass(frozen=True)
class Scenario:
    """How a run differs from its figure.

    Attributes:
        name: for tables.
        start: where the figure starts, at rest away from the reference ("away"), or at a random place.
        pushed: whether random pushes are added to the inputs, unseen by the controller.
        changes: whether the reference is halved in the middle of the run.
    """

    name: str
    start: Literal["figure", "away", "random"] = "figure"
    pushed: bool = False
    changes: bool = False

    def references(
        self, y_ref: Tensor, u_ref: Tensor | None, steps: int, centre: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Return y_ref and u_ref of the scenario: halved about `centre` from the middle of the run on."""
        if not self.changes:
            return y_ref, u_ref
        y_ref = torch.cat([y_ref[: steps // 2], centre + 0.5 * (y_ref[steps // 2 :] - centre)])
        return y_ref, None if u_ref is None else torch.cat([u_ref[: steps // 2], 0.5 * u_ref[steps // 2 :]])


FIGURE = Scenario("as in the figure")
AWAY = Scenario("from rest away from the reference", start="away")
RANDOM_START = Scenario("from a random start", start="random")
PUSHED = Scenario("pushed", pushed=True)
CHANGING = Scenario("the reference changes", changes=True)
SCENARIOS = (FIGURE, AWAY, RANDOM_START, PUSHED, CHANGING)


class Pushed:
    """A plant whose inputs are pushed; its controller does not see the pushes.

    Args:
        plant: pushed.
        size: the standard deviation of each push [N or m/s].
        first: steps before the first push may begin.
        seed: of the pushes.
    """

    def __init__(self, plant: Any, size: float, first: int, seed: int):
        self.plant, self.size, self.first = plant, size, first
        self.n_u, self.n_y, self.dt = plant.n_u, plant.n_y, plant.dt
        self.seed = seed

    def reset(self, **where: Any) -> Tensor:
        """Reset the plant and the pushes."""
        self.k, self.generator = 0, torch.Generator().manual_seed(PUSH_SEED + self.seed)
        return self.plant.reset(**where)

    def step(self, u: Tensor) -> Tensor:
        """Apply u and the present push."""
        since = (self.k - self.first) % PUSH_EVERY
        if since == 0:
            self.push = self.size * torch.randn(self.n_u, dtype=torch.float64, generator=self.generator)
        pushed = self.k >= self.first and since < PUSH_STEPS
        self.k += 1
        return self.plant.step(u + self.push if pushed else u)


def start_generator(seed: int) -> torch.Generator:
    """Return the source of a run's random start."""
    return torch.Generator().manual_seed(START_SEED + seed)
