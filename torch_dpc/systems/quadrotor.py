"""A Crazyflie quadrotor simulated by PyBullet: velocity commands in, position and attitude out."""

import time
from types import TracebackType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torch_dpc.checks import as_data
from torch_dpc.systems.bullet_world import BulletWorld
from torch_dpc.systems.crazyflie_pid import GRAVITY, Array, CrazyfliePID, wrench

CLEARANCE = 0.06  # the vehicle's radius [m]: above it, it touches nothing in any attitude


class Quadrotor:
    """Simulate a Crazyflie 2.x that follows velocity commands, on PyBullet's rigid-body dynamics.

    One step of `dt` = 0.04 s is `physics_hz` / 25 physics steps, each with its own step of the on-board controller
    (`torch_dpc.systems.crazyflie_pid`). Propeller i pushes with kf rpm_i^2 along body z, and together they turn the
    body with km (-rpm_0^2 + rpm_1^2 - rpm_2^2 + rpm_3^2) about it. The ground is the plane z = 0. The vehicle and the
    structure of its controller are those of gym-pybullet-drones (Panerati et al., IROS 2021), without its optional drag
    and ground effect.

    Outputs are x, y, z [m] and roll, pitch, yaw [rad] as PyBullet's getEulerFromQuaternion gives them: roll and yaw in
    (-pi, pi], pitch in [-pi/2, pi/2]. The controller holds yaw at 0, so nothing wraps unless the vehicle turns over.

    Instances are independent: each owns a physics server, given back by `close`, by leaving a `with` block, or when the
    object goes. They can be neither copied nor pickled; build one in each process.

    Args:
        gui: open PyBullet's window (one per process) and run no faster than real time.
        physics_hz: physics and controller steps per second, a positive multiple of 25.

    Raises:
        ImportError: PyBullet is missing.
        RuntimeError: the window cannot be opened.
        ValueError: `physics_hz` gives no whole number of physics steps in `dt`.

    Example:
        >>> from torch_dpc.systems.quadrotor import Quadrotor
        >>> with Quadrotor() as plant:
        ...     y = plant.reset(position=(0.0, 0.0, 1.0))
        ...     y = plant.step([0.3, 0.0, 0.0])
        ...     plant.crashed
        False
    """

    n_u = 3
    n_y = 6
    dt = 0.04

    def __init__(self, gui: bool = False, physics_hz: int = 250) -> None:
        if not isinstance(physics_hz, int) or isinstance(physics_hz, bool) or physics_hz <= 0 or physics_hz % 25:
            raise ValueError(
                "`physics_hz` must be a positive multiple of 25, an integer (whole physics steps in 0.04 s), "
                f"got {physics_hz!r}."
            )
        self.gui = gui
        self.physics_hz = physics_hz
        self._pid = CrazyfliePID(1.0 / physics_hz)
        self._world = BulletWorld("cf2x.urdf", GRAVITY, 1.0 / physics_hz, gui)
        self.reset()

    def reset(self, position: Any = (0.0, 0.0, 1.0), rpy: Any = (0.0, 0.0, 0.0)) -> torch.Tensor:
        """Put the vehicle at rest in mid-air and forget everything before, the controller's state included.

        Args:
            position: x, y, z, shape (3,) [m], z above 0.06 m.
            rpy: roll, pitch, yaw, shape (3,) [rad]; default level, which hovers.

        Returns:
            The outputs there, shape (6,), float64 [m, rad].
        """
        place, angles = _vector("position", position), _vector("rpy", rpy)
        if place[2] <= CLEARANCE:
            raise ValueError(f"`position` must be more than {CLEARANCE} m above the ground, got z = {place[2]:g}.")
        self._check_open()
        self._world.build(place, angles)
        self._state = self._world.state()
        self._pid.reset(self._state.rpy)
        self._crashed = bool(self._state.rotation[2, 2] < 0.0)
        self._next_tick = time.monotonic()
        return self.measure()

    def step(self, u: Any) -> torch.Tensor:
        """Hold a velocity command for `dt`. After a crash the physics goes on: see `crashed`.

        Args:
            u: velocity command along the world's x, y, z, shape (3,) [m/s]: a tensor, an array or a list of floats.

        Returns:
            The outputs at the end of the step, shape (6,), float64 [m, rad].
        """
        command = _vector("u", u)
        self._check_open()
        for _ in range(self.physics_hz // 25):
            self._physics_step(command)
        if self.gui:
            self._next_tick = max(self._next_tick + self.dt, time.monotonic())
            time.sleep(max(0.0, self._next_tick - time.monotonic()))
        return self.measure()

    def measure(self) -> torch.Tensor:
        """Return the present outputs without advancing time, shape (6,), float64 [m, rad]."""
        self._check_open()
        return torch.from_numpy(np.concatenate([self._state.position, self._state.rpy]))

    @property
    def crashed(self) -> bool:
        """Whether, since the last reset, the vehicle touched the ground or its thrust axis dipped below the horizon.

        The second is |roll| > 90 degrees; Euler angles report a pitch past the vertical as such a roll, too. Looked at
        in every physics step, so a bounce between two outputs counts.
        """
        return self._crashed

    @property
    def closed(self) -> bool:
        """Whether the physics server was given back."""
        return self._world.closed

    def __repr__(self) -> str:
        state = "closed" if self.closed else "crashed" if self._crashed else "flying"
        return f"Quadrotor(gui={self.gui}, {self.physics_hz} Hz, dt={self.dt:g} s): {state}"

    def close(self) -> None:
        """Give the physics server back; further calls do nothing."""
        self._world.close()

    def render(
        self,
        width: int = 320,
        height: int = 240,
        target: Any = None,
        distance: float = 0.6,
        yaw: float = -50.0,
        pitch: float = -25.0,
        fov: float = 45.0,
    ) -> NDArray[np.uint8]:
        """Take a picture with PyBullet's software renderer: no display needed, and the flight does not notice.

        Args:
            width: [pixels].
            height: [pixels].
            target: the point looked at, shape (3,) [m]; default the vehicle.
            distance: from the camera to the target [m].
            yaw: heading of the camera about the world's z axis, 0 looking along +y [degrees].
            pitch: elevation of the line of sight, negative looking down [degrees].
            fov: vertical angle of view [degrees].

        Returns:
            RGB, shape (height, width, 3), uint8.
        """
        if width < 1 or height < 1 or not distance > 0 or not 0 < fov < 180:
            raise ValueError(
                "`width`, `height` and `distance` must be positive and `fov` between 0 and 180, "
                f"got {width}, {height}, {distance} and {fov}."
            )
        self._check_open()
        centre = self._state.position if target is None else _vector("target", target)
        return self._world.picture(width, height, centre, distance, yaw, pitch, fov)

    def __enter__(self) -> "Quadrotor":
        self._check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> Any:
        raise TypeError("a Quadrotor owns a physics server and cannot be copied or pickled; build one in each process.")

    def _physics_step(self, command: Array) -> None:
        state = self._state
        rpm = self._pid.rpm(command, state.velocity, state.rotation, state.rpy)
        self._world.advance(wrench(rpm))
        self._state = self._world.state()
        # The z component of body z, cos(roll) cos(pitch), is negative when the propellers push downwards.
        self._crashed = self._crashed or bool(self._state.rotation[2, 2] < 0.0) or self._world.on_ground()

    def _check_open(self) -> None:
        if self.closed:
            raise RuntimeError("this Quadrotor is closed; make a new one.")


def _vector(name: str, value: Any) -> Array:
    """Return `value` as a fresh float64 array of shape (3,), or say what is wrong with it."""
    if isinstance(value, list | tuple):
        value = [float(entry) if type(entry) is int else entry for entry in value]  # (0, 0, 1) is a point, too
    vector = as_data(name, value)
    if vector.shape != (3,):
        raise ValueError(f"`{name}` must have shape (3,), got {tuple(vector.shape)}.")
    return vector.detach().cpu().to(torch.float64).numpy().copy()
