"""Oscillating masses: a chain between two walls, a linear system with a known model."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_data


class OscillatingMasses:
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
        generator: where that noise comes from.

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
        generator: torch.Generator | None = None,
    ):
        if not (masses >= 1 and dt > 0 and mass > 0 and spring > 0 and damping >= 0 and noise >= 0):
            raise ValueError(
                "`masses`, `dt`, `mass` and `spring` must be positive, `damping` and `noise` not negative, got "
                f"{masses}, {dt}, {mass}, {spring}, {damping}, {noise}."
            )
        self.n_u, self.n_y, self.dt = masses, 2 * masses, dt
        self.noise, self.generator = noise, generator
        self.A, self.B = _discretise(*_continuous(masses, mass, spring, damping), dt)
        self._x = torch.zeros(self.n_y, dtype=torch.float64)

    def reset(self, state: Any = None) -> Tensor:
        """Set the state, `(n_y,)` [m, m/s], zero by default, and return the first measurement."""
        x = torch.zeros(self.n_y, dtype=torch.float64) if state is None else as_data("state", state).double()
        if x.shape != (self.n_y,):
            raise ValueError(f"`state` must have shape ({self.n_y},), got {tuple(x.shape)}.")
        self._x = x
        return self.measure()

    def step(self, u: Any) -> Tensor:
        """Apply the forces u, `(n_u,)` [N], for one step and return the measurement after it, `(n_y,)`."""
        u = as_data("u", u).double()
        if u.shape != (self.n_u,):
            raise ValueError(f"`u` must have shape ({self.n_u},), got {tuple(u.shape)}.")
        self._x = self.A @ self._x + self.B @ u
        return self.measure()

    def measure(self) -> Tensor:
        """Return the present outputs, `(n_y,)`, with new noise if there is any."""
        if self.noise == 0:
            return self._x
        return self._x + self.noise * torch.randn(self.n_y, dtype=torch.float64, generator=self.generator)


def _continuous(masses: int, mass: float, spring: float, damping: float) -> tuple[Tensor, Tensor]:
    """Return A and B of dx/dt = A x + B u for x = (positions, velocities)."""
    eye = torch.eye(masses, dtype=torch.float64)
    neighbours = torch.diag(torch.ones(masses - 1, dtype=torch.float64), 1)
    stiffness = spring * (2 * eye - neighbours - neighbours.T)
    zero = torch.zeros_like(eye)
    A = torch.cat([torch.cat([zero, eye], 1), torch.cat([-stiffness / mass, -damping / mass * eye], 1)])
    return A, torch.cat([zero, eye / mass])


def _discretise(A: Tensor, B: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return the exact discrete model for an input held over dt (Van Loan 1978)."""
    n, m = B.shape
    block = torch.zeros(n + m, n + m, dtype=A.dtype)
    block[:n, :n], block[:n, n:] = A, B
    whole = torch.linalg.matrix_exp(block * dt)
    return whole[:n, :n].clone(), whole[:n, n:].clone()
