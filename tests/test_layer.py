"""The layer as a module: shapes, dtypes, copies, and nothing stale."""

import copy
import io
import pickle

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import (
    SMALL,
    Y_REF,
    delayed_layer,
    delayed_windows,
    masses_data,
    randn,
    relative,
    small_data,
    small_layer,
    windows,
)

SAME = 1e-10
#: Single precision in and out: the last digit of the answer, through the rounding of the measurements.
SINGLE = 1e-4


def one():
    u_ini, y_ini = windows(1, 3, seed=1)
    return u_ini[0], y_ini[0]


# --- shapes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (1,), (0,), (5,), (2, 3), (1, 1), (2, 0, 3), (0, 0), (3, 1, 2, 1)], ids=str)
def test_any_leading_shape(batch):
    layer = small_layer()
    u_ini, y_ini = windows(int(np.prod(batch)), 3, seed=1)
    sol = layer(u_ini.reshape(*batch, 3, 2), y_ini.reshape(*batch, 3, 4), y_ref=Y_REF)
    assert sol.u.shape == (*batch, 6, 2)
    assert sol.y.shape == (*batch, 6, 4)
    assert sol.g.shape == (*batch, layer.data.n_g)
    assert sol.lam.shape == (*batch, 36)
    for name in ("status", "iterations", "residual", "n_active", "n_weakly_active"):
        assert getattr(sol.info, name).shape == batch
    for i, (a, b) in enumerate(zip(u_ini, y_ini, strict=True)):
        alone = layer(a, b, y_ref=Y_REF)
        assert relative(sol.u.reshape(-1, 6, 2)[i], alone.u) < SAME
        assert relative(sol.g.reshape(-1, layer.data.n_g)[i], alone.g) < SAME


@pytest.mark.parametrize("batch", [(0,), (2, 0)], ids=str)
def test_an_empty_batch_has_zero_gradients(batch):
    layer = small_layer()
    y_ref = Y_REF.clone().requires_grad_()
    y_ini = torch.zeros(*batch, 3, 4, dtype=torch.float64, requires_grad=True)
    sol = layer(torch.zeros(*batch, 3, 2, dtype=torch.float64), y_ini, y_ref=y_ref)
    (sol.u.sum() + sol.y.sum() + sol.g.sum()).backward()
    assert y_ini.grad.shape == (*batch, 3, 4) and torch.equal(y_ref.grad, torch.zeros(4, dtype=torch.float64))


def test_inputs_broadcast_against_each_other():
    layer = small_layer()
    u_ini, y_ini = windows(4, 3, seed=1)
    y_ref, u_ref = randn(2, 4, 6, 4, seed=2), randn(6, 2, seed=3)
    sol = layer(u_ini[0], y_ini, y_ref=y_ref, u_ref=u_ref)
    assert sol.u.shape == (2, 4, 6, 2)
    for i in range(2):
        for j in range(4):
            assert relative(sol.u[i, j], layer(u_ini[0], y_ini[j], y_ref=y_ref[i, j], u_ref=u_ref).u) < SAME


def test_references_default_to_zero_and_are_held_over_the_horizon():
    layer = small_layer()
    u_ini, y_ini = one()
    zero, ones = torch.zeros(6, 4, dtype=torch.float64), torch.ones(6, 2, dtype=torch.float64)
    assert torch.equal(layer(u_ini, y_ini).y, layer(u_ini, y_ini, y_ref=zero, u_ref=0 * ones).y)
    for u_ref in (torch.ones(2), torch.ones(1, 2), [1.0, 1.0], np.ones(2)):
        assert torch.equal(layer(u_ini, y_ini, u_ref=u_ref).y, layer(u_ini, y_ini, u_ref=ones).y)
    for as_data in (torch.Tensor.numpy, torch.Tensor.tolist):
        assert torch.equal(layer(as_data(u_ini), as_data(y_ini)).y, layer(u_ini, y_ini).y)


