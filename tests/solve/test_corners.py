"""Problems at their edges: a plant at rest on its bound, huge multipliers, sets that are points, sets that change."""

import math

import pytest
import torch

import torch_dpc as dpc
from helpers import central, relative

WEIGHTS = {"Q": 1.0, "R": 0.1, "lambda_g": 1.0, "lambda_s": 1e3}
ZERO = torch.zeros(3, 1, dtype=torch.float64)


def number(*values):
    return torch.tensor(values, dtype=torch.float64)


def first_order_lag():
    source = torch.Generator().manual_seed(0)
    u = torch.randn(120, 1, dtype=torch.float64, generator=source)
    y = torch.zeros_like(u)
    for k in range(119):
        y[k + 1] = 0.9 * y[k] + u[k]
    return dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=8)


HALF_LINES = [dpc.NonNegative(), dpc.Box(0.0, 10.0), dpc.Ball(0.0), dpc.SecondOrderCone()]


@pytest.mark.parametrize("y_set", HALF_LINES, ids=lambda y_set: type(y_set).__name__)
@pytest.mark.parametrize("start", [0.0, -1.0])
def test_a_plant_at_rest_on_its_bound_has_a_plan(y_set, start):
    """The plan is zero and so is g: rounding must not be judged relative to itself."""
    sol = dpc.DPCLayer(first_order_lag(), **WEIGHTS, y_set=y_set)(ZERO, ZERO + start, y_ref=number(-1.0))
    assert float(sol.y.abs().max()) < 1e-9 and float(sol.info.residual) < 1e-8


def integrator(seed):
    source = torch.Generator().manual_seed(seed)
    u = torch.randn(120, 2, dtype=torch.float64, generator=source)
    y = 0.1 * u.cumsum(0)[:, :1] + 0.01 * torch.randn(120, 1, dtype=torch.float64, generator=source)
    return dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=8), y[:3]


@pytest.mark.parametrize("seed", range(5))
def test_what_one_sided_sets_exclude_is_proven(seed):
    """The last input was (-0.5, 1): with changes of at most 0.2 the next one is negative."""
    data, y_ini = integrator(seed)
    u_ini = torch.zeros(3, 2, dtype=torch.float64)
    u_ini[-1] = number(-0.5, 1.0)
    for sets in (
        {"u_set": dpc.NonNegative(), "du_set": dpc.Box(-0.2, 0.2)},
        {"u_set": dpc.SecondOrderCone(), "du_set": dpc.Box(-0.2, 0.2)},
        {"u_set": dpc.Ball(0.2), "du_set": dpc.Ball(0.1)},
        {"y_set": dpc.NonNegative(), "terminal_steps": 1},
    ):
        layer = dpc.DPCLayer(data, **WEIGHTS, **sets, on_failure="nan")
        assert int(layer(u_ini, y_ini, y_ref=number(-1.0)).info.status) == dpc.Status.INFEASIBLE, sets


@pytest.mark.parametrize("seed", [0, 3, 12, 33])
def test_huge_multipliers_in_a_box_and_in_the_ball_that_is_the_same(seed):
    """Outputs that noise makes reachable at a price of 1e6: multipliers of 1e5 and more."""
    source = torch.Generator().manual_seed(seed)

    def randn(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=source)

    A, B, C = randn(5, 5), randn(5, 2), randn(1, 5)
    A = A * 0.95 / torch.linalg.eigvals(A).abs().max()
    u, x, y = 2 * torch.rand(110, 2, dtype=torch.float64, generator=source) - 1, torch.zeros(5).double(), []
    for step in u:
        y.append(C @ x + 0.01 * randn(1))
        x = A @ x + B @ step
    y = torch.stack(y)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=12)
    windows = torch.arange(4) + torch.tensor([[5], [60]])
    weights = {"Q": 1.0, "R": 0.03, "lambda_g": 700.0, "lambda_s": 1e4, "u_set": dpc.Box(-0.13, 0.13)}
    plans = [
        dpc.DPCLayer(data, **weights, y_set=y_set)(u[windows], y[windows], y_ref=number(1.0))
        for y_set in (dpc.Box(-0.5, 0.5), dpc.Ball(0.5))
    ]
    assert float((plans[0].u - plans[1].u).abs().max()) < 1e-6


@pytest.mark.parametrize("sets", [{"u_set": dpc.Ball(0.0)}, {"u_set": dpc.Box(0.0, 0.0), "y_set": dpc.Ball(100.0)}])
def test_a_set_of_one_point_passes_no_derivative(sets):
    y_ini = ZERO.clone().requires_grad_()
    dpc.DPCLayer(first_order_lag(), **WEIGHTS, **sets)(ZERO, y_ini).u.sum().backward()
    assert float(y_ini.grad.abs().max()) < 1e-12


SPOILED = {
    "a radius that is NaN": (lambda p: {"u_set": dpc.Ball(p)}, 0.5, math.nan, "`radius` must be finite"),
    "a negative radius": (lambda p: {"u_set": dpc.Ball(p)}, 0.5, -0.3, "`radius` must be finite and not negative"),
    "a price below zero": (lambda p: {"y_set": dpc.SoftBox(-1.0, 1.0, p)}, 2.0, -1.0, "`weight` must be positive"),
    "crossed bounds beside a ball": (
        lambda p: {"u_set": dpc.Box(-1.0, p), "y_set": dpc.Ball(50.0)}, 1.0, -2.0, "`lower` must be at most",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SPOILED)
def test_a_parameter_that_left_its_domain_is_refused_at_the_call(case):
    make, good, bad, says = SPOILED[case]
    parameter = torch.nn.Parameter(torch.tensor(good, dtype=torch.float64))
    layer = dpc.DPCLayer(first_order_lag(), **WEIGHTS, **make(parameter))
    layer(ZERO, ZERO + 1)
    parameter.data.fill_(bad)
    with pytest.raises(ValueError, match=says):
        layer(ZERO, ZERO + 1)


def test_a_set_changed_in_place_before_the_backward_is_refused():
    radius = torch.nn.Parameter(torch.tensor(0.3, dtype=torch.float64))
    layer = dpc.DPCLayer(first_order_lag(), **WEIGHTS, u_set=dpc.Ball(radius))
    plan = layer(ZERO, ZERO + 1, y_ref=number(5.0))
    with torch.no_grad():
        radius.fill_(0.9)
    with pytest.raises(RuntimeError, match="changed in place"):
        plan.u.sum().backward()


class Disc(dpc.ConvexSet):
    """The example of the docs."""

    def __init__(self, limit):
        super().__init__()
        self.limit = torch.nn.Parameter(torch.as_tensor(limit, dtype=torch.float64))

    def project(self, x):
        return x * (self.limit / torch.maximum(x.norm(dim=-1, keepdim=True), self.limit))


def test_a_set_of_ones_own_learns_also_where_the_plan_is_zero():
    layer = dpc.DPCLayer(first_order_lag(), **WEIGHTS, u_set=Disc(0.3))
    layer(ZERO, ZERO).u.sum().backward()
    assert layer.u_set.limit.grad.isfinite()

    def size(limit):
        sol = torch.func.functional_call(layer, {"u_set.limit": limit}, (ZERO, ZERO + 1), {"y_ref": number(5.0)})
        return sol.u.square().sum()

    limit = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    size(limit).backward()
    assert relative(limit.grad, central(size, limit.detach(), 1e-6)) < 1e-6
