"""The defender: rates of false alarms, known statistics, alarms in the loop, and budgets that pass the detector."""

import functools

import pytest
import torch
from scipy.optimize import minimize

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, masses_data, randn, relative, small_layer, windows
from torch_dpc import attacks
from torch_dpc.detection import ConsistencyDetector, Cusum
from torch_dpc.detection.cusum import run

RATE = 0.05


def recording(noise, seed, steps=1500):
    """The energy of undamped masses under random inputs grows for ever; damped ones have a usual one."""
    source = generator(seed)
    plant = dpc.systems.OscillatingMasses(noise=noise, generator=source, damping=0.0 if noise else 0.5)
    return dpc.collect(plant, steps, generator=source)


@functools.cache
def detector(noise, rate=RATE):
    data = dpc.HankelData.from_trajectories(*recording(noise, 0, steps=600), t_ini=3, horizon=6)
    recordings = [recording(noise, seed) for seed in range(1, 5)]
    return ConsistencyDetector(data).calibrate(*zip(*recordings, strict=True), false_alarms=rate)


# --- statistics ---------------------------------------------------------------------------------------------------


def test_noise_free_windows_have_no_residual_and_others_have():
    judge = detector(0.0)
    u_ini, y_ini = judge.windows(*recording(0.0, 9, steps=52))
    assert judge.rank == 3 * 2 + 4  # inputs of the window, and the order of the system
    assert judge.statistic(u_ini, y_ini).residual.max() < 1e-6
    assert judge.statistic(u_ini, y_ini + 1e-6 * randn(50, 3, 4)).residual.min() > 1e3


def test_the_energy_is_n_times_the_squared_least_norm_combination():
    data = masses_data(0.0, steps=200, t_ini=3, horizon=6)
    W = torch.cat([data.Up, data.Yp])
    u_ini, y_ini = windows(5, 3, seed=9)
    w = torch.cat([u_ini.flatten(1), y_ini.flatten(1)], dim=1)
    g = torch.linalg.lstsq(W, w.T, rcond=1e-9, driver="gelsd").solution
    expected = data.n_g * g.square().sum(0)
    assert relative(ConsistencyDetector(data).statistic(u_ini, y_ini).energy, expected) < 1e-8


def test_with_noise_both_parts_are_the_mahalanobis_distance():
    data = masses_data(1e-2, steps=600, t_ini=3, horizon=6)
    W = torch.cat([data.Up, data.Yp])
    u_ini, y_ini = windows(5, 3, seed=9, noise=1e-2)
    w = torch.cat([u_ini.flatten(1), y_ini.flatten(1)], dim=1)
    expected = (w @ torch.linalg.inv(W @ W.T / data.n_g) * w).sum(1)
    judge = ConsistencyDetector(data)
    assert judge.rank == 10
    assert relative(sum(judge.statistic(u_ini, y_ini)), expected) < 1e-8


def test_compact_data_judge_alike():
    data = masses_data(1e-2, steps=600, t_ini=3, horizon=6)
    u_ini, y_ini = windows(5, 3, seed=9, noise=1e-2)
    whole, compact = (ConsistencyDetector(one).statistic(u_ini, y_ini) for one in (data, data.compressed()))
    assert relative(compact.energy, whole.energy) < 1e-8 and relative(compact.residual, whole.residual) < 1e-8


# --- rates ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("rate", [0.01, RATE])
def test_false_alarms_on_fresh_data_are_near_the_stated_rate(noise, rate):
    judge = detector(noise, rate)
    fresh = [recording(noise, seed) for seed in range(20, 26)]
    alarms = judge.alarms(*judge.windows(*zip(*fresh, strict=True))).double().mean()
    assert 0.5 * rate <= alarms <= 2 * rate


def test_cusum_sees_what_a_single_window_does_not():
    judge = detector(1e-2)
    sums = judge.cusum(false_alarms=0.01)
    u_ini, y_ini = judge.windows(*recording(1e-2, 31, steps=1500))
    worn = y_ini + 7e-3 * randn(*y_ini.shape, seed=3)  # sensors with half again the variance of their noise
    at = sums.monitor()
    by_sum = torch.stack([at(u, y) for u, y in zip(u_ini, worn, strict=True)]).double().mean()
    clean = sums.monitor()
    false = torch.stack([clean(u, y) for u, y in zip(u_ini, y_ini, strict=True)]).double().mean()
    assert false <= 0.02 and by_sum > 5 * max(float(false), 0.01)


