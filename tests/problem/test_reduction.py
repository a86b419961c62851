"""The exact reduction: nothing of the problem is lost, whatever the rank and the number of windows."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import (
    HOLDING,
    SMALL,
    Y_REF,
    central,
    delayed_data,
    paper_layer,
    randn,
    reference_plan,
    relative,
    small_data,
    small_layer,
    windows,
)
from torch_dpc.problem.reduction import reduce
from torch_dpc.problem.rows import DataRows

EXACT = 1e-10
#: The optimum itself moves by this under rounding of the data: noise 1e-8 under lambda_s = 1e6 conditions E at 1e5.
PLAN = 1e-9
DIFFERENCES = 1e-6
#: The issue's: the curvature of the plan in noisy data is large.
THROUGH_DATA = 1e-4
NOISES = [0.0, 1e-8, 1e-4, 1e-2]
CPU = torch.device("cpu")


def mixed(data, mix):
    """The same data with their columns combined by `mix`, `(n_g, new n_g)`."""
    columns = {name: getattr(data, name) @ mix for name in ("Up", "Uf", "Yp", "Yf")}
    return dpc.HankelData(**columns, t_ini=data.t_ini, horizon=data.horizon, n_u=data.n_u, n_y=data.n_y)


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_reduced_map_is_the_dense_kkt_system(noise):
    """v = V theta - G lam against [P H'; H 0] of a problem small and round enough for a dense solve."""
    layer = small_layer(noise)
    rows = DataRows.of(layer.data, CPU)
    reduction = reduce(rows, layer.reduction.weights)
    u_ini, y_ini = windows(1, 3, seed=1)
    theta = torch.cat([u_ini.reshape(-1), y_ini.reshape(-1), HOLDING.repeat(6), Y_REF.repeat(6)])
    P, q, H, b = layer.compact_form(u_ini[0], y_ini[0], y_ref=Y_REF, u_ref=HOLDING)
    lam = randn(36, seed=2)
    n = len(P)
    K = torch.cat([torch.cat([P, H.T], 1), torch.cat([H, H.new_zeros(len(H), len(H))], 1)])
    force = torch.cat([lam, lam.new_zeros(layer.data.n_g)])
    z = torch.linalg.solve(K, torch.cat([-q - force, b]))[:n]
    v = reduction.V @ theta - reduction.G @ lam
    assert relative(v, z[:36]) < 1e-8  # cond(K) is near 1e10
    torch.testing.assert_close(reduction.G, reduction.G.T, rtol=0, atol=1e-14)
    assert torch.linalg.eigvalsh(reduction.G).min() > -1e-12


@pytest.mark.parametrize("noise", NOISES)
def test_rank_deficient_and_noisy_data_are_exact_to_one_tolerance(noise):
    layer = paper_layer(noise)
    u_ini, y_ini = windows(2, seed=3)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    assert (sol.info.n_active > 0).all()
    for i in range(2):
        u, y = reference_plan(layer, u_ini[i], y_ini[i], Y_REF, HOLDING)
        assert relative(sol.u[i], u) < PLAN
        assert relative(sol.y[i], y) < PLAN


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_the_plan_follows_from_g(noise):
    layer = paper_layer(noise)
    u_ini, y_ini = windows(4, seed=3)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert sol.g.shape == (4, 500)
    assert relative(sol.g @ layer.data.Uf.T, sol.u.flatten(1)) < EXACT
    assert relative(sol.g @ layer.data.Yf.T, sol.y.flatten(1)) < EXACT
    assert relative(sol.g @ layer.data.Up.T, u_ini.flatten(1)) < EXACT


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_a_rotation_of_the_windows_changes_g_alone(noise):
    data = small_data(noise)
    rotation = torch.linalg.qr(randn(data.n_g, data.n_g, seed=5)).Q
    u_ini, y_ini = windows(8, 3, seed=6, scale=0.5)
    a, b = (
        dpc.DPCLayer(d, **SMALL, u_set=dpc.Box(-0.5, 0.5))(u_ini, y_ini, y_ref=Y_REF)
        for d in (data, mixed(data, rotation))
    )
    assert relative(a.u, b.u) < EXACT
    assert relative(a.y, b.y) < EXACT
    assert relative(a.g, b.g @ rotation.T) < EXACT


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_every_window_recorded_twice_is_half_the_price_of_g(noise):
    data = small_data(noise)
    twice = mixed(data, torch.eye(data.n_g, dtype=torch.float64).repeat(1, 2))
    u_ini, y_ini = windows(8, 3, seed=6, scale=0.5)
    once = small_layer(noise)(u_ini, y_ini, y_ref=Y_REF)
    layer = dpc.DPCLayer(twice, **{**SMALL, "lambda_g": 2 * SMALL["lambda_g"]}, u_set=dpc.Box(-0.5, 0.5))
    assert relative(layer(u_ini, y_ini, y_ref=Y_REF).u, once.u) < EXACT


@pytest.mark.parametrize("unit", [1e-4, 1e4])
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_the_units_of_the_outputs_do_not_matter(noise, unit):
    data = small_data(noise)
    scaled = dpc.HankelData(
        data.Up, data.Uf, unit * data.Yp, unit * data.Yf, data.t_ini, data.horizon, data.n_u, data.n_y
    )
    weights = {**SMALL, "Q": SMALL["Q"] / unit**2, "lambda_s": SMALL["lambda_s"] / unit**2}
    u_ini, y_ini = windows(8, 3, seed=6, scale=0.5)
    a = small_layer(noise)(u_ini, y_ini, y_ref=Y_REF)
    b = dpc.DPCLayer(scaled, **weights, u_set=dpc.Box(-0.5, 0.5))(u_ini, unit * y_ini, y_ref=unit * Y_REF)
    assert relative(b.u, a.u) < PLAN
    assert relative(b.y / unit, a.y) < PLAN


def minimum_norm_plan(layer, u_ini, y_ini, y_ref):
    """The unconstrained optimum of least |g|, by least squares in the full space of g."""
    data = layer.data
    Up, Yp, Uf, Yf = (m.numpy() for m in (data.Up, data.Yp, data.Uf, data.Yf))
    _, size, right = np.linalg.svd(Up)
    kernel, g0 = right[(size > 1e-9 * size[0]).sum() :].T, np.linalg.pinv(Up) @ u_ini.numpy().reshape(-1)
    q = np.sqrt(np.tile(torch.as_tensor(layer.Q).diag().numpy(), data.horizon))[:, None]
    r, s = float(layer.R) ** 0.5, float(2 * layer.lambda_s) ** 0.5
    E = np.concatenate([r * Uf, q * Yf, s * Yp])
    targets = np.tile(y_ref.numpy(), data.horizon), y_ini.numpy().reshape(-1)
    e = np.concatenate([np.zeros(len(Uf)), q[:, 0] * targets[0], s * targets[1]])
    return g0 + kernel @ np.linalg.lstsq(E @ kernel, e - E @ g0, rcond=1e-10)[0]


@pytest.mark.parametrize("R", [1.0, 0.0])
def test_a_cost_with_a_kernel_selects_the_least_norm_g_and_says_so(R):
    layer = dpc.DPCLayer(delayed_data(noise=0.1), torch.diag(torch.tensor([1.0, 0.0])).double(), R, 0.0, 10.0)
    u_ini, y_ini, y_ref = randn(3, 1, seed=1), randn(3, 2, seed=2), torch.ones(2, dtype=torch.float64)
    sol = layer(u_ini, y_ini, y_ref=y_ref)
    assert sol.info.is_selection
    assert relative(sol.g, minimum_norm_plan(layer, u_ini, y_ini, y_ref)) < EXACT
    assert not small_layer()(*[w[0] for w in windows(1, 3)]).info.is_selection


def test_an_idle_actuator_leaves_the_rest_of_the_problem_alone():
    u = torch.cat([randn(150, 1, seed=8), torch.zeros(150, 1, dtype=torch.float64)], dim=1)
    y = torch.zeros(150, 2, dtype=torch.float64)
    for k in range(149):
        y[k + 1, 0], y[k + 1, 1] = 0.9 * y[k, 0] + u[k, 0], 0.5 * y[k, 1] + y[k, 0]
    with pytest.warns(dpc.ExcitationWarning):
        with_idle = dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6)
    without = dpc.HankelData.from_trajectories(u[:, :1], y, t_ini=3, horizon=6)
    u_ini, y_ini = u[20:23], y[20:23]
    a = dpc.DPCLayer(with_idle, **SMALL)(u_ini, y_ini, y_ref=torch.ones(2))
    b = dpc.DPCLayer(without, **SMALL)(u_ini[:, :1], y_ini, y_ref=torch.ones(2))
    assert relative(a.y, b.y) < EXACT
    assert relative(a.u[:, :1], b.u) < EXACT
    assert a.u[:, 1].abs().max() == 0


