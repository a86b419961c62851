"""A plan: its value and slack, indexing, pickles, moves, transforms and words."""

import copy
import pickle

import numpy as np
import pytest
import torch
from torch.utils import _pytree as pytree

import torch_dpc as dpc
from helpers import (
    SMALL,
    Y_REF,
    delayed_layer,
    delayed_windows,
    randn,
    relative,
    small_data,
    small_layer,
    windows,
)

EXACT = 1e-10
SETS = {
    "boxes": {"u_set": dpc.Box(-0.3, 0.3), "y_set": dpc.Box(-0.9, 0.9)},
    "no sets": {"u_set": None, "y_set": None},
    "ball": {"u_set": dpc.Ball(0.4, center=0.1)},
    "cone": {"y_set": dpc.Product([(dpc.SecondOrderCone(), [0, 1]), (dpc.Box(-5.0, 5.0), [2, 3])])},
    "soft": {"u_set": dpc.Box(-0.3, 0.3), "y_set": dpc.SoftBox(-0.2, 0.2, weight=20.0)},
    "rates": {"u_set": dpc.Box(-0.3, 0.3), "du_set": dpc.Box(-0.1, 0.1), "R_du": 0.5},
}


def layer_of(case, **options):
    return dpc.DPCLayer(small_data(), **{**SMALL, "u_set": None, "y_set": None, **SETS[case], **options})