# --- dtype and device -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("of_u", "of_y", "out"),
    [(torch.float32,) * 3, (torch.float64,) * 3, (torch.float32, torch.float64, torch.float64)],
    ids=str,
)
def test_results_have_the_dtype_of_the_measurements(of_u, of_y, out):
    layer = small_layer()
    u_ini, y_ini = windows(3, 3, seed=1)
    x, x_double = y_ini.to(of_y).clone().requires_grad_(), y_ini.clone().requires_grad_()
    sol = layer(u_ini.to(of_u), x, y_ref=Y_REF.float())
    assert (sol.u.dtype, sol.y.dtype, sol.g.dtype) == (out,) * 3
    assert sol.info.residual.dtype == torch.float64 and sol.info.residual.max() < 1e-11  # float64 inside
    in_double = layer(u_ini, x_double, y_ref=Y_REF)
    assert relative(sol.u.double(), in_double.u) < SINGLE
    sol.u.square().sum().backward(), in_double.u.square().sum().backward()
    assert x.grad.dtype == of_y and relative(x.grad.double(), x_double.grad) < SINGLE


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("backward", ["reduced", "full"])
def test_on_a_gpu(backward):
    layer = small_layer(backward=backward)
    u_ini, y_ini = windows(20, 3, seed=1)
    answers = []
    for device in ("cpu", "cuda"):
        x = y_ini.to(device).requires_grad_()
        sol = layer.to(device)(u_ini.to(device), x, y_ref=Y_REF.to(device))
        assert sol.u.device.type == sol.g.device.type == device
        sol.u.square().sum().backward()
        answers.append((sol.u.detach().cpu(), x.grad.cpu()))
    assert relative(answers[1][0], answers[0][0]) < SAME and relative(answers[1][1], answers[0][1]) < SAME


# --- a module ---------------------------------------------------------------------------------------------------------


def learning_layer(**options):
    weights = {**{n: torch.tensor(w) for n, w in SMALL.items()}, "Q": 10.0 * torch.eye(4), "R": torch.eye(2)}
    return small_layer(**{n: torch.nn.Parameter(w.double()) for n, w in weights.items()}, **options)


def test_only_parameters_are_registered():
    assert {n for n, _ in learning_layer().named_parameters()} == {"Q", "R", "lambda_g", "lambda_s"}
    assert not list(small_layer(Q=torch.eye(4)).parameters())
    carried = torch.ones(1, requires_grad=True) * torch.eye(4)
    layer = small_layer(Q=carried)
    assert not list(layer.parameters()) and layer.Q is carried
    bound = torch.nn.Parameter(torch.tensor(0.5))
    assert [n for n, _ in small_layer(u_set=dpc.Box(-1.0, bound)).named_parameters()] == ["u_set.upper"]


@pytest.mark.parametrize("make", [small_layer, learning_layer])
@pytest.mark.parametrize("solver", ["auto", "daqp", "newton"])
@pytest.mark.parametrize(
    "how", [copy.deepcopy, copy.copy, lambda x: pickle.loads(pickle.dumps(x))], ids=["deepcopy", "copy", "pickle"]
)
def test_copies_answer_alike(make, solver, how):
    layer = make(solver=solver)
    u_ini, y_ini = one()
    expected = layer(u_ini, y_ini, y_ref=Y_REF).u
    twin = how(layer)
    assert torch.equal(twin(u_ini, y_ini, y_ref=Y_REF).u, expected)
    assert torch.equal(how(twin)(u_ini, y_ini, y_ref=Y_REF).u, expected)


def test_a_deep_copy_is_independent():
    layer = learning_layer()
    u_ini, y_ini = one()
    expected = layer(u_ini, y_ini, y_ref=Y_REF).u.detach()
    twin = copy.deepcopy(layer)
    with torch.no_grad():
        twin.R.mul_(7.0)
        assert relative(twin(u_ini, y_ini, y_ref=Y_REF).u, expected) > 1e-3
        assert torch.equal(layer(u_ini, y_ini, y_ref=Y_REF).u, expected)


def test_state_dict_goes_through_a_file():
    layer, other = learning_layer(), learning_layer()
    with torch.no_grad():
        layer.Q.mul_(3.0)
    u_ini, y_ini = one()
    other(u_ini, y_ini)  # factors of the old weights exist
    file = io.BytesIO()
    torch.save(layer.state_dict(), file)
    file.seek(0)
    assert not other.load_state_dict(torch.load(file)).missing_keys
    assert torch.equal(layer(u_ini, y_ini, y_ref=Y_REF).u, other(u_ini, y_ini, y_ref=Y_REF).u)


def test_casts_of_the_module_keep_double_precision_inside():
    layer = learning_layer()
    u_ini, y_ini = one()
    expected = layer(u_ini, y_ini, y_ref=Y_REF).u
    assert layer.float().Q.dtype == torch.float32
    assert relative(layer(u_ini, y_ini, y_ref=Y_REF).u, expected) < SAME  # these weights are exact in single precision
    assert torch.equal(layer.double()(u_ini, y_ini, y_ref=Y_REF).u, expected)
    assert layer.to("cpu") is layer and layer.eval() is layer and layer.train() is layer


# --- nothing stale ----------------------------------------------------------------------------------------------------


def sgd_step(parameter, rate):
    parameter.grad = -torch.eye(len(parameter), dtype=parameter.dtype)
    torch.optim.SGD([parameter], rate).step()


