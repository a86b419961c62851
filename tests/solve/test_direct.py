"""Single plans from their windows: the direct way gives what the general way gives, and sees every change."""

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, delayed_layer, relative, small_data, small_layer, windows
from torch_dpc.solve import direct as direct_module
from torch_dpc.solve import kernels

SAME = 1e-12  # another order of sums

built = pytest.mark.skipif(not kernels.are_built(), reason="the kernels were not built")
u_ini, y_ini = (w[0] for w in windows(1, 3, seed=1, scale=0.5))

SETS = {
    "box": {"u_set": dpc.Box(-0.5, 0.5)},
    "ball": {"u_set": dpc.Ball(0.4)},
    "cone": {"y_set": dpc.SecondOrderCone()},
    "soft": {"u_set": dpc.Box(-0.5, 0.5), "y_set": dpc.SoftBox(-0.2, 0.2, 3.0)},
    "rates": {"u_set": dpc.Box(-0.5, 0.5), "R_du": 0.3, "du_set": dpc.Box(-0.4, 0.4)},
    "affine": {"u_set": dpc.Box(-0.5, 0.5), "affine": True},
    "slack": {"slack_set": dpc.SoftBox(0.0, 0.0, 2.0)},
    "free": {},
}


@pytest.fixture
def counted(monkeypatch):
    """Return a list that grows by each call that goes the direct way."""
    calls, solve = [], direct_module.Direct.solve

    def counting(self, *args):
        calls.append(args)
        return solve(self, *args)

    monkeypatch.setattr(direct_module.Direct, "solve", counting)
    return calls


def leaves(batch=()):
    """Return the four windows as leaves, the reference of the input as one step for all."""
    whole = (u_ini, y_ini, Y_REF.expand(6, 4) + 0.1, HOLDING.expand(2))
    return [x.expand(*batch, *x.shape).clone().requires_grad_() for x in whole]


def planned(layer, given):
    u, y, y_ref, u_ref = given
    return layer(u, y, y_ref=y_ref, u_ref=u_ref)


@built
@pytest.mark.parametrize("name", SETS)
def test_plans_and_gradients_are_those_of_a_batch_of_one(name, counted):
    layer = small_layer(**{"u_set": None, **SETS[name]})
    one, many = leaves(), leaves((1,))
    many[3] = one[3].detach().clone().requires_grad_()
    alone, batch = planned(layer, one), planned(layer, many)
    assert len(counted) == 1
    for field in ("u", "y", "lam", "g", "value", "slack"):
        assert relative(getattr(alone, field), getattr(batch, field)[0]) < SAME, field
    assert torch.equal(alone.info.status, batch.info.status[0]) and torch.equal(
        alone.info.n_active, batch.info.n_active[0]
    )
    for fields in (("u",), ("u", "y"), ("u", "y", "lam"), ("g", "value")):
        results, others = ([getattr(plan, field) for field in fields] for plan in (alone, batch))
        weights = [torch.cos(torch.arange(float(x.numel()), dtype=x.dtype)).reshape(x.shape) for x in results]
        found = torch.autograd.grad(results, one, weights, retain_graph=True)
        expected = torch.autograd.grad(others, many, [w[None] for w in weights], retain_graph=True)
        for a, b in zip(found, expected, strict=True):
            assert relative(a, b.reshape(a.shape)) < 1e-9


@built
@pytest.mark.parametrize("name", ["box", "ball", "soft", "rates", "affine", "slack"])
def test_derivatives_of_both_orders(name, counted):
    layer = small_layer(**{"u_set": None, **SETS[name]})

    def function(*given):
        plan = planned(layer, given)
        return plan.u, plan.y, plan.value

    assert gradcheck(function, leaves()) and gradgradcheck(function, leaves())
    assert counted


@built
def test_every_change_is_seen(counted):
    R = torch.eye(2, dtype=torch.float64)
    box = dpc.Box(torch.tensor([-3.0, -3.0]).double(), torch.tensor([3.0, 3.0]).double())
    layer = small_layer(R=R, u_set=box)

    def is_that_of_a_new_layer():
        weights = {name: getattr(layer, name) for name in ("Q", "lambda_g", "lambda_s")}
        fresh = dpc.DPCLayer(layer.data, **weights, R=layer.R.detach().clone(), u_set=layer.u_set)
        given = (u_ini, 3.0 * y_ini, None, None)
        with torch.no_grad():
            assert torch.equal(planned(layer, given).u, planned(fresh, given).u)
        return planned(layer, given).u

    seen = [is_that_of_a_new_layer()]
    changes = (
        lambda: R.data.mul_(2.0),
        lambda: box.upper.data.fill_(0.3),
        lambda: setattr(box, "lower", torch.tensor([-0.1, -0.2]).double()),
        lambda: setattr(layer, "lambda_s", 7.0),
        lambda: setattr(layer, "u_set", dpc.Ball(0.1)),
        lambda: setattr(layer, "R", torch.nn.Parameter(3.0 * R)),
        lambda: setattr(layer.R, "data", torch.diag(torch.tensor([1.0, 5.0]).double())),
        lambda: setattr(layer, "data", small_data(noise=1e-1)),
    )
    for change in changes:
        change()
        seen.append(is_that_of_a_new_layer())
        assert relative(seen[-1], seen[-2]) > 1e-6
    assert len(counted) > len(changes)


