"""Attacks on a whole run, ensembles, and the curve of damage against budget."""

import functools

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, masses_data, relative, small_layer, windows
from torch_dpc import attacks

REFS = {"y_ref": 0.2 * Y_REF, "u_ref": 0.2 * HOLDING}
COST = attacks.TargetInput(torch.tensor([0.3, -0.4]))
EACH = attacks.PerSampleBudget(attacks.Ball(0.05))


@functools.cache
def layer(seed=0):
    data = masses_data(0.0, steps=150, t_ini=3, horizon=12, seed=seed)
    return dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-1.0, 1.0))


def run(plant, controller, attack, seed, steps=40, **options):
    start = 0.2 * Y_REF + 0.1 * torch.randn(4, dtype=torch.float64, generator=generator(seed))
    refs = {"u_ref": 0.2 * HOLDING, "u_warmup": 0.2, "generator": generator(seed)}
    return dpc.simulate(
        plant, controller, 0.2 * Y_REF, steps=steps, attack=attack, reset={"state": start}, **refs, **options
    )


def damage(log):
    return float((log.y - log.y_ref)[:, :2].square().sum(-1).mean())


def signal_attack(plant, controller, **options):
    first = attacks.LinearizedAttack(controller.layer, attacks.TrackingError(controller.layer.data, 10.0), EACH)
    error = attacks.RunError([0, 1])
    return attacks.SignalAttack(plant, controller, error, EACH, plans=3, steps=8, first_guess=first, **options)


# --- signals ----------------------------------------------------------------------------------------------------------


def test_it_does_more_damage_than_algorithm_1_at_the_same_budget_of_each_sample():
    wins = []
    for seed in range(10):
        plant, controller = dpc.systems.OscillatingMasses(), dpc.DPCController(layer(seed), 5)
        target = attacks.TargetInput(torch.tensor([1.0, 1.0]))
        one_step = [
            attacks.LinearizedAttack(layer(seed), target, EACH),
            attacks.LinearizedAttack(layer(seed), attacks.TrackingError(layer(seed).data, 10.0), EACH),
        ]
        signal = run(plant, controller, signal_attack(plant, controller), seed)
        assert (torch.linalg.vector_norm(signal.p, dim=-1) <= 0.05 * (1 + 1e-9)).all()
        wins.append(damage(signal) >= max(damage(run(plant, controller, one, seed)) for one in one_step))
    assert sum(wins) >= 9


def test_what_was_reported_stays():
    plant, controller = dpc.systems.OscillatingMasses(), dpc.DPCController(layer(), 1)
    log = run(plant, controller, signal_attack(plant, controller), 0, steps=8)
    assert log.p[:, -1].abs().amax(-1).min() > 0
    for k in range(1, 8):
        torch.testing.assert_close(log.p[k, :-1], log.p[k - 1, 1:], rtol=0, atol=1e-12)
    again = run(plant, controller, signal_attack(plant, controller), 0, steps=8)
    assert torch.equal(log.p, again.p)


def test_looking_ahead_does_not_move_the_plant():
    seen = dpc.systems.OscillatingMasses(noise=0.01, generator=generator(3))
    blind = dpc.systems.OscillatingMasses(noise=0.01, generator=generator(3))
    controller = dpc.DPCController(layer(), 5)
    signal = signal_attack(seen, controller)
    log = run(seen, controller, signal, 1, steps=10)
    replayed = run(blind, controller, lambda u_ini, y_ini, *, step, **_: log.p[step], 1, steps=10)
    assert torch.equal(log.y, replayed.y)


def test_a_batch_of_runs_is_attacked_run_by_run():
    plant, controller = dpc.systems.OscillatingMasses(), dpc.DPCController(layer(), 5)
    starts = 0.2 * Y_REF + 0.1 * torch.randn(3, 4, dtype=torch.float64, generator=generator(5))
    attack = attacks.SignalAttack(plant, controller, attacks.RunError(), attacks.Ball(0.1), plans=2, steps=4)
    log = dpc.simulate(plant, controller, 0.2 * Y_REF, steps=10, attack=attack, reset={"state": starts})
    assert log.p.shape == (3, 10, 3, 4)
    assert (torch.linalg.vector_norm(log.p, dim=(-2, -1)) <= 0.1 * (1 + 1e-9)).all()
    assert log.p.abs().amax((1, 2, 3)).min() > 0


