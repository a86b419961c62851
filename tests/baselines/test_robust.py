"""Robust predictive control against a worst case that shares no code with its cone program."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

import torch_dpc as dpc
from helpers import SMALL, randn, small_data, small_layer, windows
from torch_dpc import attacks

pytest.importorskip("cvxpy", reason="extra `baselines`")
pytest.importorskip("clarabel", reason="extra `baselines`")

from baselines import RobustDPC

REFS = {"y_ref": torch.tensor([0.2, -0.1, 0.0, 0.0]).double(), "u_ref": torch.tensor([0.1, 0.0]).double()}
NEAR = 1e-5  # relative, in the cost: the tolerance of an interior-point method on a cone program


def worst(K, a, radius):
    """max over |p| <= radius of |a - K p|^2, by its stationarity: (lambda - K'K) p = -K'a, |p| = radius."""
    values, vectors = np.linalg.eigh(K.T @ K)
    g = vectors.T @ (-K.T @ a)
    low, high = values[-1], values[-1] + np.linalg.norm(g) / radius + 1e-9
    for _ in range(200):
        middle = (low + high) / 2
        with np.errstate(divide="ignore"):
            inside = np.sum((g / (middle - values)) ** 2) < radius**2
        low, high = (low, middle) if inside else (middle, high)
    p = vectors @ (g / (high - values))
    return np.sum((a - K @ (p * radius / np.linalg.norm(p))) ** 2)


def robust_cost(layer, u_ini, y_ini, radius):
    predictor = attacks.Predictor(layer.data)
    K_y = predictor.matrix[:, 6:18].numpy() * np.sqrt(10.0)

    def cost(u):
        y = predictor(u_ini, y_ini, torch.as_tensor(u).reshape(6, 2))
        a = np.sqrt(10.0) * (y - REFS["y_ref"]).flatten().numpy()
        return 0.5 * np.sum((np.reshape(u, (6, 2)) - REFS["u_ref"].numpy()) ** 2) + 0.5 * worst(K_y, a, radius)

    return cost


@pytest.mark.parametrize("radius", [0.01, 0.1, 1.0])
def test_the_plan_is_the_best_against_the_worst_error(radius):
    layer = small_layer()
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=4, scale=0.3))
    plan = RobustDPC(layer, attacks.BallBudget(radius))(u_ini, y_ini, **REFS)
    cost = robust_cost(layer, u_ini, y_ini, radius)
    best = minimize(cost, plan.u.flatten().numpy(), bounds=[(-0.5, 0.5)] * 12, method="L-BFGS-B", tol=1e-12)
    fresh = minimize(cost, np.zeros(12), bounds=[(-0.5, 0.5)] * 12, method="L-BFGS-B", tol=1e-12)
    assert cost(plan.u.flatten().numpy()) <= min(best.fun, fresh.fun) * (1 + NEAR)
    nominal = RobustDPC(layer, attacks.BallBudget(1e-6))(u_ini, y_ini, **REFS)
    assert cost(plan.u.flatten().numpy()) <= cost(nominal.u.flatten().numpy()) * (1 + NEAR)
    if radius == 1.0:
        assert cost(plan.u.flatten().numpy()) < 0.999 * cost(nominal.u.flatten().numpy())


def test_no_sampled_error_costs_more_than_the_plan_fears():
    layer, radius = small_layer(), 0.3
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=4, scale=0.3))
    u = RobustDPC(layer, attacks.BallBudget(radius))(u_ini, y_ini, **REFS).u
    feared = robust_cost(layer, u_ini, y_ini, radius)(u.flatten().numpy())
    p = randn(500, 3, 4)
    p = radius * p / p.flatten(1).norm(dim=1)[:, None, None]
    y = attacks.Predictor(layer.data)(u_ini, y_ini - p, u.expand(500, 6, 2))
    costs = 5 * (y - REFS["y_ref"]).square().sum((1, 2)) + 0.5 * (u - REFS["u_ref"]).square().sum()
    assert 0.5 * feared < float(costs.max()) <= feared * (1 + NEAR)


def test_without_an_error_it_is_the_layer_in_the_limit_of_large_penalties():
    layer = dpc.DPCLayer(small_data(), **{**SMALL, "lambda_g": 1e8, "lambda_s": 1e8, "u_set": dpc.Box(-0.5, 0.5)})
    u_ini, y_ini = windows(3, 3, seed=4, scale=0.3)
    robust = RobustDPC(layer, attacks.RelativeBallBudget(0.0))(u_ini, y_ini, **REFS)
    plain = layer(u_ini, y_ini, **REFS)
    torch.testing.assert_close(robust.u, plain.u, atol=1e-4, rtol=0)
    assert (robust.info.status == dpc.Status.SOLVED).all() and robust.u.shape == (3, 6, 2)


def test_bounds_of_the_outputs_hold_for_every_error():
    layer = small_layer(y_set=dpc.Box(-0.128, 0.128))
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=4, scale=0.05))
    budget = attacks.BallBudget(0.02)
    refs = {"y_ref": torch.tensor([0.5, 0.5, 0.0, 0.0]).double()}
    u = RobustDPC(layer, budget)(u_ini, y_ini, **refs).u
    p = randn(500, 3, 4)
    p = 0.02 * p / p.flatten(1).norm(dim=1)[:, None, None]
    y = attacks.Predictor(layer.data)(u_ini, y_ini - p, u.expand(500, 6, 2))
    assert float(y.abs().max()) <= 0.128 + 1e-6
    nominal = RobustDPC(layer, attacks.BallBudget(0.0))(u_ini, y_ini, **refs).u
    assert float(attacks.Predictor(layer.data)(u_ini, y_ini - p, nominal.expand(500, 6, 2)).abs().max()) > 0.128


def test_it_controls_and_refuses_what_it_cannot_do():
    layer = small_layer(0.0)
    robust = RobustDPC(layer, attacks.RelativeBallBudget(0.05))
    plant = dpc.systems.OscillatingMasses()
    start = {"state": torch.tensor([0.3, 0.3, 0.0, 0.0])}
    log = dpc.simulate(plant, dpc.DPCController(robust, 3), torch.zeros(4), steps=30, reset=start)
    still = dpc.simulate(plant, dpc.DPCController(layer, 3), torch.zeros(4), steps=30, reset=start)
    assert float(log.y[-10:].abs().mean()) < 1.2 * float(still.y[-10:].abs().mean())
    u_ini, y_ini = windows(2, 3)
    attack = attacks.FiniteDifferenceAttack(robust, attacks.TargetInput(torch.ones(2)), attacks.BallBudget(0.1))
    assert attack(u_ini, y_ini, **REFS).abs().max() > 0
    with pytest.raises(ValueError, match="plans of RobustDPC have none"):
        attacks.LinearizedAttack(robust, attacks.TargetInput(torch.ones(2)), attacks.BallBudget(0.1))(u_ini, y_ini)
    with pytest.raises(ValueError, match="`budget` must be a BallBudget"):
        RobustDPC(layer, attacks.BoxBudget(0.1))
    with pytest.raises(ValueError, match="the paper's terms alone"):
        RobustDPC(small_layer(R_du=1.0), attacks.BallBudget(0.1))