def test_cusum_by_hand():
    scores = torch.tensor([1.0, 3.0, 0.0, 2.5, 2.5, 2.5])
    assert run(scores, 1.0, 2.4).tolist() == [False, False, False, True, False, True]  # sums 0, 2, 1, 2.5 -> 0, 1.5, 3
    at = Cusum(lambda u, y: y[..., 0, 0], 1.0, 2.4).monitor()
    y = scores[:, None, None, None].expand(6, 2, 1, 1)
    assert [at(y[k], y[k]).tolist() for k in range(6)] == [[a, a] for a in run(scores, 1.0, 2.4).tolist()]


# --- in the loop ------------------------------------------------------------------------------------------------------


def loop(attack=None, judge=None, **options):
    plant = dpc.systems.OscillatingMasses(damping=0.5)
    controller = dpc.DPCController(small_layer(0.0), 3, **options)
    refs = {"u_ref": 0.2 * HOLDING, "reset": {"state": 0.2 * Y_REF}, "u_warmup": 0.2}
    return dpc.simulate(plant, controller, 0.2 * Y_REF, steps=12, attack=attack, detector=judge, **refs)


def test_alarms_are_in_the_log_and_a_controller_can_hold():
    judge = detector(0.0)
    assert not loop().alarm.any() and loop().alarm.dtype == torch.bool
    assert not loop(judge=judge).alarm.any()

    def from_step_6(u_ini, y_ini, *, step, **_):
        return torch.full_like(y_ini, 0.3 if step >= 6 else 0.0).cumsum(0)

    log = loop(from_step_6, judge)
    assert log.alarm.tolist() == [False] * 6 + [True] * 6
    held = loop(from_step_6, judge, on_alarm="hold")
    clean = loop()
    torch.testing.assert_close(held.u[:6], clean.u[:6])
    assert (held.y - clean.y).abs().max() < (log.y - clean.y).abs().max()
    with pytest.raises(ValueError, match="`on_alarm` must be"):
        loop(on_alarm="panic")


def test_a_batch_of_runs_has_its_own_alarms():
    plant, judge = dpc.systems.OscillatingMasses(damping=0.5), detector(0.0)

    def second_run(u_ini, y_ini, **_):
        p = torch.zeros_like(y_ini)
        p[1, -1] = 0.3
        return p

    start = torch.stack([0.2 * Y_REF] * 2)
    controller = dpc.DPCController(small_layer(0.0), 3, on_alarm="hold")
    log = dpc.simulate(
        plant, controller, 0.2 * Y_REF, steps=6, reset={"state": start}, attack=second_run, detector=judge
    )
    assert log.alarm.shape == (2, 6) and not log.alarm[0].any() and log.alarm[1].all()


# --- stealthy budgets -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-2])
@pytest.mark.parametrize("ball", [attacks.Ball(0.3), attacks.RelativeBall(0.1)], ids=["ball", "relative"])
def test_every_stealthy_attack_passes_its_detector(noise, ball):
    judge, layer = detector(noise), small_layer(noise)
    budget, cost = attacks.Stealthy(ball, judge), attacks.TargetInput(torch.tensor([0.3, -0.4]))
    u_ini, y_ini = judge.windows(*recording(noise, 41, steps=60))
    clean = judge.alarms(u_ini, y_ini)
    for attack in (
        attacks.RandomAttack(budget),
        attacks.LinearizedAttack(layer, cost, budget),
        attacks.ProjectedGradientAttack(layer, cost, budget, 5),
        attacks.FrankWolfeAttack(layer, cost, budget, 5),
        attacks.RandomSearchAttack(layer, cost, budget, queries=5),
    ):
        p = attack(u_ini, y_ini, generator=generator())
        assert not (judge.alarms(u_ini, y_ini + p) & ~clean).any()
        assert ball.excess(p, y_ini).max() <= 1e-9 and p[~clean].abs().amax((-2, -1)).median() > 1e-4


