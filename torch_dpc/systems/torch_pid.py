"""The controller of :mod:`torch_dpc.systems.crazyflie_pid`, batched and differentiable."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import crazyflie_pid as vehicle

#: Below this thrust [N] (that of PWM 0) all motors run at their least speed, whatever torque is asked for.
LEAST_THRUST = 4 * vehicle.THRUST_PER_RPM2 * vehicle.RPM_AT_ZERO_PWM**2


class PIDState(NamedTuple):
    """What the controller remembers."""

    rpy: Tensor  # roll, pitch, yaw one step ago, (*batch, 3) [rad]
    integral: Tensor  # of the attitude error, (*batch, 3)


class TorchPID:
    """Turn velocity commands into thrust and torques: the law of :class:`CrazyfliePID`, then its propellers.

    The state is handed in and out, so calls are pure functions.

    Args:
        dt: time between two calls [s].
        device: of the tensors it is given.
    """

    def __init__(self, dt: float, device: torch.device) -> None:
        def constant(array: vehicle.Array) -> Tensor:
            return torch.as_tensor(array, dtype=torch.float64, device=device)

        self.dt = dt
        self._velocity_gain = constant(vehicle.VELOCITY_GAIN)
        self._hover_force = constant(np.array([0.0, 0.0, vehicle.MASS * vehicle.GRAVITY]))
        self._P, self._I = constant(vehicle.ATTITUDE_P), constant(vehicle.ATTITUDE_I)
        self._D = constant(vehicle.ATTITUDE_D / dt)  # of the difference of two attitudes
        self._integral_limit = constant(vehicle.INTEGRAL_LIMIT)
        self._mixer, self._wrench = constant(vehicle.MIXER.T), constant(vehicle.WRENCH.T)

    def wrench(
        self, state: PIDState, command: Tensor, velocity: Tensor, rotation: Tensor, rpy: Tensor
    ) -> tuple[PIDState, Tensor]:
        """Advance the controller by one step.

        Args:
            state: what it remembers.
            command: velocity asked for, world axes, `(*batch, 3)` [m/s].
            velocity: present velocity, world axes, `(*batch, 3)` [m/s].
            rotation: present attitude, body to world, `(*batch, 3, 3)`.
            rpy: the same attitude as roll, pitch, yaw, `(*batch, 3)` [rad].

        Returns:
            The state after the step; thrust along body z and torques about body x, y, z, `(*batch, 4)` [N, N m].
        """
        force = self._velocity_gain * (command - velocity) + self._hover_force
        half = _target_rotation(force).mT @ rotation
        # vee(Rd'R - R'Rd): twice the (small) rotation that leads from the target Rd to R, in body axes.
        skew = half - half.mT
        error = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
        turned = torch.remainder(rpy - state.rpy + math.pi, 2 * math.pi) - math.pi  # roll and yaw wrap at +-pi
        integral = (state.integral - self.dt * error).clamp(-self._integral_limit, self._integral_limit)
        torque = self._I * integral - self._P * error - self._D * turned
        torque = torque.clamp(-vehicle.TORQUE_LIMIT, vehicle.TORQUE_LIMIT)
        # The clip at LEAST_THRUST changes no motor's speed and keeps the root's derivative finite.
        thrust = (force * rotation[..., 2]).sum(-1, keepdim=True).clamp_min(LEAST_THRUST)
        level = ((thrust / (4 * vehicle.THRUST_PER_RPM2)).sqrt() - vehicle.RPM_AT_ZERO_PWM) / vehicle.RPM_PER_PWM
        pwm = (level + torque @ self._mixer).clamp(vehicle.PWM_MIN, vehicle.PWM_MAX)
        rpm = vehicle.RPM_PER_PWM * pwm + vehicle.RPM_AT_ZERO_PWM
        return PIDState(rpy, integral), (rpm * rpm) @ self._wrench


def _target_rotation(force: Tensor) -> Tensor:
    """Return the attitude with z along `force` and heading 0, `(*batch, 3, 3)`: y = z x e_x normalised, x = y x z."""
    size = torch.linalg.vector_norm(force, dim=-1, keepdim=True)
    across = torch.linalg.vector_norm(force[..., 1:], dim=-1, keepdim=True)
    free = across <= 1e-12 * size.clamp_min(1.0)  # no force, or one along e_x, fixes no attitude: stay level
    level = torch.eye(3, dtype=force.dtype, device=force.device)
    fy, fz = force[..., 1], force[..., 2]
    y = torch.stack([torch.zeros_like(fz), fz, -fy], dim=-1) / torch.where(free, 1.0, across)
    y = torch.where(free, level[1], y)
    z = torch.where(free, level[2], force / torch.where(free, 1.0, size))
    return torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
