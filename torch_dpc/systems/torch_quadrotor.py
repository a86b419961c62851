"""The PyBullet quadrotor in torch: thousands of vehicles at once, differentiable through time."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from ..checks import as_data, one_batch
from . import crazyflie_pid as vehicle
from .bullet_world import DAMPING
from .rigid_body import BodyState, RigidBody, euler_angles, quaternion_of, rotation_matrix
from .torch_pid import PIDState, TorchPID

CLEARANCE = 0.06  # the vehicle's radius [m]: above it, it touches nothing in any attitude
# The collision cylinder of the URDF, grown by the 1 mm margin that PyBullet gives shapes from a file [m].
RADIUS, HALF_HEIGHT = 0.061, 0.0135


class GroundContactError(RuntimeError):
    """A vehicle touched the ground, which `TorchQuadrotor` does not model.

    Attributes:
        vehicles: which ones, boolean, `(*batch,)`.
    """

    def __init__(self, vehicles: Tensor):
        self.vehicles = vehicles
        named = "the vehicle" if vehicles.ndim == 0 else f"vehicles {vehicles.nonzero().tolist()[:10]} of the batch"
        super().__init__(
            f'{named} touched the ground; contact is not modelled. Use `ground="stop"` to leave such vehicles where '
            "they touched, or `Quadrotor` (PyBullet) for what happens afterwards."
        )


class QuadrotorState(NamedTuple):
    """Everything the next step depends on, `(*batch, n)` each."""

    body: BodyState
    pid: PIDState
    grounded: Tensor  # has touched the ground and stays there
    crashed: Tensor  # grounded, or the thrust axis has dipped below the horizon


class TorchQuadrotor:
    """Fly Crazyflies 2.x that follow velocity commands, with the equations of :class:`Quadrotor` in torch.

    The same vehicle, controller, integration and order of operations as the PyBullet plant, in float64, so that flights
    agree to rounding (:mod:`torch_dpc.systems.rigid_body` has the equations). Any batch of vehicles flies in one
    call, and outputs carry the graph of the commands and of the initial position and attitude.

    Not modelled: contact, neither with the ground nor between vehicles. A vehicle whose collision cylinder reaches the
    plane z = 0 raises :class:`GroundContactError` at that step. With `ground="stop"` it stays in its last free state,
    is marked in `grounded`, and later commands have no influence on it.

    Args:
        physics_hz: physics and controller steps per second, a positive multiple of 25.
        ground: what happens to a vehicle that touches the ground: "raise" or "stop".
        device: where the vehicles' state lives.

    Example:
        >>> plant = TorchQuadrotor()
        >>> y = plant.reset(position=(0.0, 0.0, 1.0), batch=(1000,))
        >>> plant.step(torch.tensor([0.3, 0.0, 0.0])).shape
        torch.Size([1000, 6])
    """

    n_u = 3
    n_y = 6
    dt = 0.04

    def __init__(
        self,
        physics_hz: int = 250,
        *,
        ground: Literal["raise", "stop"] = "raise",
        device: torch.device | str = "cpu",
    ) -> None:
        if not isinstance(physics_hz, int) or isinstance(physics_hz, bool) or physics_hz <= 0 or physics_hz % 25:
            raise ValueError(
                "`physics_hz` must be a positive multiple of 25, an integer (whole physics steps in 0.04 s), "
                f"got {physics_hz!r}."
            )
        if ground not in ("raise", "stop"):
            raise ValueError(f'`ground` must be "raise" or "stop", got {ground!r}.')
        self.physics_hz, self.ground, self.device = physics_hz, ground, torch.device(device)
        self._pid = TorchPID(1.0 / physics_hz, self.device)
        inertia = torch.tensor(vehicle.INERTIA, dtype=torch.float64, device=self.device)
        self._body = RigidBody(vehicle.MASS, inertia, vehicle.GRAVITY, DAMPING)
        self.reset()

    def reset(
        self, position: Any = (0.0, 0.0, 1.0), rpy: Any = (0.0, 0.0, 0.0), *, batch: int | tuple[int, ...] = ()
    ) -> Tensor:
        """Put the vehicles at rest in mid-air and forget everything before, the controllers' state included.

        Args:
            position: x, y, z, `(3,)` or `(*batch, 3)` [m], z above 0.06 m.
            rpy: roll, pitch, yaw, likewise [rad]; default level, which hovers.
            batch: how many vehicles; default as many as `position` and `rpy` have.

        Returns:
            The outputs there, `(*batch, 6)`, float64 [m, rad].
        """
        place, angles = (self._vectors(*named) for named in (("position", position), ("rpy", rpy)))
        if bool((place[..., 2] <= CLEARANCE).any()):
            lowest = float(place[..., 2].min())
            raise ValueError(f"`position` must be more than {CLEARANCE} m above the ground, got z = {lowest:g}.")
        asked = torch.Size((batch,) if isinstance(batch, int) else batch)
        shape = one_batch([("batch", asked), ("position", place.shape[:-1]), ("rpy", angles.shape[:-1])])
        if asked and shape != asked:
            raise ValueError(f"`position` and `rpy` must broadcast to `batch` = {tuple(asked)}, got {tuple(shape)}.")
        place, angles = place.expand(*shape, 3), angles.expand(*shape, 3)
        quaternion, still = quaternion_of(angles), torch.zeros_like(place)
        nowhere = torch.zeros(shape, dtype=torch.bool, device=self.device)
        over = rotation_matrix(quaternion)[..., 2, 2] < 0
        pid = PIDState(euler_angles(quaternion), still)
        self.state = QuadrotorState(BodyState(place, still, quaternion, still), pid, nowhere, over)
        return self.measure()

    def step(self, u: Any) -> Tensor:
        """Hold velocity commands for `dt`.

        Args:
            u: along the world's x, y, z, `(3,)` for all or `(*batch, 3)` [m/s].

        Returns:
            The outputs at the end of the step, `(*batch, 6)`, float64 [m, rad].

        Raises:
            GroundContactError: a vehicle touched the ground, with `ground="raise"`; no vehicle has moved then.
        """
        command, state = self._vectors("u", u), self.state
        batch = state.grounded.shape
        if command.shape[:-1] not in (batch, ()):
            raise ValueError(f"`u` must have shape (3,) or (*batch, 3) = {(*batch, 3)}, got {tuple(command.shape)}.")
        for _ in range(self.physics_hz // 25):
            state = self._physics_step(state, command)
        self.state = state
        return self.measure()

    def measure(self) -> Tensor:
        """Return the present outputs without advancing time, `(*batch, 6)`, float64 [m, rad]."""
        return torch.cat([self.state.body.position, euler_angles(self.state.body.quaternion)], dim=-1)

    @property
    def grounded(self) -> Tensor:
        """Which vehicles have touched the ground since the last reset and stay there, boolean, `(*batch,)`."""
        return self.state.grounded

    @property
    def crashed(self) -> Tensor:
        """Which vehicles touched the ground or had their thrust axis below the horizon, boolean, `(*batch,)`."""
        return self.state.crashed

    def snapshot(self) -> tuple[Tensor, ...]:
        """Return the state as tensors, for `restore`."""
        body, pid, grounded, crashed = self.state
        return (*body, *pid, grounded, crashed)

    def restore(self, snapshot: tuple[Tensor, ...]) -> None:
        """Go back to a state that `snapshot` returned."""
        self.state = QuadrotorState(BodyState(*snapshot[:4]), PIDState(*snapshot[4:6]), *snapshot[6:])

    def __repr__(self) -> str:
        flying = int((~self.grounded).sum())
        return (
            f"TorchQuadrotor({self.physics_hz} Hz, ground={self.ground!r}): {flying} of {self.grounded.numel()} fly, "
            f"batch {tuple(self.grounded.shape)}, inputs velocity [m/s], outputs position [m] and attitude [rad]"
        )

    def _physics_step(self, state: QuadrotorState, command: Tensor) -> QuadrotorState:
        body = state.body
        rotation, rpy = rotation_matrix(body.quaternion), euler_angles(body.quaternion)
        pid, wrench = self._pid.wrench(state.pid, command, body.velocity, rotation, rpy)
        after = self._body.advance(body, rotation, wrench[..., 0], wrench[..., 1:], self._pid.dt)
        with torch.no_grad():
            x, y, z, w = after.quaternion.unbind(-1)
            upright = 1 - 2 * (x * x + y * y)  # the z component of body z
            reach = HALF_HEIGHT * upright.abs() + RADIUS * (1 - upright * upright).clamp_min(0).sqrt()
            touching = (after.position[..., 2] <= reach) & ~state.grounded
            if bool(touching.any()) and self.ground == "raise":
                raise GroundContactError(touching)
            grounded = state.grounded | touching
            crashed = state.crashed | grounded | (upright < 0)
        if bool(grounded.any()):
            after, pid = _stopped(grounded, after, body), _stopped(grounded, pid, state.pid)
        return QuadrotorState(after, pid, grounded, crashed)

    def _vectors(self, name: str, value: Any) -> Tensor:
        """Return `value` as float64 vectors `(*batch, 3)`, with their graph."""
        if isinstance(value, list | tuple):
            value = [float(entry) if type(entry) is int else entry for entry in value]  # (0, 0, 1) is a point, too
        vectors = as_data(name, value)
        if vectors.shape[-1:] != (3,):
            raise ValueError(f"`{name}` must have shape (3,) or (*batch, 3), got {tuple(vectors.shape)}.")
        return vectors.to(self.device, torch.float64)


def _stopped(grounded: Tensor, after: Any, before: Any) -> Any:
    """Return the fields of `after`, those of `before` where a vehicle is on the ground."""
    return type(after)(*(torch.where(grounded[..., None], b, a) for a, b in zip(after, before, strict=True)))
