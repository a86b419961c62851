"""Attacks on past inputs and references, and attacks that take the controller's plan away."""

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, delayed_layer, delayed_windows, generator, small_layer, windows
from torch_dpc import attacks

COST = attacks.TargetInput(torch.tensor([0.3, -0.4]))
SHAPES = {"y_ini": (3, 4), "u_ini": (3, 2), "y_ref": (6, 4), "u_ref": (6, 2)}


def refs():
    return {"y_ref": (0.2 * Y_REF).expand(6, 4), "u_ref": (0.2 * HOLDING).expand(6, 2)}


def told(signal, u_ini, y_ini, p):
    arguments = {"u_ini": u_ini, "y_ini": y_ini, **refs()}
    arguments[signal] = arguments[signal] + p
    return arguments


@pytest.mark.parametrize("signal", SHAPES)
@pytest.mark.parametrize("batch", [(), (5,)], ids=str)
def test_the_same_attack_on_another_signal(signal, batch):
    layer, budget = small_layer(), attacks.Ball(0.05)
    u_ini, y_ini = (w[0] if not batch else w for w in windows(5, 3, seed=4, scale=0.3))
    nominal = COST(layer(u_ini, y_ini, **refs()))
    psi = []
    for attack in (
        attacks.RandomAttack(budget),
        attacks.LinearizedAttack(layer, COST, budget),
        attacks.ProjectedGradientAttack(layer, COST, budget, 10),
    ):
        p = attacks.AttackOn(signal, attack)(u_ini, y_ini, **refs(), generator=generator())
        if isinstance(attack, attacks.RandomAttack) and signal.endswith("ref"):
            assert p.shape == SHAPES[signal]  # one direction for the reference that the batch shares
        else:
            assert p.shape == (*batch, *SHAPES[signal])
        assert (torch.linalg.vector_norm(p, dim=(-2, -1)) <= 0.05 * (1 + 1e-9)).all()
        psi.append(COST(layer(**told(signal, u_ini, y_ini, p))))
    assert (psi[2] <= psi[1] + 1e-12).all() and (psi[1] < nominal).all()
    assert (psi[0] > psi[2]).all()


@pytest.mark.parametrize("signal", SHAPES)
def test_its_first_step_is_along_the_gradient_of_that_signal(signal):
    layer, budget = small_layer(), attacks.Ball(1e-3)
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=4, scale=0.3))
    zero = torch.zeros(SHAPES[signal], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(COST(layer(**told(signal, u_ini, y_ini, zero))), zero)
    p = attacks.AttackOn(signal, attacks.LinearizedAttack(layer, COST, budget))(u_ini, y_ini, **refs())
    torch.testing.assert_close(p, -1e-3 * slope / slope.norm(), rtol=1e-9, atol=1e-15)


def test_on_y_ini_it_is_the_attack_itself():
    layer, (u_ini, y_ini) = small_layer(), windows(4, 3, seed=4, scale=0.3)
    for cost in (COST, attacks.TrackingError(layer.data, 10.0)):
        attack = attacks.ProjectedGradientAttack(layer, cost, attacks.RelativeBall(0.1), 8)
        expected = attack(u_ini, y_ini, **refs())
        torch.testing.assert_close(attacks.AttackOn("y_ini", attack)(u_ini, y_ini, **refs()), expected)


def test_the_tracking_error_stays_that_of_the_true_reference():
    layer, (u_ini, y_ini) = small_layer(), windows(4, 3, seed=4, scale=0.3)
    cost = attacks.TrackingError(layer.data, 10.0)
    attack = attacks.AttackOn("y_ref", attacks.LinearizedAttack(layer, cost, attacks.Ball(0.1)))
    p = attack(u_ini, y_ini, **refs())
    judge = cost.given(u_ini=u_ini, y_ini=y_ini, **refs())
    assert (judge(layer(**told("y_ref", u_ini, y_ini, p))) < judge(layer(u_ini, y_ini, **refs()))).all()


def test_what_it_does_not_take_is_named():
    layer = small_layer()
    with pytest.raises(ValueError, match="`signal` must be one of"):
        attacks.AttackOn("g", attacks.LinearizedAttack(layer, COST, attacks.Ball(0.1)))
    with pytest.raises(ValueError, match="got Ensemble"):
        attacks.AttackOn("u_ini", attacks.Ensemble([attacks.LinearizedAttack(layer, COST, attacks.Ball(0.1))]))
    attack = attacks.AttackOn("u_ini", attacks.LinearizedAttack(layer, COST, attacks.Ball(0.1)))
    with pytest.raises(ValueError, match="must be an attack on y_ini"):
        plant = dpc.systems.OscillatingMasses()
        dpc.simulate(plant, dpc.DPCController(layer, 3), 0.2 * Y_REF, steps=6, attack=attack)


@pytest.mark.parametrize("kind", ["linearised", "projected"])
def test_a_violation_is_a_plan_that_hard_bounds_do_not_have(kind):
    """In this plant the last past input is an output of the first planned step, bounded by 0.5."""
    lower, upper = torch.tensor([-0.3, -0.5]), torch.tensor([0.3, 0.5])
    hard, soft = delayed_layer(), delayed_layer(y_set=dpc.SoftBox(lower, upper, weight=1e3))
    u_ini, y_ini = delayed_windows(40)
    assert (hard(u_ini, y_ini, on_failure="nan").info.status == dpc.Status.SOLVED).all()
    budget, source, cost = attacks.Ball(0.15), generator(2), attacks.BoundViolation([-3.0, -0.1], [3.0, 0.1])
    if kind == "linearised":
        attack = attacks.LinearizedAttack(soft, cost, budget)
    else:
        attack = attacks.ProjectedGradientAttack(soft, cost, budget, 10, restarts=2)

    def lost(attack):
        p = attacks.AttackOn("u_ini", attack)(u_ini, y_ini, generator=source)
        return int((hard(u_ini + p, y_ini, on_failure="nan").info.status == dpc.Status.INFEASIBLE).sum())

    within = int((u_ini[:, -1, 0].abs() > 0.35 + 1e-6).sum())  # windows for which some p takes the plan away
    random, aimed = lost(attacks.RandomAttack(budget)), lost(attack)
    assert random < aimed <= within
    assert kind == "linearised" or aimed == within


def test_measurements_alone_never_take_the_plan_away():
    """y_ini enters the cost alone, not the constraints."""
    hard, (u_ini, y_ini) = delayed_layer(), delayed_windows(40)
    p = attacks.Ball(10.0).random(y_ini, generator())
    assert (hard(u_ini, y_ini + p).info.status == dpc.Status.SOLVED).all()