CHANGES = {
    "in place": lambda layer: layer.R.mul_(5.0),
    "through .data": lambda layer: layer.R.data.fill_(2.0),
    "slice of .data": lambda layer: layer.Q.data.__setitem__((0, 0), 3.0),
    "assigned .data": lambda layer: setattr(layer.lambda_g, "data", torch.tensor(9.0, dtype=torch.float64)),
    "load_state_dict": lambda layer: layer.load_state_dict({**layer.state_dict(), "lambda_s": torch.tensor(2.0)}),
    "optimiser": lambda layer: sgd_step(layer.R, 4.0),
    "new Parameter": lambda layer: setattr(layer, "R", torch.nn.Parameter(4 * torch.eye(2).double())),
    "a bound": lambda layer: setattr(layer.u_set, "upper", 0.25),
    "a set": lambda layer: setattr(layer, "u_set", dpc.Box(-0.1, 0.1)),
    "the data": lambda layer: setattr(layer, "data", small_data(seed=3)),
    "the engine": lambda layer: setattr(layer, "solver", "newton"),
}


@pytest.mark.parametrize("grad", [False, True], ids=["no_grad", "grad"])
@pytest.mark.parametrize("change", CHANGES)
def test_the_next_call_knows_what_changed(change, grad):
    layer = learning_layer()
    u_ini, y_ini = windows(2, 3, seed=1)
    with torch.set_grad_enabled(grad):
        before = layer(u_ini, y_ini, y_ref=Y_REF).u
        with torch.no_grad():
            CHANGES[change](layer)
        after = layer(u_ini, y_ini, y_ref=Y_REF).u
        weights = {n: getattr(layer, n).detach().clone() for n in SMALL}
        fresh = dpc.DPCLayer(layer.data, **weights, u_set=layer.u_set)(u_ini, y_ini, y_ref=Y_REF).u
    assert relative(after, fresh) < SAME
    assert change == "the engine" or relative(after, before) > 1e-4


#: What may be assigned after construction, beyond the weights and sets above.
LATER = {
    "R_du": 50.0,
    "R_du learns": torch.nn.Parameter(50.0 * torch.eye(2, dtype=torch.float64)),
    "lambda_u": 3.0,
    "lambda_u learns": torch.nn.Parameter(torch.tensor(3.0, dtype=torch.float64)),
    "du_set": dpc.Box(-0.3, 0.3),
    "terminal_steps": np.int64(1),
    "regularizer": "identity",
    "u_set": dpc.Ball(0.1),
    "u_set none": None,
    "data of a longer horizon": masses_data(1e-2, steps=150, t_ini=3, horizon=8),
}


@pytest.mark.parametrize("change", LATER)
@pytest.mark.parametrize("there_before", [False, True])
def test_a_setting_assigned_later_is_that_of_a_layer_made_so(change, there_before):
    """There and back again: each plan is that of a fresh layer with what `config()` says, sizes and copies agree."""
    sets = {} if change == "terminal_steps" else {"u_set": dpc.Box(-0.4, 0.4)}
    name, (u_ini, y_ini) = change.split(" ")[0], windows(2, 3, seed=1)
    u_ini = 0.3 * u_ini
    layer = dpc.DPCLayer(small_data(), **SMALL, **sets)
    before = getattr(layer, name)
    plain = layer(u_ini, y_ini, y_ref=Y_REF)
    for value in (LATER[change], before) if there_before else (LATER[change],):
        setattr(layer, name, value)
        fresh = dpc.DPCLayer(layer.data, **layer.config())
        ours, theirs = (each(u_ini, y_ini, y_ref=Y_REF) for each in (layer, fresh))
        assert torch.equal(ours.u, theirs.u) and torch.equal(ours.lam, theirs.lam)
        assert (layer.terms, layer.sizes) == (fresh.terms, fresh.sizes)
        assert layer.reduced_kkt_size == fresh.reduced_kkt_size == ours.lam.shape[-1]
        assert torch.equal(copy.deepcopy(layer)(u_ini, y_ini, y_ref=Y_REF).u, ours.u)
        changed = ours.u.shape != plain.u.shape or relative(ours.u, plain.u) > 1e-4
        assert changed == (value is not before)


def test_a_plan_belongs_to_the_data_it_was_made_with():
    layer, (u_ini, y_ini) = small_layer(), one()
    plan, again = (layer(u_ini, y_ini, y_ref=Y_REF) for _ in range(2))
    expected = again.g.clone()
    layer.data = small_data(seed=4)
    assert torch.equal(plan.g, expected)


