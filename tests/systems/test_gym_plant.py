"""Gymnasium environments as plants."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import generator

gymnasium = pytest.importorskip("gymnasium")

from torch_dpc.systems import GymPlant  # noqa: E402


def test_pendulum_is_balanced_in_ten_lines():
    """Near upright: without control it falls, with data-driven control it stands. Q = diag(10, 0.1)."""
    plant = GymPlant(gymnasium.make("Pendulum-v1"), outputs=[1, 2])  # sin(angle), angular velocity [rad/s]
    start = {"options": {"x_init": 0.2, "y_init": 0.2}, "seed": 0}
    pull = {"feedback": lambda y: -12 * y[:1] - 3 * y[1:], "amplitude": 0.5}  # rough, but it keeps the rod up
    u, y = dpc.collect(plant, 200, reset=start, generator=generator(), **pull)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=15)
    Q = torch.diag(torch.tensor([10.0, 0.1]))
    layer = dpc.DPCLayer(data, Q, R=0.01, lambda_g=1.0, lambda_s=1e4, u_set=plant.u_set)
    logs = [
        dpc.simulate(plant, dpc.DPCController(layer, 1), torch.zeros(2), steps=100, reset={**start, "seed": seed})
        for seed in range(4)
    ]
    assert max(log.y[0].norm() for log in logs) > 0.2  # while the first window fills, the rod falls
    for seed, log in enumerate(logs):
        assert log.y[50:, 0].abs().max() < 1e-2
        assert log.u.abs().max() <= 2.0
        plant.reset(**{**start, "seed": seed})
        fallen = np.stack([plant.step(np.zeros(1)) for _ in range(60)])
        assert np.abs(fallen[:, 0]).max() > 0.9


class Lag(gymnasium.Env):
    """y+ = 0.9 y + 0.1 u for two channels kept as a matrix; ends where |y| passes 1."""

    dt = 0.1
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1, 2), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2, 1), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y = np.full((2, 1), (options or {}).get("y", 0.0))
        return self.y, {"start": True}

    def step(self, action):
        assert self.action_space.contains(action)
        self.y *= 0.9  # in place: the same array is returned at every step
        self.y += 0.1 * action.T
        return self.y, -1.0, bool(np.abs(self.y).max() > 1), True, {}


def test_shapes_dtypes_and_rewards():
    plant = GymPlant(Lag())
    assert (plant.n_u, plant.n_y, plant.dt) == (2, 2, 0.1)
    first = plant.reset(options={"y": 0.5})
    np.testing.assert_array_equal(first, [0.5, 0.5])
    second = plant.step(torch.tensor([1.0, 2.0]))
    np.testing.assert_allclose(second, [0.55, 0.65])
    np.testing.assert_array_equal(first, [0.5, 0.5])  # no view of the environment's own array
    np.testing.assert_array_equal(plant.measure(), second)
    assert (plant.reward, plant.terminated, plant.truncated, plant.info) == (-1.0, False, True, {})
    np.testing.assert_allclose(plant.step([2.0 + 1e-9, -2.0 - 1e-9]), [0.695, 0.385])  # rounding of a bound
    assert torch.equal(plant.u_set.upper, torch.tensor([2.0, 2.0]))


def test_the_recording_is_that_of_the_environment():
    u, y = dpc.collect(GymPlant(Lag()), 30, generator=generator(), reset={"options": {"y": 0.2}})
    expected = torch.full((2,), 0.2, dtype=torch.float64)
    for k in range(30):
        torch.testing.assert_close(y[k], expected, rtol=0, atol=1e-7)  # actions are float32
        expected = 0.9 * expected + 0.1 * u[k]


def test_a_terminal_state_ends_the_run():
    plant = GymPlant(Lag())
    plant.reset(options={"y": 0.99})
    plant.step([2.0, 2.0])
    assert plant.terminated
    with pytest.raises(RuntimeError, match="terminal state; call `reset`"):
        plant.step([0.0, 0.0])
    plant.reset()
    plant.step([0.0, 0.0])


BAD_CALLS = {
    "discrete": (lambda: GymPlant(gymnasium.make("CartPole-v1")), "`action_space` must be a gymnasium.spaces.Box"),
    "no dt": (lambda: GymPlant(gymnasium.make("MountainCarContinuous-v0")), "`dt` must be .* states none"),
    "dt": (lambda: GymPlant(Lag(), dt=0.0), "`dt` must be a positive sampling time"),
    "outputs": (lambda: GymPlant(Lag(), outputs=[2]), r"entries 0 to 1 of the observation, got \[2\]"),
    "no outputs": (lambda: GymPlant(Lag(), outputs=[]), "`outputs` must name entries"),
    "vector": (lambda: GymPlant(gymnasium.make_vec("Pendulum-v1", 2)), "`env` must be one environment"),
    "not an env": (lambda: GymPlant(object()), "`action_space` must be"),
    "action": (lambda: _started().step([2.1, 0.0]), r"within the action space, .* Give the layer `u_set=plant.u_set`"),
    "shape": (lambda: _started().step([0.0]), r"`u` must have shape \(2,\), got \(1,\)"),
}


def _started():
    plant = GymPlant(Lag())
    plant.reset()
    return plant


@pytest.mark.parametrize("case", BAD_CALLS)
def test_bad_input_is_named(case):
    call, message = BAD_CALLS[case]
    with pytest.raises(ValueError, match=message):
        call()


def test_not_started():
    with pytest.raises(RuntimeError, match="call `reset`"):
        GymPlant(Lag()).measure()
