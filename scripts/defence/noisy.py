"""A plant whose sensors are noisy; the truth is kept."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class Noisy:
    """A plant with independent normal noise on every measurement.

    Args:
        plant: what is measured.
        deviation: of the noise on each output, `(n_y,)`.

    Attributes:
        generator: of the noise; set it before each run.
        truth: the outputs without noise since the last reset, one a measurement.
    """

    def __init__(self, plant: Any, deviation: Tensor):
        self.plant, self.deviation = plant, deviation
        self.n_u, self.n_y, self.dt = plant.n_u, plant.n_y, plant.dt
        self.generator = torch.Generator().manual_seed(0)
        self.truth: list[Tensor] = []

    def reset(self, **where: Any) -> Tensor:
        """Reset the plant and forget the truth of the last run."""
        self.truth = []
        return self._measured(self.plant.reset(**where))

    def step(self, u: Tensor) -> Tensor:
        """Apply u and measure."""
        return self._measured(self.plant.step(u))

    def _measured(self, y: Tensor) -> Tensor:
        self.truth.append(y)
        return y + self.deviation * torch.randn(y.shape, dtype=y.dtype, generator=self.generator)