def inputs(n=3):
    u_ini, y_ini = windows(n, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(n, 3, 4, seed=2)


def cost_by_definition(layer, plan, u_ini, y_ini):
    """The objective as the paper writes it, in NumPy, from u, y and g; the price of soft bounds added."""
    data = layer.data
    Up, Uf, Yp = (m.numpy() for m in (data.Up, data.Uf, data.Yp))
    W = np.concatenate([Up, Yp, Uf])
    M = np.eye(W.shape[1]) - np.linalg.pinv(W) @ W
    u, y, g = (x.detach().numpy() for x in (plan.u, plan.y, plan.g))
    total = SMALL["lambda_g"] * np.sum((M @ g) ** 2) + SMALL["lambda_s"] * np.sum((Yp @ g - y_ini.numpy().ravel()) ** 2)
    total += 0.5 * SMALL["Q"] * np.sum((y - Y_REF.numpy()) ** 2) + 0.5 * SMALL["R"] * np.sum(u**2)
    if layer.R_du is not None:
        total += 0.5 * layer.R_du * np.sum(np.diff(u, axis=0, prepend=u_ini.numpy()[-1:]) ** 2)
    if isinstance(layer.y_set, dpc.SoftBox):
        total += layer.y_set.weight * np.sum(np.maximum(np.abs(y) - layer.y_set.box.upper, 0.0))
    return total


@pytest.mark.parametrize("case", SETS)
def test_value_is_the_cost_of_the_plan(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()
    plan = layer(u_ini, y_ini, y_ref=Y_REF)
    if case != "no sets":
        assert (plan.info.n_active > 0).any()
    for i in range(3):
        expected = cost_by_definition(layer, plan[i], u_ini[i], y_ini[i])
        assert float(plan.value[i]) == pytest.approx(expected, rel=1e-8)
    slack = (plan.g @ layer.data.Yp.T).reshape(3, 3, 4) - y_ini
    assert relative(plan.slack, slack) < 1e-6 and plan.slack.shape == (3, 3, 4)  # small differences of y


@pytest.mark.parametrize("case", SETS)
def test_derivatives_of_the_value(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs(2)
    x, y_ref = y_ini.clone().requires_grad_(), (Y_REF + 0.1 * randn(2, 6, 4, seed=5)).requires_grad_()

    def value(x, y_ref):
        return layer(u_ini, x, y_ref=y_ref).value

    assert torch.autograd.gradcheck(value, (x, y_ref), rtol=1e-5, atol=1e-4)
    assert torch.autograd.gradgradcheck(lambda x: value(x, y_ref.detach()), x, rtol=1e-4, atol=1e-2)


def test_the_envelope_theorem_gives_the_gradient_in_weights_and_bounds():
    u_ini, y_ini = inputs(2)
    upper, radius, price = (torch.tensor(s, dtype=torch.float64, requires_grad=True) for s in (0.25, 0.4, 15.0))
    Q = (10.0 * torch.eye(4, dtype=torch.float64)).requires_grad_()

    def boxes(Q, upper, lambda_s):
        layer = layer_of("boxes", Q=Q, u_set=dpc.Box(-0.3, upper), lambda_s=lambda_s)
        return layer(u_ini, y_ini, y_ref=Y_REF).value

    def curved(radius, price):
        layer = layer_of("soft", u_set=dpc.Ball(radius), y_set=dpc.SoftBox(-0.2, 0.2, weight=price))
        return layer(u_ini, y_ini, y_ref=Y_REF).value

    lambda_s = torch.tensor(SMALL["lambda_s"], dtype=torch.float64, requires_grad=True)
    symmetric = (lambda Q, upper, s: boxes((Q + Q.T) / 2, upper, s / 1e3)), (Q, upper, 1e3 * lambda_s.detach())
    symmetric[1][2].requires_grad_()
    assert torch.autograd.gradcheck(*symmetric, rtol=1e-4, atol=1e-4)
    assert torch.autograd.gradcheck(curved, (radius, price), rtol=1e-4, atol=1e-5)
    assert torch.autograd.gradgradcheck(curved, (radius, price), rtol=1e-3, atol=1e-3)


def test_a_sample_without_a_plan_has_no_value_and_adds_nothing():
    layer, (u_ini, y_ini) = delayed_layer(on_failure="nan"), delayed_windows(3, impossible=[1])
    x = y_ini.clone().requires_grad_()
    plan = layer(u_ini, x)
    assert plan.info.status.tolist() == [0, 1, 0] and plan.value.isnan().tolist() == [False, True, False]
    plan.value.nansum().backward()
    others = [0, 2]
    alone = y_ini[others].requires_grad_()
    layer(u_ini[others], alone).value.sum().backward()
    assert relative(x.grad[others], alone.grad) < 1e-12 and not x.grad[1].any()


def assert_same(a, b):
    for name in ("u", "y", "lam", "g", "value", "slack"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for name in ("status", "iterations", "residual", "n_active", "n_weakly_active", "nonsingular"):
        assert torch.equal(getattr(a.info, name), getattr(b.info, name)), name


@pytest.mark.parametrize("case", ["boxes", "ball"])
@pytest.mark.parametrize("how", [lambda p: pickle.loads(pickle.dumps(p)), copy.deepcopy, copy.copy])
def test_copies_tell_the_same(case, how):
    u_ini, y_ini = inputs()
    plan = layer_of(case)(u_ini, y_ini.requires_grad_(), y_ref=Y_REF)
    assert_same(how(plan), plan)


def test_a_pickle_without_windows_says_what_it_lacks():
    layer, (u_ini, y_ini) = small_layer(), inputs()
    compact = dpc.DPCLayer(layer.data.compressed(), **SMALL)
    loaded = pickle.loads(pickle.dumps(compact(u_ini, y_ini)))
    assert loaded.value.shape == (3,)
    with pytest.raises(NotImplementedError, match="`g`: it was not available when the plan was pickled"):
        loaded.g  # noqa: B018


@pytest.mark.parametrize("case", ["boxes", "soft"])
def test_indexing(case):
    u_ini, y_ini = inputs(6)
    layer = layer_of(case)
    plan = layer(u_ini.reshape(2, 3, 3, 2), y_ini.reshape(2, 3, 3, 4), y_ref=Y_REF)
    one = layer(u_ini[4], y_ini[4], y_ref=Y_REF)
    for found in (plan[1][1], plan[1, 1], plan[1].sample(1)):
        assert found.u.shape == (6, 2) and found.value.shape == ()
        for name in ("u", "y", "lam", "g", "value"):
            assert relative(getattr(found, name), getattr(one, name)) < EXACT
    mask = torch.tensor([[True, False, False], [False, True, True]])
    assert torch.equal(plan[mask].u, plan.u[mask]) and plan[:, 1:].info.status.shape == (2, 2)
    assert len(plan) == 2 and [p.u.shape for p in plan] == [(3, 6, 2)] * 2
    for index, says in ((2, "out of"), (..., "index the batch")):
        with pytest.raises(IndexError, match=says):
            plan[index]
    with pytest.raises(IndexError, match="without a batch dimension"):
        one[0]
    with pytest.raises(TypeError, match="without a batch dimension"):
        len(one)


def test_a_plan_of_batched_weights_is_indexed_with_them():
    u_ini, y_ini = inputs(1)
    sweep = torch.tensor([0.1, 1.0, 10.0], dtype=torch.float64)
    plan = layer_of("boxes", lambda_g=sweep)(u_ini[0], y_ini[0], y_ref=Y_REF)
    one = layer_of("boxes", lambda_g=10.0)(u_ini[0], y_ini[0], y_ref=Y_REF)
    for name in ("u", "g", "value", "slack"):
        assert relative(getattr(plan[2], name), getattr(one, name)) < EXACT


def test_detach_and_to():
    u_ini, y_ini = inputs()
    plan = small_layer()(u_ini, y_ini.requires_grad_(), y_ref=Y_REF)
    detached = plan.detach()
    assert plan.value.requires_grad and plan.g.requires_grad
    assert not any(x.requires_grad for x in (detached.u, detached.y, detached.lam, detached.g, detached.value))
    assert_same(detached, plan)
    single = plan.to(torch.float32)
    assert (single.u.dtype, single.g.dtype, single.value.dtype) == (torch.float32,) * 3
    assert single.lam.dtype == single.info.residual.dtype == torch.float64 and single.info.status.dtype == torch.int64
    assert plan.to("meta").g.device.type == plan.to("meta").lam.device.type == "meta"


@pytest.mark.parametrize("case", ["boxes", "ball", "soft"])
def test_vmap_returns_plans(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()
    plan = torch.vmap(lambda u, y: layer(u, y, y_ref=Y_REF))(u_ini, y_ini)
    expected = layer(u_ini, y_ini, y_ref=Y_REF)
    assert isinstance(plan, dpc.DPCSolution) and plan.info.status.tolist() == [0, 0, 0]
    for name in ("u", "y", "lam", "g", "value", "slack"):
        assert relative(getattr(plan, name), getattr(expected, name)) < EXACT
    assert torch.equal(plan.info.nonsingular, expected.info.nonsingular)


def test_a_plan_is_a_pytree():
    u_ini, y_ini = inputs()
    plan = small_layer()(u_ini, y_ini, y_ref=Y_REF)
    doubled = pytree.tree_map(lambda x: x.clone(), plan)
    assert_same(doubled, plan) and doubled.u is not plan.u
    info = pytree.tree_map(lambda x: x[:1], plan.info)
    assert info.status.tolist() == [0]
    with pytest.raises(NotImplementedError, match="`nonsingular` was not computed"):
        info.nonsingular  # noqa: B018
    losses, aux = torch.func.grad(lambda y: ((p := small_layer()(u_ini, y)).u.sum(), p), has_aux=True)(y_ini)
    assert isinstance(aux, dpc.DPCSolution) and losses.shape == y_ini.shape


def test_a_log_is_a_pytree_and_pickles():
    plant = dpc.systems.OscillatingMasses()
    layer = small_layer()
    log = dpc.simulate(plant, dpc.DPCController(layer, replan_every=3), torch.zeros(4), steps=4)
    moved = pytree.tree_map(lambda x: x.clone(), log)
    for found in (moved, pickle.loads(pickle.dumps(log)), log.detach()):
        assert isinstance(found, dpc.ClosedLoopLog)
        for name in ("t", "u", "y", "y_ref", "p", "status"):
            assert torch.equal(getattr(found, name), getattr(log, name))


def test_words():
    u_ini, y_ini = inputs()
    layer = small_layer(u_set=dpc.Box(-0.1, 0.1), on_failure="nan")
    told = repr(layer(u_ini, y_ini, y_ref=Y_REF))
    assert told.startswith("DPCSolution(u=(3, 6, 2) float64 in [-0.1, 0.1]") and "status=3 SOLVED" in told
    assert told.count("\n") <= 4 and "tensor" not in told
    assert "status=SOLVED, residual=" in repr(layer(u_ini[0], y_ini[0], y_ref=Y_REF).info)
    failing = delayed_layer(on_failure="nan")(*delayed_windows(3, impossible=[0, 1, 2]))
    assert "status=3 INFEASIBLE" in repr(failing) and "all NaN" in repr(failing)
    torch.vmap(lambda y: (repr(layer(u_ini[0], y)), y)[1])(y_ini)
    assert "(0, 6, 2)" in repr(layer(u_ini[:0], y_ini[:0]))
