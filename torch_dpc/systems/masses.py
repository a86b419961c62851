"""Oscillating masses: a chain between two walls, a linear system with a known model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..checks import check_count, check_number
from .state_space import StateSpace, discretise


class OscillatingMasses(StateSpace):
    """Masses on a line, joined to their neighbours and to two walls by springs; one force on each.

    The outputs are the state, the positions then the velocities of the masses [m, m/s], and the inputs are forces [N],
    held over a step, so the discrete model (A, B) is exact. Steps are differentiable: a `u` with a graph passes it on
    to the outputs.

    Args:
        masses: how many; the paper has two.
        dt: sampling time [s].
        mass: of each [kg].
        spring: stiffness of each spring [N/m].
        damping: of each mass [N s/m].
        noise: standard deviation of the noise on each measured output [m, m/s].
        generator: the source of that noise; a list holds one a run.

    Example:
        >>> plant = OscillatingMasses()
        >>> _ = plant.reset(torch.tensor([1.0, 1.0, 0.0, 0.0]))
        >>> plant.step(torch.tensor([1.0, 1.0]))        # the input that holds both masses at 1 m
        tensor([1., 1., 0., 0.], dtype=torch.float64)
    """

    def __init__(
        self,
        masses: int = 2,
        dt: float = 0.1,
        *,
        mass: float = 1.0,
        spring: float = 1.0,
        damping: float = 0.0,
        noise: float = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ):
        masses = check_count("masses", masses)
        for name, value in (("dt", dt), ("mass", mass), ("spring", spring)):
            check_number(name, value, positive=True)
        for name, value in (("damping", damping), ("noise", noise)):
            check_number(name, value)
        A, B = discretise(*_continuous(masses, mass, spring, damping), dt)
        super().__init__(A, B, dt=dt, measurement_noise=noise, generator=generator)

    @property
    def noise(self) -> float | Tensor:
        """Standard deviation of the noise on the measured outputs [m, m/s]."""
        return self.measurement_noise


def _continuous(masses: int, mass: float, spring: float, damping: float) -> tuple[Tensor, Tensor]:
    """Return A and B of dx/dt = A x + B u for x = (positions, velocities)."""
    eye = torch.eye(masses, dtype=torch.float64)
    neighbours = torch.diag(torch.ones(masses - 1, dtype=torch.float64), 1)
    stiffness = spring * (2 * eye - neighbours - neighbours.T)
    zero = torch.zeros_like(eye)
    A = torch.cat([torch.cat([zero, eye], 1), torch.cat([-stiffness / mass, -damping / mass * eye], 1)])
    return A, torch.cat([zero, eye / mass])
