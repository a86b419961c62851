"""The attacker's environment."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import Y_REF, generator, masses_data, small_layer
from torch_dpc import attacks

pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from torch_dpc.envs import AttackEnv  # noqa: E402

U_TARGET = torch.tensor([0.5, -0.5])


def make_env(budget=None, noise=0.0, **options):
    plant = dpc.systems.OscillatingMasses(noise=noise, generator=generator(5))
    controller = dpc.DPCController(small_layer(), replan_every=4)
    options = {"y_ref": Y_REF, "steps": 20, "start": lambda rng: {"state": rng.normal(size=4)}, **options}
    return AttackEnv(plant, controller, budget or attacks.RelativeBall(0.1), attacks.TargetInput(U_TARGET), **options)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_gymnasium_accepts_it_without_a_warning(noise):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make_env(noise=noise))


def test_gymnasium_accepts_a_plant_that_has_no_copy():
    pytest.importorskip("pybullet")
    with dpc.systems.Quadrotor() as plant, warnings.catch_warnings():
        warnings.simplefilter("error")
        u, y = dpc.collect(plant, 150, amplitude=0.3, hold=5, generator=generator())
        data = dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=8)
        layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e3, u_set=dpc.Box(-1.0, 1.0))
        reference = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        cost = attacks.TargetInput(torch.tensor([0.0, 1.0, 0.0]))
        check_env(AttackEnv(plant, dpc.DPCController(layer), attacks.RelativeBall(0.003), cost, y_ref=reference))


def test_an_episode_is_the_run_that_simulate_makes():
    """The same perturbations, handed to `simulate` as an attack, give the same inputs, outputs and costs."""
    env, state = make_env(), torch.tensor([0.3, -0.2, 0.1, 0.4], dtype=torch.float64)
    env.reset(options={"state": state})
    source, steps, over = np.random.default_rng(0), [], False
    while not over:
        *_, over, info = env.step(source.uniform(-1, 1, 12))
        steps.append(info)
    costs = []

    def replay(u_ini, y_ini, *, y_ref, u_ref, generator, step):
        p = torch.as_tensor(steps[step // 4]["p"])
        costs.append(float(env.cost(env.controller.layer(u_ini, y_ini + p, y_ref=y_ref, u_ref=u_ref))))
        return p

    controller = dpc.DPCController(small_layer(), replan_every=4)
    plant = dpc.systems.OscillatingMasses()
    log = dpc.simulate(plant, controller, Y_REF, steps=20, attack=replay, reset={"state": state})
    for name in ("u", "y"):
        np.testing.assert_allclose(np.concatenate([s[name] for s in steps]), getattr(log, name), atol=1e-12)
    np.testing.assert_allclose([s["cost"] for s in steps], costs, rtol=1e-9)
    assert len(steps) == 5


def test_algorithm_1_earns_more_than_noise_and_nothing():
    """The reward is the attacker's: Algorithm 1, translated into actions, earns more than the random benchmark."""
    budget = attacks.RelativeBall(0.1)
    env, earned = make_env(budget), {}
    attack = attacks.LinearizedAttack(env.controller.layer, env.cost, budget)
    source = np.random.default_rng(0)

    def algorithm_1(env):
        u_ini, y_ini, refs = env.window()
        p = attack(u_ini, y_ini, **refs)
        return (p / (0.1 * y_ini.norm())).reshape(-1).numpy()  # the reach of a ball is its radius

    choices = {"nothing": lambda env: np.zeros(12), "noise": lambda env: source.uniform(-1, 1, 12), "best": algorithm_1}
    for name, choose in choices.items():
        env.reset(seed=0)
        earned[name] = sum(env.step(choose(env))[1] for _ in range(5))
    assert earned["best"] > earned["noise"]
    assert earned["best"] > earned["nothing"] + 0.1


BUDGETS = {
    "ball": attacks.BallBudget(0.2),
    "relative": attacks.RelativeBall(0.1),
    "box": attacks.BoxBudget(torch.tensor([0.1, 0.2, 0.0, 0.3])),
    "l1": attacks.L1BallBudget(0.3),
    "ellipsoid": attacks.EllipsoidBudget(torch.tensor([0.1, 0.2, 0.1, 0.3])),
}


@pytest.mark.parametrize("name", BUDGETS)
def test_actions_stay_in_the_budget_and_reach_all_of_it(name):
    budget, env = BUDGETS[name], make_env(BUDGETS[name])
    env.reset(seed=1)
    _, y_ini, _ = env.window()
    for seed in range(5):
        p = env.perturbation(np.random.default_rng(seed).uniform(-1, 1, 12), y_ini)
        assert float(budget.excess(p, y_ini)) <= 1e-9
        wanted = budget.random(y_ini, generator(seed))  # spends the whole budget
        units = torch.eye(12, dtype=torch.float64).unflatten(-1, (3, 4))
        reach = (budget.minimize_linear(-units, y_ini.expand_as(units)) * units).sum(0)
        action = torch.where(reach > 0, wanted / reach, 0.0).reshape(-1)
        assert action.abs().max() <= 1 + 1e-12
        torch.testing.assert_close(env.perturbation(action.numpy(), y_ini), wanted, rtol=0, atol=1e-12)
    assert not env.perturbation(np.zeros(12), y_ini).any()


def test_the_observation_is_what_the_docstring_says():
    env = make_env(steps=8)
    observation, _ = env.reset(options={"state": torch.ones(4, dtype=torch.float64)})
    data = masses_data(1e-2, steps=150, t_ini=3, horizon=6)
    sizes = [3 * 2, 3 * 4, 6 * data.n_u, 6 * data.n_y, 1]
    u_ini, y_ini, u_ref, y_ref, elapsed = np.split(observation, np.cumsum(sizes)[:-1])
    plant = dpc.systems.OscillatingMasses()
    y = [plant.reset(torch.ones(4, dtype=torch.float64)), *(plant.step(torch.zeros(2)) for _ in range(2))]
    np.testing.assert_allclose(y_ini, torch.cat(y), atol=1e-15)
    assert not u_ini.any() and not u_ref.any()
    np.testing.assert_array_equal(y_ref.reshape(6, 4), np.tile(Y_REF, (6, 1)))
    assert elapsed == 0
    assert env.step(np.zeros(12))[0][-1] == 0.5


def test_bad_arguments_are_named():
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"`action` must be finite and have shape \(12,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="`action` must be finite"):
        env.step(np.full(12, np.nan))
    with pytest.raises(ValueError, match="`steps` must be a positive integer, got 0"):
        make_env(steps=0)
    with pytest.raises(ValueError, match="`y_ref` must have shape"):
        make_env(y_ref=torch.zeros(3))
    with pytest.raises(ValueError, match="the plant has 3 inputs and 6 outputs, the controller's data 2 and 4"):
        AttackEnv(
            dpc.systems.TorchQuadrotor(), env.controller, attacks.RelativeBall(0.1), attacks.TargetInput(U_TARGET)
        )


def test_without_gymnasium_the_error_says_what_to_install():
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "try:\n    import torch_dpc.envs\n"
        "except ImportError as error:\n    assert \"pip install 'torch_dpc[gym]'\" in str(error)\n"
        "else:\n    raise SystemExit('no error')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_importing_the_package_does_not_import_gymnasium():
    code = "import sys, torch_dpc; assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
