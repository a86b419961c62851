"""Regularisers and the slack of y_ini, against a conic solver on the problem as posed in all n_g columns."""

import pickle

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, central, randn, relative, small_data, windows
from torch_dpc.data.predictor import Predictor

cvxpy = pytest.importorskip("cvxpy", reason="the independent solver: pip install '.[test]'")

#: What an interior-point method leaves of the cost, and, its square root, of the plan.
COST, CONIC = 1e-7, 1e-4
DIFFERENCES = 1e-6
EXACT = 1e-9

FORMULATIONS = {
    "projection": {},
    "identity": {"regularizer": "identity"},
    "spc": {"regularizer": "spc"},
    "gamma": {"regularizer": "gamma", "beta_2": 3.0},
    "1-norm": {"slack_set": dpc.SoftBox(0.0, 0.0, 2.0)},
    "1-norm alone": {"slack_set": dpc.SoftBox(0.0, 0.0, 2.0), "lambda_s": 0.0},
    "bound on the slack": {"slack_set": dpc.Box(-0.005, 0.005)},
    "ball of the slack": {"slack_set": dpc.Ball(0.03, per="trajectory")},
    "spc, 1-norm": {"regularizer": "spc", "slack_set": dpc.SoftBox(0.0, 0.0, 2.0)},
    "gamma, 1-norm, rates": {
        "regularizer": "gamma",
        "beta_2": 3.0,
        "slack_set": dpc.SoftBox(0.0, 0.0, 2.0),
        "du_set": dpc.Box(-0.3, 0.3),
    },
}
BOX = {"u_set": dpc.Box(-0.4, 0.4)}


def layer_of(name, data=None, **options):
    data = small_data() if data is None else data
    return dpc.DPCLayer(data, **{**SMALL, **BOX, **FORMULATIONS[name], **options})


