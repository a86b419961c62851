"""One step of a free rigid body as PyBullet does it, batched and differentiable.

PyBullet loads a URDF as a `btMultiBody`. Its base obeys, per step dt (semi-implicit Euler, `btMultiBody.cpp`),

    v+     = v + dt (F / m + g - v (d + d |v|))                                               (force)
    omega+ = omega + dt R I^-1 (tau - w x I w - I w (d + d |w|)),   w = R' omega              (torque, gyroscopic term)
    x+     = x + dt v+,   q+ = exp(dt omega+ / 2) q, normalised                               (exponential map)

with every velocity coordinate clipped to +-100. F, v, omega are in world axes, tau and w in body axes, R is the
rotation of the quaternion q = (x, y, z, w). Damping has a linear and a quadratic part with the same coefficient d.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

MAX_COORDINATE_VELOCITY = 100.0  # [m/s, rad/s]: btMultiBody's default
GIMBAL_SINE = 0.99999  # |sin(pitch)| beyond which PyBullet sets roll to 0 and gives the turn to yaw


class BodyState(NamedTuple):
    """Position and motion of rigid bodies, world axes."""

    position: Tensor  # (*batch, 3) [m]
    velocity: Tensor  # (*batch, 3) [m/s]
    quaternion: Tensor  # body to world, (x, y, z, w), (*batch, 4)
    omega: Tensor  # angular velocity, (*batch, 3) [rad/s]


class RigidBody(NamedTuple):
    """Constants of a body whose axes are its principal axes."""

    mass: float  # [kg]
    inertia: Tensor  # about body x, y, z, (3,) [kg m^2]
    gravity: float  # downwards [m/s^2]
    damping: float  # d, [1/s] and [1/m]

    def advance(self, state: BodyState, rotation: Tensor, thrust: Tensor, torque: Tensor, dt: float) -> BodyState:
        """Return the state after one step.

        Args:
            state: the present state.
            rotation: its attitude as a matrix, `(*batch, 3, 3)`.
            thrust: force along body z, `(*batch)` [N].
            torque: about body x, y, z, `(*batch, 3)` [N m].
            dt: [s].
        """
        weight = torch.tensor([0.0, 0.0, -self.gravity], dtype=thrust.dtype, device=thrust.device)
        acceleration = rotation[..., 2] * (thrust / self.mass)[..., None] + weight - self._drag(state.velocity)
        w = (rotation.mT @ state.omega[..., None])[..., 0]
        momentum = self.inertia * w
        turning = (torque - torch.linalg.cross(w, momentum)) / self.inertia - self._drag(w)
        velocity = _clip_velocity(state.velocity + dt * acceleration)
        omega = _clip_velocity(state.omega + dt * (rotation @ turning[..., None])[..., 0])
        return BodyState(state.position + dt * velocity, velocity, turn(state.quaternion, omega, dt), omega)

    def _drag(self, velocity: Tensor) -> Tensor:
        speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
        return velocity * (self.damping + self.damping * speed)


def turn(quaternion: Tensor, omega: Tensor, dt: float) -> Tensor:
    """Turn attitudes by the world-axes angular velocity for dt, by the exponential map."""
    half = 0.5 * dt * torch.linalg.vector_norm(omega, dim=-1, keepdim=True)
    axis = 0.5 * dt * omega * torch.sinc(half / math.pi)
    scalar = torch.cos(half)
    vector, w = quaternion[..., :3], quaternion[..., 3:]
    turned = torch.cat(
        [
            scalar * vector + w * axis + torch.linalg.cross(axis, vector),
            scalar * w - (axis * vector).sum(-1, keepdim=True),
        ],
        dim=-1,
    )
    return turned / torch.linalg.vector_norm(turned, dim=-1, keepdim=True)


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Return the body-to-world rotation of unit quaternions (x, y, z, w), `(*batch, 3, 3)`."""
    x, y, z, w = quaternion.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def euler_angles(quaternion: Tensor) -> Tensor:
    """Return roll, pitch, yaw as PyBullet's getEulerFromQuaternion does, `(*batch, 3)` [rad].

    Near a vertical pitch (|sin(pitch)| > 0.99999) roll is 0 and pitch is +-pi/2: values jump there and derivatives of
    roll and pitch are 0.
    """
    x, y, z, w = quaternion.unbind(-1)
    sine = 2 * (w * y - x * z)
    vertical = sine.abs() >= GIMBAL_SINE
    inside = torch.where(vertical, 0.0, sine)
    # At a vertical pitch both arguments of these atan2 vanish; a 1 keeps the derivative of the unused branch finite.
    level = torch.where(vertical, 1.0, w * w - x * x - y * y + z * z)
    ahead = torch.where(vertical, 1.0, w * w + x * x - y * y - z * z)
    roll = torch.where(vertical, 0.0, torch.atan2(2 * (y * z + w * x), level))
    pitch = torch.where(vertical, sine.sign() * (math.pi / 2), torch.asin(inside))
    sign = torch.where(sine < 0, 1.0, -1.0)
    at_pole = 2 * torch.atan2(torch.where(vertical, sign * x, 0.0), torch.where(vertical, -sign * y, 1.0))
    yaw = torch.where(vertical, at_pole, torch.atan2(2 * (x * y + w * z), ahead))
    return torch.stack([roll, pitch, yaw], dim=-1)


def quaternion_of(rpy: Tensor) -> Tensor:
    """Return the quaternions (x, y, z, w) of roll, pitch, yaw, `(*batch, 4)`."""
    (sr, sp, sy), (cr, cp, cy) = (0.5 * rpy).sin().unbind(-1), (0.5 * rpy).cos().unbind(-1)
    entries = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    return torch.stack(entries, dim=-1)


def _clip_velocity(velocity: Tensor) -> Tensor:
    return velocity.clamp(-MAX_COORDINATE_VELOCITY, MAX_COORDINATE_VELOCITY)