def test_the_bounds_are_those_of_the_present_horizon():
    layer, (u_ini, y_ini) = small_layer(), one()
    layer(u_ini, y_ini)
    layer.data = masses_data(1e-2, steps=150, t_ini=3, horizon=8)
    assert layer.bounds(torch.device("cpu"))[0].shape == (48,) and layer(u_ini, y_ini).u.shape == (8, 2)


@pytest.mark.parametrize(
    ("change", "most"),
    [
        (lambda s: s.factors.__setitem__(0, dpc.Box(-0.1, 0.1)), lambda u: u[..., 0].abs().amax()),
        (lambda s: s.factors.__setitem__(1, dpc.Ball(0.1)), lambda u: u[..., 1].abs().amax()),
        (lambda s: setattr(s.factors[1], "per", "trajectory"), lambda u: 0.2 * u[..., 1].norm(dim=-1).amax()),
    ],
    ids=["a box for a box", "a ball for a box", "a trajectory for a step"],
)
def test_what_changes_within_a_product_is_noticed(change, most):
    product = dpc.Product([(dpc.Box(-0.5, 0.5), 0), (dpc.Ball(0.5), 1)])
    layer, (u_ini, y_ini) = dpc.DPCLayer(small_data(), **SMALL, u_set=product), windows(2, 3, seed=1)
    assert float(most(layer(u_ini, y_ini, y_ref=Y_REF).u)) > 0.1 + 1e-3
    change(product)
    assert float(most(layer(u_ini, y_ini, y_ref=Y_REF).u)) == pytest.approx(0.1, abs=1e-9)


class Disc(dpc.Box):
    """A box by its class, a ball by its projection."""

    def __init__(self, radius):
        super().__init__(-radius, radius)

    def project(self, x):
        return x * (self.upper / torch.linalg.vector_norm(x, dim=-1, keepdim=True)).clamp_max(1.0)


def test_a_box_with_a_projection_of_its_own_is_what_it_projects_to():
    u_ini, y_ini = windows(3, 3, seed=1)
    plans, grads = [], []
    for owner in (Disc(0.3), dpc.Ball(0.3)):
        x = y_ini.clone().requires_grad_()
        plans.append(dpc.DPCLayer(small_data(), **SMALL, u_set=owner)(u_ini, x, y_ref=Y_REF).u)
        grads.append(torch.autograd.grad(plans[-1].sum(), x)[0])
    assert relative(*plans) < SAME and relative(*grads) < SAME
    assert float(plans[0].detach().norm(dim=-1).amax()) == pytest.approx(0.3, abs=1e-9)


def test_a_parametrised_box_stays_a_box():
    layer = small_layer(u_set=dpc.Box(-0.5, torch.nn.Parameter(torch.tensor(0.3, dtype=torch.float64))))
    expected = layer(*one(), y_ref=Y_REF).u
    torch.nn.utils.parametrize.register_parametrization(layer.u_set, "upper", Exponential())
    assert layer.feasible_set.is_box and relative(layer(*one(), y_ref=Y_REF).u, expected) < SAME
    assert small_layer(u_set=layer.u_set).feasible_set.is_box


class Exponential(torch.nn.Module):
    def forward(self, log):
        return log.exp()

    def right_inverse(self, value):
        return value.log()


def test_settings_changed_after_a_call_are_used():
    layer = delayed_layer()
    impossible = delayed_windows(2, impossible=(1,))
    for _ in range(2):
        layer.on_failure = "raise"
        with pytest.raises(dpc.InfeasibleError):
            layer(*impossible)
        layer.on_failure = "nan"
        assert layer(*impossible).info.status.tolist() == [0, 1]


@pytest.mark.parametrize("builds_inside", [False, True])
def test_inference_mode_leaves_nothing_that_breaks_training(builds_inside):
    u_ini, y_ini = one()
    layer = small_layer()
    with torch.inference_mode():
        layer = small_layer() if builds_inside else layer
        expected = layer(u_ini, y_ini, y_ref=Y_REF).u.clone()
    x = y_ini.clone().requires_grad_()
    sol = layer(u_ini, x, y_ref=Y_REF)
    sol.u.sum().backward()
    assert torch.equal(sol.u.detach(), expected) and x.grad.abs().sum() > 0


def test_calls_leave_nothing_on_the_module():
    layer = small_layer()
    u_ini, y_ini = one()
    layer(u_ini, y_ini)
    kept = {k: v for k, v in vars(layer).items() if k != "_factors"}
    entries = len(layer._factors)
    for _ in range(3):
        layer(u_ini, y_ini.clone().requires_grad_(), y_ref=Y_REF).u.sum().backward()
    assert {k: v for k, v in vars(layer).items() if k != "_factors"} == kept and len(layer._factors) == entries