def inputs(n=3):
    u_ini, y_ini = windows(n, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(n, 3, 4, seed=2)


def posed(data, options, u_ini, y_ini, g, *, affine=False):
    """Return u, y and the cost of one sample by Clarabel, from the matrices as recorded; cost and violation of g."""
    Up, Yp, Uf, Yf = (m.numpy() for m in data.matrices)
    h, n_u, n_y = data.horizon, data.n_u, data.n_y
    # An invertible change of variables, g = change c, for the solver's sake: rows of D have sizes of 1e-2 to 1e1.
    _, size, turned = torch.linalg.svd(data.stacked, full_matrices=True)
    change = turned.T / torch.cat([size, torch.ones(data.n_g - len(size)).double()])
    c = cvxpy.Variable(data.n_g)
    Up, Yp, Uf, Yf = (m @ change.numpy() for m in (Up, Yp, Uf, Yf))
    u, y, slack = Uf @ c, Yf @ c, Yp @ c - y_ini.flatten().numpy()
    past = torch.cat([data.Up, data.Yp, *[torch.ones(1, data.n_g).double()] * affine])
    W = torch.cat([past, data.Uf])
    M, of_past = (torch.eye(data.n_g).double() - torch.linalg.pinv(X) @ X for X in (W, past))
    weights = {**SMALL, **options}
    cost = weights["Q"] / 2 * cvxpy.sum_squares(y - Y_REF.repeat(h).numpy())
    cost += weights["R"] / 2 * cvxpy.sum_squares(u) + weights["lambda_s"] * cvxpy.sum_squares(slack)
    limits = [Up @ c == u_ini.flatten().numpy(), cvxpy.abs(u) <= 0.4]
    regularizer = weights.get("regularizer", "projection")
    if regularizer == "spc":
        limits.append((torch.linalg.svd(W)[2][len(W) :] @ change).numpy() @ c == 0)
    elif regularizer == "identity":
        cost += weights["lambda_g"] * cvxpy.sum_squares(change.numpy() @ c)
    else:
        cost += weights["lambda_g"] * cvxpy.sum_squares((M @ change).numpy() @ c)
    if "beta_2" in weights:
        cost += weights["beta_2"] * cvxpy.sum_squares(((of_past - M) @ change).numpy() @ c)
    if affine:
        limits.append(change.sum(0).numpy() @ c == 1)
    owner = weights.get("slack_set")
    if isinstance(owner, dpc.SoftBox):
        cost += float(owner.weight) * cvxpy.norm1(slack)
    elif isinstance(owner, dpc.Box):
        limits.append(cvxpy.abs(slack) <= float(owner.upper))
    elif owner is not None:
        limits.append(cvxpy.norm2(slack) <= float(owner.radius))
    if "du_set" in weights:
        before = u_ini[-1].numpy()
        limits.append(cvxpy.abs(u - cvxpy.hstack([before, u[:-n_u]])) <= 0.3)
    c.value = torch.linalg.solve(change, g).numpy()
    cost_of_g = float(cost.value)
    violation = max(float(limit.violation().max()) for limit in limits)
    problem = cvxpy.Problem(cvxpy.Minimize(cost), limits)
    problem.solve(cvxpy.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    assert problem.status in ("optimal", "optimal_inaccurate")
    found = torch.from_numpy(u.value.reshape(h, n_u)), torch.from_numpy(y.value.reshape(h, n_y))
    return *found, problem.value, cost_of_g, violation


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")  # the comparison says by how much
@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("name", FORMULATIONS)
def test_plans_are_those_of_a_conic_solver(name, affine):
    layer, (u_ini, y_ini) = layer_of(name, affine=affine), inputs()
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    for i in range(len(u_ini)):
        given = layer.data, FORMULATIONS[name], u_ini[i], y_ini[i], sol.g[i]
        u, y, cost, cost_of_g, violation = posed(*given, affine=affine)
        assert relative(sol.u[i], u) < CONIC and relative(sol.y[i], y) < CONIC
        assert violation < EXACT and abs(float(sol.value[i]) - cost_of_g) < EXACT * cost_of_g
        assert -COST * cost < cost_of_g - cost < EXACT * cost  # better than the solver's, if anything
    assert float(sol.info.residual.max()) < EXACT and int(sol.info.n_active.sum()) > 0
    if name != "projection":
        assert relative(layer_of("projection", affine=affine)(u_ini, y_ini, y_ref=Y_REF).u, sol.u) > 1e-3


@pytest.mark.parametrize("name", FORMULATIONS)
@pytest.mark.parametrize("which", ["u_ini", "y_ini", "y_ref", "weight", "data"])
def test_gradients_are_those_of_differences(name, which):
    u_ini, y_ini = inputs()
    point = {"u_ini": u_ini, "y_ini": y_ini, "y_ref": Y_REF + 0.1 * randn(3, 6, 4, seed=8)}
    given = FORMULATIONS[name]
    source = torch.Generator().manual_seed(4)
    noisy = dpc.systems.OscillatingMasses(noise=1e-2, generator=source)
    u, y = dpc.collect(noisy, 60, generator=source)
    weight = "beta_2" if "beta_2" in given else "lambda_s"
    value = {**point, "weight": torch.tensor(float({**SMALL, **given}[weight])).double() + 1.0, "data": y}[which]

    def scalar(x):
        data = dpc.HankelData.from_trajectories(u, x if which == "data" else y, t_ini=3, horizon=6)
        learned = {weight: x} if which == "weight" else {}
        sol = layer_of(name, data, **learned)(**{**point, **({which: x} if which in point else {})})
        return (randn(3, 6, 2, seed=5) * sol.u).sum() + (randn(3, 6, 4, seed=6) * sol.y).sum() + sol.value.sum()

    x, step = value.clone().requires_grad_(), 1e-6 * max(1.0, float(value.abs().max()))
    scalar(x).backward()
    assert relative(x.grad, central(scalar, value, step)) < DIFFERENCES * (20 if which == "data" else 1)


@pytest.mark.parametrize("name", ["spc", "gamma", "spc, 1-norm", "1-norm"])
def test_g_has_the_derivative_of_the_data(name):
    source = torch.Generator().manual_seed(4)
    u, y = dpc.collect(dpc.systems.OscillatingMasses(noise=1e-2, generator=source), 40, generator=source)
    u_ini, y_ini = inputs(1)

    def scalar(x):
        data = dpc.HankelData.from_trajectories(u, x, t_ini=3, horizon=6)
        g = layer_of(name, data)(u_ini[0], y_ini[0], y_ref=Y_REF).g
        return (g * randn(*g.shape, seed=7)).sum()

    x = y.clone().requires_grad_()
    scalar(x).backward()
    assert relative(x.grad, central(scalar, y, 1e-6)) < 1e-4


def test_a_price_learns():
    u_ini, y_ini = inputs()

    def scalar(price):
        layer = layer_of("1-norm", slack_set=dpc.SoftBox(0.0, 0.0, price))
        return (layer(u_ini, y_ini, y_ref=Y_REF).u * randn(3, 6, 2, seed=5)).sum()

    price = torch.tensor([2.0, 1.0, 3.0, 2.0], dtype=torch.float64)
    x = price.clone().requires_grad_()
    scalar(x).backward()
    assert relative(x.grad, central(scalar, price)) < DIFFERENCES and float(x.grad.abs().max()) > 0
    layer = layer_of("1-norm", slack_set=dpc.SoftBox(0.0, 0.0, torch.nn.Parameter(price)))
    assert [name for name, _ in layer.named_parameters()] == ["slack_set.weight"]


def test_spc_is_the_limit_of_the_projection():
    u_ini, y_ini = inputs()
    plan = layer_of("spc")(u_ini, y_ini, y_ref=Y_REF).u
    errors = [relative(layer_of("projection", lambda_g=w)(u_ini, y_ini, y_ref=Y_REF).u, plan) for w in (1e4, 1e6)]
    assert errors[1] < errors[0] / 50 < 1e-3  # the error falls like 1 / lambda_g
    assert relative(layer_of("spc", lambda_g=None)(u_ini, y_ini, y_ref=Y_REF).u, plan) == 0.0


def test_outputs_of_spc_are_those_of_the_least_squares_predictor():
    (u_ini, y_ini), layer = inputs(), layer_of("spc")
    plan = layer(u_ini, y_ini, y_ref=Y_REF)
    predicted = Predictor(layer.data)(u_ini, y_ini + plan.slack, plan.u)
    assert relative(plan.y, predicted) < EXACT
    held = layer_of("spc", slack_set=dpc.Box(0.0, 0.0))
    plan = held(u_ini, y_ini, y_ref=Y_REF)
    assert relative(plan.y, Predictor(layer.data)(u_ini, y_ini, plan.u)) < EXACT


def test_a_high_price_leaves_no_slack_and_a_low_one_makes_it_sparse():
    u_ini, y_ini = inputs()
    slack = [layer_of("1-norm alone", slack_set=dpc.SoftBox(0.0, 0.0, w))(u_ini, y_ini, y_ref=Y_REF).slack
             for w in (1e4, 1.0)]  # fmt: skip
    assert float(slack[0].abs().max()) < EXACT
    is_zero = slack[1].abs() < EXACT
    assert 0 < int(is_zero.sum()) < is_zero.numel()


@pytest.mark.parametrize("kernels", [True, False])
def test_a_slack_at_rest_is_held_for_derivatives(kernels, monkeypatch):
    """At an equilibrium no multiplier holds the slack, and it is pinned all the same."""
    if not kernels:
        monkeypatch.setattr("torch_dpc.solve.kernels._kernels", None)
    layer = layer_of("1-norm alone", small_data(1e-2), R=0.1)
    rest = torch.zeros(3, 2, dtype=torch.float64), torch.zeros(3, 4, dtype=torch.float64)
    assert float(layer(*rest).lam.abs().max()) < EXACT
    jacobian = torch.autograd.functional.jacobian(lambda y: layer(rest[0], y).u, rest[1])
    assert relative(jacobian, central(lambda y: layer(rest[0], y).u, rest[1], 1e-6)) < DIFFERENCES
    assert float(jacobian.abs().max()) > 0.1


@pytest.mark.parametrize("name", FORMULATIONS)
def test_a_batch_of_data_is_one_call(name):
    u_ini, y_ini = inputs()
    members = [small_data(seed=seed) for seed in range(3)]
    together = layer_of(name, dpc.HankelBatch(members))(u_ini, y_ini, y_ref=Y_REF)
    for i, data in enumerate(members):
        alone = layer_of(name, data)(u_ini[i], y_ini[i], y_ref=Y_REF)
        assert relative(together.u[i], alone.u) < EXACT and relative(together.g[i], alone.g) < EXACT * 100


def test_data_sets_of_different_rank_stack_with_their_slack():
    members = [small_data(0.0), small_data(1e-2)]
    u_ini, y_ini = inputs(2)
    for name in ("spc, 1-norm", "gamma"):
        together = layer_of(name, dpc.HankelBatch(members))(u_ini, y_ini, y_ref=Y_REF)
        for i, data in enumerate(members):
            assert relative(together.u[i], layer_of(name, data)(u_ini[i], y_ini[i], y_ref=Y_REF).u) < 1e-7


def test_a_batch_of_weights_of_gamma_2():
    u_ini, y_ini = inputs()
    betas = torch.tensor([0.1, 1.0, 10.0], dtype=torch.float64)
    together = layer_of("gamma", beta_2=betas)(u_ini, y_ini, y_ref=Y_REF).u
    for i, beta in enumerate(betas):
        assert relative(together[i], layer_of("gamma", beta_2=beta)(u_ini[i], y_ini[i], y_ref=Y_REF).u) < EXACT


@pytest.mark.parametrize("name", FORMULATIONS)
def test_layers_are_saved_and_copied(name, tmp_path):
    pytest.importorskip("safetensors", reason="files of layers need safetensors: pip install '.[save]'")
    layer, (u_ini, y_ini) = layer_of(name), inputs()
    plan = layer(u_ini, y_ini, y_ref=Y_REF)
    layer.save(tmp_path / "layer.safetensors")
    other = dpc.DPCLayer(small_data(seed=3), **SMALL)
    other.load_state_dict(layer.state_dict())
    copies = dpc.DPCLayer.load(tmp_path / "layer.safetensors"), other, pickle.loads(pickle.dumps(layer))
    for copy in copies:
        assert relative(copy(u_ini, y_ini, y_ref=Y_REF).u, plan.u) < EXACT
        assert copy.regularizer == layer.regularizer
    assert ("slack_set" in repr(layer)) == ("slack_set" in FORMULATIONS[name])


def test_the_size_counts_the_slack():
    assert layer_of("1-norm").reduced_kkt_size == 36 + 12 == layer_of("1-norm").reduction.G.shape[-1]
