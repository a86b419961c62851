"""A Gymnasium environment as a plant."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..sets import Box

if TYPE_CHECKING:
    import gymnasium

#: How far an action may be outside its bounds: the rounding of a plan, relative to the size of the bounds.
BOUND_TOLERANCE = 1e-6


class GymPlant:
    """Control a Gymnasium environment whose actions and observations are continuous.

    The inputs are the entries of the action, the outputs those of the observation, or some of them. Rewards are not
    used; the last one is in `reward`. A time limit (`truncated`) does not end a run, because a plant has none; a
    terminal state does, and a further step is an error.

    Args:
        env: an environment with `Box` spaces, made by `gymnasium.make`.
        outputs: which entries of the flattened observation are outputs; all by default.
        dt: sampling time [s]; by default what the environment says (`env.unwrapped.dt`).

    Attributes:
        u_set: the bounds of the actions, to give to the layer as `u_set`.
        reward, terminated, truncated, info: what the last step returned.

    Raises:
        ValueError: spaces that are not continuous, entries that do not exist, or no sampling time.

    Example:
        >>> import gymnasium
        >>> from torch_dpc import collect
        >>> plant = GymPlant(gymnasium.make("Pendulum-v1"), outputs=[1, 2])      # sin(angle), angular velocity [rad/s]
        >>> plant.n_u, plant.n_y, plant.dt
        (1, 2, 0.05)
        >>> u, y = collect(plant, 20, reset={"seed": 0})
        >>> y.shape
        torch.Size([20, 2])
    """

    def __init__(self, env: gymnasium.Env[Any, Any], *, outputs: Sequence[int] | None = None, dt: float | None = None):
        if hasattr(env, "num_envs"):
            raise ValueError("`env` must be one environment, got a vector of them; give each a GymPlant of its own.")
        self.env = env
        low, high = _bounds("action_space", getattr(env, "action_space", None))
        width = _bounds("observation_space", getattr(env, "observation_space", None))[0].size
        self._outputs = list(range(width)) if outputs is None else [int(i) for i in outputs]
        if not self._outputs or not all(0 <= i < width for i in self._outputs):
            raise ValueError(f"`outputs` must name entries 0 to {width - 1} of the observation, got {outputs!r}.")
        dt = getattr(env.unwrapped, "dt", None) if dt is None else dt
        if not isinstance(dt, Real) or not float(dt) > 0:
            raise ValueError(f"`dt` must be a positive sampling time [s], got {dt!r}; this environment states none.")
        self.n_u, self.n_y, self.dt = low.size, len(self._outputs), float(dt)
        self.u_set = Box(low.tolist(), high.tolist())
        self._low, self._high = low, high
        self._slack = BOUND_TOLERANCE * np.maximum(np.abs(low), np.abs(high))
        self._observation: NDArray[np.float64] | None = None
        self.reward, self.terminated, self.truncated = 0.0, False, False
        self.info: dict[str, Any] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NDArray[np.float64]:
        """Start a new episode and return the first outputs, `(n_y,)`; arguments as `env.reset` takes them."""
        observation, self.info = self.env.reset(seed=seed, options=options)
        self.reward, self.terminated, self.truncated = 0.0, False, False
        return self._accept(observation)

    def step(self, u: Any) -> NDArray[np.float64]:
        """Apply an action, `(n_u,)`, and return the outputs after it, `(n_y,)`.

        Raises:
            RuntimeError: the episode has ended in a terminal state.
            ValueError: an action outside the bounds of the environment.
        """
        if self.terminated:
            raise RuntimeError("the environment has reached a terminal state; call `reset`.")
        action = np.asarray(u, dtype=np.float64).reshape(-1)
        if action.shape != (self.n_u,):
            raise ValueError(f"`u` must have shape ({self.n_u},), got {np.shape(u)}.")
        if ((action < self._low - self._slack) | (action > self._high + self._slack)).any():
            raise ValueError(
                f"`u` must be within the action space, {self._low.tolist()} to {self._high.tolist()}, got "
                f"{action.tolist()}. Give the layer `u_set=plant.u_set`, or `collect` a smaller `amplitude`."
            )
        space: Any = self.env.action_space
        action = action.clip(self._low, self._high).reshape(space.shape).astype(space.dtype)
        # The cast may round a bound outwards.
        observation, reward, self.terminated, self.truncated, self.info = self.env.step(
            action.clip(space.low, space.high)
        )
        self.reward = float(reward)
        return self._accept(observation)

    def measure(self) -> NDArray[np.float64]:
        """Return the present outputs, `(n_y,)`, without advancing time."""
        if self._observation is None:
            raise RuntimeError("the environment has not been started; call `reset`.")
        return self._observation[self._outputs]

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def __repr__(self) -> str:
        return f"GymPlant({self.env}): {self.n_u} inputs, {self.n_y} outputs, dt = {self.dt:g} s"

    def _accept(self, observation: Any) -> NDArray[np.float64]:
        self._observation = np.array(observation, dtype=np.float64).reshape(-1)
        return self.measure()


def _bounds(name: str, space: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bounds of a flattened Box of floats."""
    if type(space).__name__ != "Box" or not np.issubdtype(space.dtype, np.floating):
        raise ValueError(f"the environment's `{name}` must be a gymnasium.spaces.Box of floats, got {space!r}.")
    low, high = (np.asarray(bound, dtype=np.float64).reshape(-1) for bound in (space.low, space.high))
    return low, high