def test_the_linear_minimiser_is_optimal():
    judge = detector(1e-2)
    budget = attacks.Stealthy(attacks.Ball(0.05), judge)
    u_ini, y_ini = windows(4, 3, seed=3, scale=0.3, noise=1e-2)
    c = randn(4, 3, 4, seed=5)
    bound = budget.given(u_ini)
    p = bound.minimize_linear(c, y_ini)
    assert bound.excess(p, y_ini).max() <= 1e-9
    for i in range(4):
        if judge.alarms(u_ini[i], y_ini[i]):
            continue
        constraints = [
            {"type": "ineq", "fun": lambda x: 0.05**2 - (x**2).sum()},
            {
                "type": "ineq",
                "fun": lambda x, i=i: 1 - float(judge.score(u_ini[i], y_ini[i] + torch.from_numpy(x).reshape(3, 4))),
            },
        ]
        flat = c[i].flatten().numpy()
        best = minimize(
            lambda x, f=flat: f @ x, 0 * flat, constraints=constraints, options={"ftol": 1e-12, "maxiter": 500}
        )
        assert float((c[i] * p[i]).sum()) <= best.fun + 1e-5 * abs(best.fun)


def test_the_projection_is_the_nearest_point():
    judge = detector(1e-2)
    u_ini, y_ini = windows(6, 3, seed=3, scale=0.3, noise=1e-2)
    budget = attacks.Stealthy(attacks.Ball(0.05), judge).given(u_ini)
    far = 0.1 * randn(6, 3, 4, seed=6)
    p = budget.project(far, y_ini)
    for seed in range(20):  # <far - p, q - p> <= 0 for every q of the set
        q = budget.random(y_ini, generator(seed))
        assert (((far - p) * (q - p)).sum((-2, -1)) <= 1e-6 * (far - p).square().sum((-2, -1))).all()
    torch.testing.assert_close(budget.project(0.5 * p, y_ini), 0.5 * p, atol=1e-9, rtol=0)


def test_the_worst_stealthy_case_is_above_the_worst_case():
    pytest.importorskip("clarabel", reason="extra `exact`")
    judge, layer, cost = detector(1e-3), small_layer(), attacks.TargetInput(torch.tensor([0.3, -0.4]))
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=3, scale=0.3, noise=1e-3))
    ball = attacks.Ball(0.1)
    refs = {"y_ref": 0.2 * Y_REF, "u_ref": 0.2 * HOLDING}
    free = attacks.worst_case(layer, cost, ball, u_ini, y_ini, **refs)
    quiet = attacks.worst_case(layer, cost, attacks.Stealthy(ball, judge), u_ini, y_ini, **refs)
    assert free.status == quiet.status == "optimal" and float(quiet.value) > float(free.value)
    assert not judge.alarms(u_ini, y_ini + quiet.p)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_bad_input_is_named():
    data = masses_data(0.0, steps=200, t_ini=3, horizon=6)
    fresh = ConsistencyDetector(data)
    u, y = recording(0.0, 1, steps=40)
    with pytest.raises(ValueError, match="the detector has no level of alarm"):
        fresh.alarms(u[:3], y[:3])
    with pytest.raises(ValueError, match="needs at least 99 windows, got 38"):
        fresh.calibrate(u, y, false_alarms=0.01)
    with pytest.raises(ValueError, match="`false_alarms` must be between 0 and 1"):
        fresh.calibrate(u, y, false_alarms=0.0)
    with pytest.raises(ValueError, match="must have 2 and 4 channels, got 2 and 3"):
        fresh.calibrate(u, y[:, :3])
    with pytest.raises(ValueError, match="`rank` must be an integer from 1 to 18"):
        ConsistencyDetector(data, rank=0)
    with pytest.raises(ValueError, match="must be a BallBudget or RelativeBallBudget, got BoxBudget"):
        attacks.Stealthy(attacks.Box(0.1), detector(0.0))
    with pytest.raises(ValueError, match="needs the inputs of the window"):
        attacks.Stealthy(attacks.Ball(0.1), detector(0.0)).project(y[:3], y[:3])
