"""The quadrotor as a Gymnasium environment: velocity commands that bring it to a point."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..systems import Quadrotor, TorchQuadrotor

Array = NDArray[np.float64]

UNBOUNDED = float(np.finfo(np.float32).max)  # Gymnasium warns of observation spaces with infinite bounds
START = 0.5  # largest distance of the start from the target along each axis [m]


class QuadrotorEnv(gymnasium.Env[Array, Array]):
    """Fly the Crazyflie of :class:`torch_dpc.systems.Quadrotor` to a point by velocity commands.

    Registered as "torch_dpc/Quadrotor-v0", 500 steps of 0.04 s an episode.

        action        velocity along the world's x, y, z, [-1, 1] [m/s]
        observation   x, y, z [m], roll, pitch, yaw [rad], and their rates over the last step [m/s, rad/s]
        reward        - distance to the target [m], after the step
        terminated    the vehicle touched the ground or turned over

    An episode begins at rest at a random point around the target. `options={"position": ...}` of `reset` sets it.

    Args:
        target: x, y, z [m], z at least 0.6 m.
        physics: "torch" (:class:`TorchQuadrotor`) or "bullet" (PyBullet), the same flights to rounding; by default
            torch, and PyBullet where pictures are asked for.
        render_mode: None or "rgb_array".

    Example:
        >>> import gymnasium, torch_dpc.envs
        >>> env = gymnasium.make("torch_dpc/Quadrotor-v0")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, env.action_space
        ((12,), Box(-1.0, 1.0, (3,), float64))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}
    dt = TorchQuadrotor.dt

    def __init__(
        self, target: Any = (0.0, 0.0, 1.0), *, physics: str | None = None, render_mode: str | None = None
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'`render_mode` must be None or "rgb_array", got {render_mode!r}.')
        physics = physics or ("torch" if render_mode is None else "bullet")
        if physics not in ("torch", "bullet"):
            raise ValueError(f'`physics` must be "torch" or "bullet", got {physics!r}.')
        if render_mode is not None and physics == "torch":
            raise ValueError('PyBullet takes the pictures: `render_mode="rgb_array"` needs `physics="bullet"`.')
        self.target = np.array(target, dtype=np.float64)
        if self.target.shape != (3,) or not np.isfinite(self.target).all() or self.target[2] < START + 0.1:
            raise ValueError(f"`target` must be a point (3,) with z at least {START + 0.1} m, got {target!r}.")
        self.render_mode = render_mode
        self._plant = TorchQuadrotor(ground="stop") if physics == "torch" else Quadrotor()
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float64)
        self.observation_space = spaces.Box(-UNBOUNDED, UNBOUNDED, (12,), np.float64)

    def __repr__(self) -> str:
        return f"QuadrotorEnv(target={self.target.tolist()}, {self._plant})"

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Put the vehicle at rest around the target, or at `options["position"]`."""
        super().reset(seed=seed)
        offset = self.np_random.uniform(-START, START, 3)
        position = (options or {}).get("position", self.target + offset)
        self._outputs: Array = self._plant.reset(position=position).numpy()
        return np.concatenate([self._outputs, np.zeros(6)]), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold a velocity command for 0.04 s; it is clipped to the action space."""
        before = self._outputs
        self._outputs = self._plant.step(np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)).numpy()
        change = self._outputs - before
        change[3:] = np.remainder(change[3:] + math.pi, 2 * math.pi) - math.pi  # angles wrap at +-pi
        reward = -float(np.linalg.norm(self._outputs[:3] - self.target))
        return np.concatenate([self._outputs, change / self.dt]), reward, bool(self._plant.crashed), False, {}

    def render(self) -> Any:
        """Return a picture, (240, 320, 3), uint8, with `render_mode="rgb_array"`, else None."""
        return self._plant.render() if self.render_mode and isinstance(self._plant, Quadrotor) else None

    def close(self) -> None:
        """Give PyBullet's server back."""
        if isinstance(self._plant, Quadrotor):
            self._plant.close()
