"""A pole on a cart, an unstable nonlinear system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .ode import Ode

GRAVITY = 9.8  # [m/s^2]
CART, POLE = 1.0, 0.1  # masses [kg]
HALF_LENGTH = 0.5  # of the pole [m]
TIME_STEP = 0.02  # [s]


class CartPole(Ode):
    """A pole that turns freely on a cart on a straight track, with a force on the cart.

    With x the position of the cart, theta the angle of the pole from upright, m_c and m_p the masses, l the half-length
    of the pole, F the force and M = m_c + m_p, without friction,

        theta'' = (g sin(theta) - cos(theta) (F + m_p l theta'^2 sin(theta)) / M) / (l (4/3 - m_p cos(theta)^2 / M))
        x''     = (F + m_p l (theta'^2 sin(theta) - theta'' cos(theta))) / M.

    The outputs are the state: x [m], x' [m/s], theta [rad], theta' [rad/s]; the input is F [N]. Theta is not wrapped, 0
    is upright and pi hangs. The track has no ends.

    Sources: parameters of Barto, Sutton, Anderson, "Neuronlike adaptive elements that can solve difficult learning
    control problems", IEEE Transactions on Systems, Man, and Cybernetics 13(5), 1983, 834-846, whose friction is left
    out; equations of Florian, "Correct equations for the dynamics of the cart-pole system", 2007, without friction.

    Args:
        dt: sampling time [s].
        x0: state after a reset, `(4,)`; by default upright and at rest.
        measurement_noise: standard deviation of the noise on the outputs, a number or `(4,)`.
        generator: the source of the noise; a list holds one a run.

    Example:
        >>> plant = CartPole()
        >>> plant.reset([0.0, 0.0, 0.1, 0.0])
        tensor([0.0000, 0.0000, 0.1000, 0.0000], dtype=torch.float64)
        >>> bool(plant.step([0.0])[2] > 0.1)        # it falls
        True
    """

    def __init__(
        self,
        *,
        dt: float = TIME_STEP,
        x0: Any = None,
        measurement_noise: Any = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ):
        super().__init__(
            _accelerations, n_x=4, n_u=1, dt=dt, x0=x0, substeps=2, measurement_noise=measurement_noise,
            generator=generator,
        )  # fmt: skip


def _accelerations(x: Tensor, u: Tensor) -> Tensor:
    _, speed, angle, rate = x.unbind(-1)
    sine, cosine, total = angle.sin(), angle.cos(), CART + POLE
    push = u[..., 0] + POLE * HALF_LENGTH * rate.square() * sine
    turn = (GRAVITY * sine - cosine * push / total) / (HALF_LENGTH * (4 / 3 - POLE * cosine.square() / total))
    pull = (push - POLE * HALF_LENGTH * turn * cosine) / total
    return torch.stack([speed, pull, rate, turn], dim=-1)