# --- weights and data that learn --------------------------------------------------------------------------------------

WEIGHTS = {
    "Q": torch.diag(torch.tensor([10.0, 5.0, 1.0, 2.0])).double(),
    "R": torch.tensor([[1.0, 0.2], [0.2, 0.5]]).double(),
    "lambda_g": torch.tensor(1.0).double(),
    "lambda_s": torch.tensor(1e3).double(),
}


def plan_loss(u_ini, y_ini, data=None, **weights):
    layer = dpc.DPCLayer(data or small_data(), **{**WEIGHTS, **weights}, u_set=dpc.Box(-0.4, 0.4))
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert (sol.info.n_active > 0).all() and not sol.info.n_weakly_active.any()
    return (sol.u * randn(6, 2, seed=1)).sum() + sol.y.square().sum() + sol.g.square().sum() + 1e-3 * sol.lam.sum()


@pytest.mark.parametrize("noise", [0.0, 1e-2])
@pytest.mark.parametrize("name", WEIGHTS)
def test_gradients_of_weights(name, noise):
    u_ini, y_ini = windows(5, 3, seed=2, scale=0.5)
    y_ini = y_ini + 0.1 * randn(5, 3, 4, seed=3)
    data, weight = small_data(noise), WEIGHTS[name]
    x = torch.nn.Parameter(weight.clone())
    plan_loss(u_ini, y_ini, data, **{name: x}).backward()
    symmetric = (lambda w: (w + w.mT) / 2) if weight.ndim else (lambda w: w)  # entry by entry, Q stays symmetric
    size = float(weight.abs().max())
    expected = central(lambda w: plan_loss(u_ini, y_ini, data, **{name: symmetric(w)}), weight, step=1e-4 * size)
    if name == "lambda_g" and noise == 0:  # M g = 0 at every plan: its price is nothing
        assert x.grad.abs() < 1e-12 and expected.abs() < 1e-9
    else:
        assert expected.abs().max() > 0 and relative(x.grad, expected) < DIFFERENCES


