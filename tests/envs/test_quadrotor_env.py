"""The quadrotor as a Gymnasium environment."""

import warnings

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from torch_dpc.envs import QuadrotorEnv  # noqa: E402

ID = "torch_dpc/Quadrotor-v0"


@pytest.mark.parametrize("physics", ["torch", "bullet"])
def test_gymnasium_accepts_it_without_a_warning(physics):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    env = gymnasium.make(ID, physics=physics)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=physics == "torch")  # pictures are PyBullet's
    env.close()


def fly(env, actions):
    observations = [env.reset(seed=3)[0]]
    rewards = []
    for action in actions:
        observation, reward, terminated, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        assert not terminated
    return np.array(observations), np.array(rewards)


def test_both_physics_are_one_environment():
    pytest.importorskip("pybullet")
    actions = np.repeat(np.random.default_rng(0).uniform(-0.3, 0.3, (5, 3)), 10, axis=0)
    flights = []
    for physics in ("torch", "bullet"):
        with gymnasium.make(ID, physics=physics) as env:
            flights.append(fly(env, actions))
    for a, b in zip(*flights, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)


def test_observation_and_reward():
    observations, rewards = fly(QuadrotorEnv(target=(0.5, 0.0, 1.2)), np.full((30, 3), [0.2, 0.0, 0.0]))
    np.testing.assert_allclose(observations[1:, 6:], np.diff(observations[:, :6], axis=0) / 0.04, atol=1e-12)
    np.testing.assert_allclose(rewards, -np.linalg.norm(observations[1:, :3] - [0.5, 0.0, 1.2], axis=1))
    assert observations[-1, 6] == pytest.approx(0.2, abs=0.03)  # the velocity that was asked for
    assert np.abs(observations[0, :3] - [0.5, 0.0, 1.2]).max() <= 0.5


def test_a_policy_of_one_line_reaches_the_target():
    env = gymnasium.make(ID)
    observation, _ = env.reset(seed=0)
    for _ in range(150):
        observation, reward, terminated, truncated, _ = env.step(([0.0, 0.0, 1.0] - observation[:3]).clip(-0.4, 0.4))
        assert not terminated
    assert reward > -0.01


def test_touching_the_ground_terminates():
    env = QuadrotorEnv()
    env.reset(options={"position": (0.0, 0.0, 0.2)})
    for _ in range(30):
        *_, terminated, _, _ = env.step(np.array([0.0, 0.0, -0.5]))
        if terminated:
            return
    raise AssertionError("did not end")


def test_pictures():
    pytest.importorskip("pybullet")
    with gymnasium.make(ID, render_mode="rgb_array") as env:
        env.reset(seed=0)
        picture = env.render()
    assert picture.shape == (240, 320, 3)
    assert picture.std() > 0


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match='`render_mode` must be None or "rgb_array", got \'human\''):
        QuadrotorEnv(render_mode="human")
    with pytest.raises(ValueError, match='`physics` must be "torch" or "bullet", got \'mujoco\''):
        QuadrotorEnv(physics="mujoco")
    with pytest.raises(ValueError, match='needs `physics="bullet"`'):
        QuadrotorEnv(physics="torch", render_mode="rgb_array")
    with pytest.raises(ValueError, match="`target` must be a point"):
        QuadrotorEnv(target=(0.0, 0.0, 0.1))
