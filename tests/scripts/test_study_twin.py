"""The studies that learn on many vehicles and by policy gradient, in small."""

import pytest
import torch

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")
pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")
pytest.importorskip("safetensors", reason="checkpoints need safetensors")

from helpers import generator, relative
from scripts.experiments.quadrotor_twin import QuadrotorTwin
from torch_dpc import attacks


@pytest.fixture(scope="module")
def planned():
    pytest.importorskip("pybullet", reason="the controller's recording is flown in PyBullet")
    case = QuadrotorTwin(n_g=150, t_ini=4, horizon=12, run_steps=25, replan_every=5)
    return case, case.planner(100)


def test_laps_under_attack_are_those_of_pybullet(planned):
    from scripts.experiments.quadrotor import fly_lap

    case, layer = planned
    attack = attacks.LinearizedAttack(layer, case.target(), attacks.RelativeBallBudget(0.003))
    flown = [fly_lap(case, layer, attack, start, None) for start in (0, 90)]
    assert not any(down.any() for _, down in flown)
    y, commands = (torch.stack([getattr(log, name) for log, _ in flown]) for name in ("y", "u"))
    assert (case.replay(y[:, 0, :3], commands) - y).abs().max() < 1e-10  # m and rad, over 10 s
    with torch.no_grad():  # in closed loop an attack amplifies rounding: its direction jumps where bounds become active
        log = case.fly(layer, attack, torch.tensor([0]), 50)
    assert (log.y[0] - y[0, :50]).abs().max() < 1e-9


def test_the_gradient_of_a_run_is_that_of_differences(planned):
    case, layer = planned
    starts = torch.tensor([0, 100])
    direction = torch.randn(2, case.t_ini, 6, dtype=torch.float64, generator=generator())

    def error(amount):
        """Return the mean error where the last p of every plan is moved by an amount along a direction."""
        outputs, windows = case.loop(layer, lambda u, y, **_: 1e-3 * (1 + amount)[:, None, None] * direction, starts)
        assert len(windows) == 2 * 2
        return case.mean_errors(outputs, starts)

    amount = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    (exact,) = torch.autograd.grad(error(amount).sum(), amount)
    with torch.no_grad():
        differences = (error(amount + 1e-4) - error(amount - 1e-4)) / 2e-4
    assert relative(exact, differences) < 1e-5


def test_a_policy_gradient_runs_and_is_judged(monkeypatch):
    pytest.importorskip("gymnasium")
    from scripts import train_attack_env as study

    for name, value in {"UPDATES": 2, "STARTS": 2, "REPEATS": 3, "HELD_OUT": 3, "STEPS": 20}.items():
        monkeypatch.setattr(study, name, value)
    env = study.make_env()
    policy, returns = study.train(env, 0)
    assert len(returns) == 2
    assert policy.map.weight.abs().sum() > 0
    costs = study.judge(env, policy)
    assert {len(cost) for cost in costs.values()} == {3}
    assert costs["Algorithm 1"].mean() < costs["no attack"].mean()