def test_a_plant_that_cannot_go_back_is_refused():
    class Hardware:
        n_u, n_y, dt = 2, 4, 0.1

    with pytest.raises(ValueError, match="`plant` must have `snapshot"):
        attacks.SignalAttack(Hardware(), dpc.DPCController(layer()), attacks.RunError(), EACH)


# --- budgets of each sample -------------------------------------------------------------------------------------------


def test_a_budget_of_each_sample_is_its_budget_row_by_row():
    u_ini, y_ini = windows(5, 3, seed=2)
    budget = attacks.PerSampleBudget(attacks.RelativeBall(0.1))
    c = torch.randn(5, 3, 4, dtype=torch.float64, generator=generator(1))
    expected = -0.1 * y_ini.norm(dim=-1, keepdim=True) * c / c.norm(dim=-1, keepdim=True)
    assert relative(budget.minimize_linear(c, y_ini), expected) < 1e-12
    assert budget.excess(expected, y_ini).abs().max() < 1e-12
    assert budget.excess(1.01 * expected, y_ini).min() > 5e-3


# --- ensembles --------------------------------------------------------------------------------------------------------


def test_an_ensemble_is_the_strongest_of_its_members_on_every_sample():
    planner = small_layer()
    u_ini, y_ini = windows(30, 3, seed=4, scale=0.3)
    ball, box = attacks.RelativeBall(0.1), attacks.Box(0.02)
    members = [
        attacks.LinearizedAttack(planner, COST, ball),
        attacks.ProjectedGradientAttack(planner, COST, box, 10),
        attacks.RandomAttack(ball),
    ]
    p = attacks.Ensemble(members)(u_ini, y_ini, **REFS, generator=generator(1))
    psi = COST(planner(u_ini, y_ini + p, **REFS))
    source = generator(1)
    each = [COST(planner(u_ini, y_ini + one(u_ini, y_ini, **REFS, generator=source), **REFS)) for one in members]
    torch.testing.assert_close(psi, torch.stack(each).amin(0), rtol=1e-9, atol=0)
    assert len({int(i) for i in torch.stack(each).argmin(0)}) > 1  # no member is the strongest everywhere


def test_an_ensemble_needs_a_judge():
    with pytest.raises(ValueError, match="at least one attack"):
        attacks.Ensemble([])
    with pytest.raises(ValueError, match="give `layer=` and `cost=`"):
        attacks.Ensemble([attacks.RandomAttack(attacks.Ball(0.1))])


# --- the curve --------------------------------------------------------------------------------------------------------


def test_damage_grows_along_the_curve():
    plant, controller = dpc.systems.OscillatingMasses(), dpc.DPCController(layer(), 5)
    attack = attacks.LinearizedAttack(layer(), attacks.TargetInput(torch.ones(2)), attacks.Ball(0.0))
    starts = 0.2 * Y_REF + 0.1 * torch.randn(4, 4, dtype=torch.float64, generator=generator(5))
    options = {"y_ref": 0.2 * Y_REF, "u_ref": 0.2 * HOLDING, "steps": 20, "reset": {"state": starts}}
    curve = attacks.robustness_curve(plant, controller, attack, [0.1, 0.6], channels=[0, 1], **options)
    assert curve.rhos.tolist() == [0.0, 0.1, 0.6] and curve.errors.shape == (3, 4)
    assert curve.errors[2].mean() > 1.1 * curve.errors[0].mean() and "60.000%" in str(curve)
    by_factory = attacks.robustness_curve(
        plant,
        controller,
        lambda rho: attacks.LinearizedAttack(layer(), attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(rho)),
        [0.1, 0.6],
        channels=[0, 1],
        **options,
    )
    assert torch.equal(curve.errors, by_factory.errors)
    with pytest.raises(ValueError, match="`rhos` must hold"):
        attacks.robustness_curve(plant, controller, attack, [])