def test_weights_with_a_graph_pass_it_on_and_derive_twice():
    u_ini, y_ini = windows(2, 3, seed=2, scale=0.5)
    y_ini = y_ini + 0.1 * randn(2, 3, 4, seed=3)
    logs = torch.tensor([0.0, np.log(0.1)], dtype=torch.float64, requires_grad=True)

    def loss(logs):
        return plan_loss(u_ini, y_ini, lambda_g=logs[0].exp(), R=logs[1].exp()).pow(2)

    assert torch.autograd.gradcheck(loss, logs) and torch.autograd.gradgradcheck(loss, logs)


def test_functional_call_replaces_weights():
    layer = small_layer(R=torch.nn.Parameter(torch.eye(2).double()))
    u_ini, y_ini = windows(2, 3, seed=2, scale=0.5)
    call = torch.func.functional_call
    other = {"R": 3 * torch.eye(2).double()}
    expected = small_layer(R=other["R"])(u_ini, y_ini, y_ref=Y_REF).u
    assert relative(call(layer, other, (u_ini, y_ini), {"y_ref": Y_REF}).u, expected) < EXACT
    found = torch.func.grad(lambda w: call(layer, w, (u_ini, y_ini), {"y_ref": Y_REF}).u.square().sum())(other)["R"]
    x = other["R"].clone().requires_grad_()
    small_layer(R=x)(u_ini, y_ini, y_ref=Y_REF).u.square().sum().backward()
    assert relative(found, x.grad) < EXACT