@built
def test_what_the_direct_way_leaves_to_the_general_one(counted):
    layer = small_layer(u_set=dpc.Box(-0.5, 0.5))
    expected = planned(layer, (u_ini, y_ini, Y_REF, HOLDING)).u
    direct = len(counted)
    assert direct == 1
    assert relative(planned(layer, (u_ini.mT.contiguous().mT, y_ini, Y_REF, HOLDING)).u, expected) < SAME
    assert relative(planned(layer, (u_ini.tolist(), y_ini.numpy(), Y_REF, HOLDING)).u, expected) < SAME
    assert planned(layer, (u_ini.float(), y_ini.float(), Y_REF, HOLDING)).u.dtype == torch.float32
    assert relative(torch.vmap(lambda y: planned(layer, (u_ini, y, Y_REF, HOLDING)).u)(y_ini[None])[0], expected) < SAME
    imaginary = torch.complex(torch.zeros_like(y_ini), -y_ini).conj().imag.contiguous()
    assert relative(planned(layer, (u_ini, imaginary, Y_REF, HOLDING)).u, expected) < SAME
    learns = small_layer(u_set=dpc.Box(-0.5, 0.5), R=torch.nn.Parameter(torch.eye(2, dtype=torch.float64)))
    assert planned(learns, (u_ini, y_ini, Y_REF, HOLDING)).u.requires_grad
    assert len(counted) <= direct + 1


@built
def test_a_plan_that_is_not_vouched_for_is_solved_generally(monkeypatch):
    layer = small_layer(u_set=dpc.Ball(0.4))
    expected, asked = planned(layer, leaves()).u, []

    def doubts(_, theta, lam, v):
        asked.append(theta)
        return torch.zeros(theta.shape[:-1], dtype=torch.bool)

    monkeypatch.setattr(type(layer.factored(torch.device("cpu")).solver.screen), "vouches", doubts)
    assert relative(planned(layer, leaves()).u, expected) < 1e-9
    assert len(asked) > 1  # by the direct way, and by the general one


@built
def test_windows_may_change_after_the_plan(counted):
    layer = small_layer(u_set=dpc.Box(-0.5, 0.5))
    window, leaf = u_ini.clone(), y_ini.clone().requires_grad_()
    plan, same = planned(layer, (window, leaf, Y_REF, HOLDING)), planned(layer, (u_ini, leaf, Y_REF, HOLDING))
    window.zero_()
    assert torch.equal(plan.g, same.g)
    assert torch.equal(*(torch.autograd.grad(x.u.sum(), leaf)[0] for x in (plan, same)))
    assert len(counted) == 2


@built
def test_windows_that_are_wrong_are_named():
    layer = small_layer(u_set=dpc.Box(-0.5, 0.5))
    spoilt = y_ini.clone()
    spoilt[0, 0] = torch.nan
    with pytest.raises(ValueError, match="`y_ini` must be finite"):
        layer(u_ini, spoilt)
    with pytest.raises(ValueError, match="`y_ini` must have shape"):
        layer(u_ini, y_ini[:-1])
    with pytest.raises(ValueError, match="`u_ref` must broadcast"):
        layer(u_ini, y_ini, u_ref=torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ValueError, match="`on_failure` must be one of"):
        layer(u_ini, y_ini, on_failure="hope")


@built
def test_a_sample_without_a_solution_adds_nothing_to_the_gradient(counted):
    layer, past = delayed_layer(), torch.tensor([[0.0], [0.0], [0.9]]).double()
    leaf = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    with pytest.raises(dpc.InfeasibleError):
        layer(past, leaf)
    plan = layer(past, leaf, on_failure="nan")
    assert plan.u.isnan().all() and plan.info.status == dpc.Status.INFEASIBLE
    plan.u.sum().backward()
    assert (leaf.grad == 0).all() and len(counted) == 2
