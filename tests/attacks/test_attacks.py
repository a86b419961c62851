"""Attacks: Algorithm 1 by hand, budgets, and the edges where a direction is not defined."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, central, generator, masses_data, paper_layer, randn, relative, small_layer, windows
from torch_dpc import attacks

EXACT = 1e-10
DIFFERENCES = 1e-6
SINGLE = 1e-5


def norm(p):
    return torch.linalg.vector_norm(p, dim=(-2, -1))


# --- Algorithm 1 ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backward", ["reduced", "full"])
@pytest.mark.parametrize("rho", [0.003, 0.1])
def test_algorithm_1_by_hand(rho, backward):
    """p* = -rho |y_ini| grad / |grad|, the gradient by central differences."""
    layer = paper_layer(backward=backward)
    target = torch.tensor([0.5, -0.5], dtype=torch.float64)
    u_ini, y_ini = (w[0] for w in windows(1, seed=2))
    refs = {"y_ref": Y_REF, "u_ref": 0.5 * HOLDING}
    p = attacks.LinearizedAttack(layer, attacks.TargetInput(target), attacks.RelativeBall(rho))(u_ini, y_ini, **refs)
    gradient = central(lambda y: 0.5 * (layer(u_ini, y, **refs).u - target).square().sum(), y_ini)
    assert relative(p, -rho * y_ini.norm() * gradient / gradient.norm()) < DIFFERENCES


def test_algorithm_1_from_J_and_K_as_printed():
    """p* = argmin -(d psi) T J^+ K p with J and K of Proposition 1, built here from P and H alone."""
    layer = small_layer(1e-2)
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=2, scale=0.5))
    target, rho = torch.tensor([0.5, -0.5], dtype=torch.float64), 0.05
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert sol.info.n_active > 0 and sol.info.n_weakly_active == 0
    P, _, H, _ = layer.compact_form(u_ini, y_ini, y_ref=Y_REF)
    n, m = len(P), len(H)
    D1 = torch.ones(n, dtype=torch.float64)
    D1[:36][sol.lam != 0] = 0
    eye = torch.eye(n, dtype=torch.float64)
    top = torch.cat([eye - D1[:, None] * (eye - P), D1[:, None] * H.T], dim=1)
    J = torch.cat([top, torch.cat([H, H.new_zeros(m, m)], dim=1)])
    K = torch.zeros(n + m, 12, dtype=torch.float64)
    K[36:n] = -2 * layer.lambda_s * layer.data.Yp.T
    psi_z = torch.zeros(n + m, dtype=torch.float64)
    psi_z[:12] = (sol.u - target).reshape(-1)
    gradient = (-psi_z @ torch.linalg.solve(J, K)).reshape(3, 4)
    attack = attacks.LinearizedAttack(layer, attacks.TargetInput(target), attacks.RelativeBall(rho))
    p = attack(u_ini, y_ini, y_ref=Y_REF)
    assert relative(p, -rho * y_ini.norm() * gradient / gradient.norm()) < 1e-7  # cond(J) near 1e8


@pytest.mark.parametrize("batch", [(), (0,), (1,), (5,), (2, 3)], ids=str)
def test_a_batch_is_attacked_sample_by_sample(batch):
    layer = small_layer()
    u_ini, y_ini = windows(int(np.prod(batch)), 3, seed=1)
    attack = attacks.LinearizedAttack(layer, attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(0.1))
    p = attack(u_ini.reshape(*batch, 3, 2), y_ini.reshape(*batch, 3, 4), y_ref=Y_REF)
    assert p.shape == (*batch, 3, 4) and not p.requires_grad
    for i, (a, b) in enumerate(zip(u_ini, y_ini, strict=True)):
        assert relative(p.reshape(-1, 3, 4)[i], attack(a, b, y_ref=Y_REF)) < EXACT
    torch.testing.assert_close(norm(p), 0.1 * norm(y_ini).reshape(batch), rtol=1e-12, atol=0)


@pytest.mark.parametrize("grad_mode", [torch.no_grad, torch.enable_grad, torch.inference_mode])
def test_it_attacks_in_every_grad_mode_and_leaves_no_gradients(grad_mode):
    layer = small_layer(R=torch.nn.Parameter(torch.eye(2).double()))
    u_ini, y_ini = windows(2, 3, seed=1)
    y_ini.requires_grad_()
    attack = attacks.LinearizedAttack(layer, attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(0.1))
    with grad_mode():
        p = attack(u_ini, y_ini)
    assert norm(p).min() > 0 and layer.R.grad is None and y_ini.grad is None


def test_it_moves_the_plan_towards_the_target_and_beats_random():
    layer = paper_layer()
    u_ini, y_ini = windows(20, seed=4)
    cost, budget = attacks.TargetInput(torch.zeros(2)), attacks.RelativeBall(0.01)
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}
    nominal = cost(layer(u_ini, y_ini, **refs))
    worst = cost(layer(u_ini, y_ini + attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini, **refs), **refs))
    random = attacks.RandomAttack(budget)(u_ini, y_ini, **refs, generator=generator(1))
    assert (worst < nominal).all() and (worst < cost(layer(u_ini, y_ini + random, **refs))).all()


def test_at_zero_measurements_the_relative_budget_is_zero():
    layer = small_layer()
    u_ini, y_ini = torch.zeros(2, 3, 2).double(), torch.zeros(2, 3, 4).double()
    y_ini[1] = 1.0
    budget = attacks.RelativeBall(0.1)
    linearized = attacks.LinearizedAttack(layer, attacks.TargetInput(torch.ones(2)), budget)
    for attack in (linearized, attacks.RandomAttack(budget)):
        p = attack(u_ini, y_ini, generator=generator())
        assert torch.isfinite(p).all() and not p[0].any()
        assert norm(p)[1].item() == pytest.approx(0.1 * norm(y_ini)[1].item(), rel=1e-12)


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_at_a_zero_gradient_rounding_is_not_amplified(noise):
    layer = small_layer(noise, u_set=dpc.Box(-1e-3, 1e-3))
    u_ini, y_ini = windows(4, 3, seed=1)
    far = {"y_ref": 100 * Y_REF, "u_ref": 100 * HOLDING}
    assert (layer(u_ini, y_ini, **far).info.n_active == 12).all()  # every input is at its bound and stays there
    attack = attacks.LinearizedAttack(layer, attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(0.1))
    p = attack(u_ini, y_ini, **far)
    assert torch.equal(p, torch.zeros_like(p))


def test_where_there_is_no_plan_there_is_no_attack():
    layer = small_layer(0.0, y_set=dpc.Box(50.0, 60.0))
    u_ini, y_ini = windows(2, 3, seed=1)
    p = attacks.LinearizedAttack(layer, attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(0.1))(u_ini, y_ini)
    assert torch.equal(p, torch.zeros_like(p))


def test_any_callable_is_a_cost():
    layer = small_layer()
    u_ini, y_ini = windows(2, 3, seed=1)
    budget = attacks.RelativeBall(0.1)
    p = attacks.LinearizedAttack(layer, lambda sol: -sol.y[..., -1, 0], budget)(u_ini, y_ini)
    x = y_ini.clone().requires_grad_()
    layer(u_ini, x).y[:, -1, 0].sum().backward()
    assert relative(p, 0.1 * norm(y_ini)[:, None, None] * x.grad / norm(x.grad)[:, None, None]) < EXACT


# --- costs ------------------------------------------------------------------------------------------------------------


def test_target_input_is_half_the_squared_distance():
    sol = small_layer()(*windows(3, 3, seed=1))
    target = torch.tensor([1.0, -2.0], dtype=torch.float64)
    expected = 0.5 * ((sol.u - target) ** 2).sum((1, 2))
    for same in (target, target.expand(6, 2), [1.0, -2.0]):
        torch.testing.assert_close(attacks.TargetInput(same)(sol), expected, rtol=1e-14, atol=0)


def test_a_target_trajectory_is_windowed_by_the_step():
    layer = small_layer()
    u_ini, y_ini = windows(1, 3, seed=1)
    sol = layer(u_ini, y_ini)
    run = randn(20, 2, seed=3)
    moving = attacks.TargetInput(trajectory=run)
    attack = attacks.LinearizedAttack(layer, moving, attacks.RelativeBall(0.1))
    for step in (0, 5, 14, 17, 19, 40):
        window = torch.stack([run[min(step + j, 19)] for j in range(6)])
        fixed = attacks.TargetInput(window)
        torch.testing.assert_close(moving.at(step)(sol), fixed(sol))
        expected = attacks.LinearizedAttack(layer, fixed, attacks.RelativeBall(0.1))(u_ini, y_ini)
        assert relative(attack(u_ini, y_ini, step=step), expected) < EXACT
    torch.testing.assert_close(moving(sol), moving.at(0)(sol))


@pytest.mark.parametrize("given", [(None, None), (torch.ones(2), torch.ones(9, 2))], ids=["none", "both"])
def test_a_target_is_one_or_the_other(given):
    with pytest.raises(ValueError, match="either `u_target` or `trajectory"):
        attacks.TargetInput(given[0], trajectory=given[1])


@pytest.mark.parametrize("value", [torch.ones(2, 2, 2), torch.tensor([1, 2]), torch.tensor([torch.nan, 0.0])], ids=str)
def test_bad_targets_are_named(value):
    with pytest.raises(ValueError, match="`u_target`"):
        attacks.TargetInput(value)


# --- random attacks, precision, closed loop ---------------------------------------------------------------------------


def test_random_attacks_spend_the_budget_and_repeat_by_their_generator():
    u_ini, y_ini = windows(50, 3, seed=1)
    attack = attacks.RandomAttack(attacks.RelativeBall(0.02))
    a, b, c = (attack(u_ini, y_ini, generator=generator(s)) for s in (7, 7, 8))
    assert torch.equal(a, b) and not torch.equal(a, c) and a.shape == y_ini.shape
    torch.testing.assert_close(norm(a), 0.02 * norm(y_ini), rtol=1e-12, atol=0)
    source = generator(7)
    v = torch.randn(y_ini.shape, dtype=torch.float64, generator=source)  # rho |y_ini| v / |v|, the paper's benchmark
    assert relative(a, 0.02 * norm(y_ini)[:, None, None] * v / norm(v)[:, None, None]) < 1e-12
    directions = a / norm(a)[:, None, None]
    assert directions.mean(0).abs().max() < 0.2  # no preferred direction


def test_single_precision_stays_in_its_budget():
    layer, budget = small_layer(), attacks.RelativeBall(0.1)
    u_ini, y_ini = (w.float() for w in windows(20, 3, seed=1))
    attack = attacks.LinearizedAttack(layer, attacks.TargetInput(torch.ones(2)), budget)
    for p in (attack(u_ini, y_ini), attacks.RandomAttack(budget)(u_ini, y_ini, generator=generator())):
        assert p.dtype == torch.float32
        torch.testing.assert_close(norm(p), 0.1 * norm(y_ini), rtol=SINGLE, atol=0)


def test_measurements_that_are_not_finite_are_named():
    u_ini, y_ini = windows(1, 3, seed=1)
    budget = attacks.RelativeBall(0.1)
    linearized = attacks.LinearizedAttack(small_layer(), attacks.TargetInput(torch.ones(2)), budget)
    for attack in (linearized, attacks.RandomAttack(budget)):
        with pytest.raises(ValueError, match="`y_ini` must be finite"):
            attack(u_ini, y_ini * torch.nan)


def test_in_closed_loop_every_plan_is_attacked_within_its_budget():
    plant = dpc.systems.OscillatingMasses()
    layer = dpc.DPCLayer(masses_data(), Q=10.0, R=1.0, lambda_g=100.0, lambda_s=1e6, u_set=dpc.Box(-1.0, 1.0))
    times = 0.1 * torch.arange(60, dtype=torch.float64)
    cost = attacks.TargetInput(trajectory=times.sin()[:, None].expand(60, 2))
    attack = attacks.LinearizedAttack(layer, cost, attacks.RelativeBall(0.1))
    run = {"steps": 60, "u_ref": HOLDING, "reset": {"state": Y_REF}, "u_warmup": HOLDING}
    log = dpc.simulate(plant, dpc.DPCController(layer, 10), Y_REF, attack=attack, **run)
    nominal = dpc.simulate(plant, dpc.DPCController(layer, 10), Y_REF, **run)
    y = torch.cat([Y_REF.expand(6, 4), log.y])  # the warm-up holds the steady state
    for k in range(60):
        made = k - k % 10
        assert norm(log.p[k]) <= 0.1 * norm(y[made : made + 6]) * (1 + 1e-9)
    assert (nominal.y - Y_REF).abs().max() < 1e-9 and (log.y - Y_REF).abs().max() > 1e-2