@pytest.mark.parametrize("which", ["u", "y"])
def test_gradients_of_trajectories_through_M(which):
    source = torch.Generator().manual_seed(0)
    plant = dpc.systems.OscillatingMasses(noise=1e-2, generator=source)
    recorded = dict(zip("uy", dpc.collect(plant, 90, generator=source), strict=True))
    u_ini, y_ini = windows(3, 3, seed=2, scale=0.5)

    def loss(x):
        data = dpc.HankelData.from_trajectories(**{**recorded, which: x}, t_ini=3, horizon=6)
        return plan_loss(u_ini, y_ini, data)

    x = recorded[which].clone().requires_grad_()
    loss(x).backward()
    directions = randn(6, *x.shape, seed=7)  # all 540 entries at once would take a minute
    for v in directions:
        with torch.no_grad():
            expected = (loss(x + 1e-6 * v) - loss(x - 1e-6 * v)) / 2e-6
        assert float((x.grad * v).sum()) == pytest.approx(float(expected), rel=THROUGH_DATA)


def test_a_second_derivative_with_respect_to_the_data_is_refused():
    plant = dpc.systems.OscillatingMasses(noise=0.02, generator=torch.Generator().manual_seed(5))
    u, y = dpc.collect(plant, 140, generator=torch.Generator().manual_seed(0))
    y_data = y.clone().requires_grad_()
    data = dpc.HankelData.from_trajectories(u, y_data, t_ini=4, horizon=8)
    plan = dpc.DPCLayer(data, 1.0, 0.5, 1.0, 50.0)(u[20:24], y[20:24], y_ref=torch.ones(4))
    cost = plan.u.square().sum()
    (once,) = torch.autograd.grad(cost, y_data, create_graph=True)
    with pytest.raises(NotImplementedError, match="first order"):
        once.square().sum().backward(retain_graph=True)
    assert torch.equal(once, torch.autograd.grad(cost, y_data)[0])


def test_function_transforms_differentiate_the_data():
    """They ask for every derivative as one to be derived again; the first one is right all the same."""
    u, y = dpc.collect(dpc.systems.OscillatingMasses(noise=0.02, generator=torch.Generator().manual_seed(5)), 90)
    past = u[20:23], y[20:23]

    def plan(x):
        data = dpc.HankelData.from_trajectories(u, x, t_ini=3, horizon=6)
        return dpc.DPCLayer(data, 1.0, 0.5, 1.0, 50.0, u_set=dpc.Box(-0.5, 0.5))(*past, y_ref=torch.ones(4)).u

    rows = torch.autograd.functional.jacobian(plan, y)
    assert rows.abs().max() > 1e-3
    assert relative(torch.func.grad(lambda x: plan(x).sum())(y), rows.sum((0, 1))) < EXACT
    assert relative(torch.func.jacrev(plan)(y), rows) < EXACT
    assert relative(torch.autograd.functional.jacobian(plan, y, vectorize=True), rows) < EXACT
    for forward in (torch.func.jacfwd(plan), torch.func.hessian(lambda x: plan(x).sum())):
        with pytest.raises(NotImplementedError, match="go backward"):
            forward(y)
    with pytest.raises(NotImplementedError, match="first order"):
        torch.func.grad(lambda x: torch.func.grad(lambda x: plan(x).sum())(x).square().sum())(y)
