"""Attacks of several steps are never worse than Algorithm 1, whatever the cost, the budget and the precision."""

import functools

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, small_data, small_layer, windows
from torch_dpc import attacks

ROUNDING = {torch.float64: 1e-9, torch.float32: 1e-6}  # of psi: a plan in float32 is rounded to 6e-8 of its entries
BUDGETS = [
    lambda rho: attacks.RelativeBall(rho),
    lambda rho: attacks.Box(rho),
    lambda rho: attacks.Ellipsoid([rho, 2 * rho, 0.0, rho], relative=True),
    lambda rho: attacks.L1Ball(rho, relative=True),
    lambda rho: attacks.SparseBall(1, rho, relative=True),
    lambda rho: attacks.PerChannel(attacks.RelativeBall(rho)),
    lambda rho: attacks.PerSampleBudget(attacks.Ball(rho)),
]
FIRST_MASS = torch.diag(torch.tensor([1.0, 0.0, 0.0, 0.0]))
COSTS = {
    "target": lambda layer: attacks.TargetInput(torch.tensor([0.3, -0.4])),
    "tracking": lambda layer: attacks.TrackingError(layer.data, 10.0),
    "tracking by other data": lambda layer: attacks.TrackingError(
        small_data(seed=7), torch.diag(torch.tensor([1.0, 0, 0, 0]))
    ),
    "last output": lambda layer: lambda plan: -plan.y[..., -1, 0],
    "kinks": lambda layer: lambda plan: -plan.y.abs().sum((-2, -1)) + (plan.u - 0.1).abs().sum((-2, -1)),
    "violation": lambda layer: attacks.BoundViolation(-0.1, 0.1),
    "near zero": lambda layer: lambda plan: 1e-6 * (plan.u.square().sum((-2, -1)) - 1e-3),
}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("name", COSTS)
def test_never_worse(name, dtype):
    source = generator(11)
    for trial in range(12):
        budget = BUDGETS[trial % len(BUDGETS)](10 ** (-3 * float(torch.rand(1, generator=source))))
        u_set = dpc.Box(-1.0, 1.0) if trial % 3 else dpc.Box(-0.2, 0.2)
        layer = small_layer(
            (0.0, 1e-2)[trial % 2], u_set=u_set, y_set=dpc.SoftBox(-0.5, 0.5, weight=10.0) if trial == 5 else None
        )
        cost = COSTS[name](layer)
        u_ini, y_ini = (w.to(dtype) for w in windows(12, 3, seed=trial, scale=(0.05, 0.5, 2.0)[trial % 3]))
        refs = {"y_ref": (0.2 * Y_REF).to(dtype), "u_ref": (0.2 * HOLDING).to(dtype)}
        psi_of = cost.given(u_ini=u_ini, y_ini=y_ini, **refs) if hasattr(cost, "given") else cost
        psi = [
            psi_of(layer(u_ini, y_ini + attack(u_ini, y_ini, **refs, generator=generator(1)), **refs)).double()
            for attack in (
                attacks.LinearizedAttack(layer, cost, budget),
                attacks.ProjectedGradientAttack(layer, cost, budget, 6, momentum=0.5, restarts=2),
                attacks.FrankWolfeAttack(layer, cost, budget, 6),
            )
        ]
        for other in psi[1:]:
            assert (other <= psi[0] + ROUNDING[dtype] * psi[0].abs().clamp_min(float(psi[0].abs().mean()))).all(), trial


@functools.cache
def quadrotor_layer():
    """A small planning problem of the quadrotor, attitude within +-pi/8."""
    source = generator(0)
    u, y = dpc.collect(dpc.systems.TorchQuadrotor(), 150, amplitude=0.5, hold=10, generator=source)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6)
    Q = torch.diag(torch.tensor([10.0, 10.0, 10.0, 0.0, 0.0, 0.0]))
    reach = torch.tensor([20.0, 20.0, 20.0, *[torch.pi / 8] * 3])
    box = dpc.Box(-1.0, 1.0), dpc.Box(-reach, reach)
    return dpc.DPCLayer(data, Q=Q, R=torch.eye(3), lambda_g=100.0, lambda_s=1e6, u_set=box[0], y_set=box[1]), u, y


@pytest.mark.parametrize("name", ["target", "tracking", "violation"])
def test_never_worse_on_the_quadrotor(name):
    layer, u, y = quadrotor_layer()
    costs = {
        "target": attacks.TargetInput(torch.tensor([0.0, 1.0, 0.0])),
        "tracking": attacks.TrackingError(layer.data),
    }
    cost = costs.get(name, attacks.BoundViolation(-0.1, 0.1))
    at = torch.arange(10, 130, 12)[:, None] + torch.arange(3)
    u_ini, y_ini, y_ref = u[at], y[at], y.mean(0)
    for rho in (1e-3, 1e-2):
        budget = attacks.RelativeBall(rho)
        psi_of = cost.given(u_ini=u_ini, y_ini=y_ini, y_ref=y_ref) if hasattr(cost, "given") else cost
        psi = [
            psi_of(layer(u_ini, y_ini + attack(u_ini, y_ini, y_ref=y_ref, generator=generator(1)), y_ref=y_ref))
            for attack in (
                attacks.LinearizedAttack(layer, cost, budget),
                attacks.ProjectedGradientAttack(layer, cost, budget, 6, restarts=2),
                attacks.FrankWolfeAttack(layer, cost, budget, 6),
            )
        ]
        for other in psi[1:]:
            assert (
                other <= psi[0] + ROUNDING[torch.float64] * psi[0].abs().clamp_min(float(psi[0].abs().mean()))
            ).all()
        assert (psi[1] < psi[0]).any()
