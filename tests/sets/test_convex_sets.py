"""Plans in sets that are no boxes: an independent cone solver, differences, every transform, failures."""

import copy
import pickle

import numpy as np
import pytest
import torch
from torch.func import grad, hessian, jacfwd, jacrev, vmap

import torch_dpc as dpc
from helpers import (
    HOLDING,
    SMALL,
    Y_REF,
    central,
    delayed_layer,
    delayed_windows,
    paper_layer,
    randn,
    relative,
    small_data,
    windows,
)

#: An interior-point method at its tightest.
FULL = 1e-6  # the paper's system, condition about 1e14 before its scaling
CONE_SOLVER = 1e-6
DIFFERENCES = 1e-6
EXACT = 1e-10
F_AT_A_SOLUTION = 1e-9


class Disc(dpc.ConvexSet):
    """A user's set: a projection and nothing else."""

    def project(self, x):
        return x * (0.6 / torch.linalg.vector_norm(x, dim=-1, keepdim=True)).clamp_max(1.0)


def ball(cp, x, radius):
    return [cp.norm(step) <= radius for step in x]


CASES = {
    "ball": ({"u_set": dpc.Ball(0.6)}, lambda cp, u, y: ball(cp, u, 0.6)),
    "ball of a trajectory": (
        {"u_set": dpc.Ball(1.0, per="trajectory")},
        lambda cp, u, y: [cp.norm(cp.hstack(u)) <= 1.0],
    ),
    "cone of inputs": ({"u_set": dpc.SecondOrderCone()}, lambda cp, u, y: [cp.abs(s[1]) <= s[0] for s in u]),
    "cone of outputs": (
        {"u_set": dpc.Box(-0.5, 0.5), "y_set": dpc.SecondOrderCone()},
        lambda cp, u, y: [cp.abs(s) <= 0.5 for s in u] + [cp.norm(s[1:]) <= s[0] for s in y],
    ),
    "product": (
        {
            "u_set": dpc.Box(-0.5, 0.5),
            "y_set": dpc.Product([(dpc.Ball(0.8), [0, 1]), (dpc.Box(-0.5, 0.5), [2, 3])]),
        },
        lambda cp, u, y: (
            [cp.abs(s) <= 0.5 for s in u] + [cp.norm(s[:2]) <= 0.8 for s in y] + [cp.abs(s[2:]) <= 0.5 for s in y]
        ),
    ),
    "soft outputs": (
        {"u_set": dpc.Box(-0.5, 0.5), "y_set": dpc.SoftBox(-0.4, 0.4, 3.0)},
        lambda cp, u, y: [cp.abs(s) <= 0.5 for s in u],
    ),
    "changes of the input": (
        {"u_set": dpc.Ball(0.6), "du_set": dpc.Ball(0.5)},
        lambda cp, u, y: ball(cp, u, 0.6) + [cp.norm(b - a) <= 0.5 for a, b in zip(u, u[1:], strict=False)],
    ),
    "a user's": ({"u_set": Disc()}, lambda cp, u, y: ball(cp, u, 0.6)),
}


def inputs(n=3):
    u_ini, y_ini = windows(n, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(n, 3, 4, seed=2)


def layer_of(case, **options):
    return dpc.DPCLayer(small_data(), **{**SMALL, **CASES[case][0], **options})


def cone_plan(layer, constraints, soft, u_ini, y_ini):
    """The plan by Clarabel, at every tolerance it reaches.

    g is eliminated by NumPy, the cost brought to 1/2 |x|^2, and the sets are in the words of cvxpy.
    """
    cp = pytest.importorskip("cvxpy", reason="cvxpy is an optional baseline")
    data = layer.data
    D = np.concatenate([m.numpy() for m in data.matrices])
    parts = np.split(np.linalg.qr(D.T)[1].T, np.cumsum([len(m) for m in data.matrices])[:-1])
    Up, Yp, Uf, Yf = parts
    W = np.concatenate([Up, Yp, Uf])
    M = np.eye(W.shape[1]) - np.linalg.pinv(W) @ W
    roots = [(SMALL[k] * f) ** 0.5 for k, f in (("R", 1), ("Q", 1), ("lambda_g", 2), ("lambda_s", 2))]
    E = np.concatenate([root * rows for root, rows in zip(roots, (Uf, Yf, M, Yp), strict=True)])
    e = [np.zeros(len(Uf)), np.tile(Y_REF, data.horizon), np.zeros(len(M)), y_ini.numpy().ravel()]
    e = np.concatenate([root * target for root, target in zip(roots, e, strict=True)])
    start = np.linalg.pinv(Up) @ u_ini.numpy().ravel()
    Z = np.linalg.svd(Up)[2][len(Up) :].T
    Q, T = np.linalg.qr(E @ Z)
    B = Z @ np.linalg.inv(T)
    g0 = start + B @ (Q.T @ (e - E @ start))
    x = cp.Variable(B.shape[1])
    u, y = ([f @ g0 + (f @ B) @ x for f in np.split(F, data.horizon)] for F in (Uf, Yf))
    price = sum(soft.weight * cp.sum(cp.pos(cp.abs(s) - soft.box.upper)) for s in y) if soft else 0
    first = [cp.norm(u[0] - u_ini[-1].numpy()) <= 0.5] if layer.du_set is not None else []
    problem = cp.Problem(cp.Minimize(0.5 * cp.sum_squares(x) + price), constraints(cp, u, y) + first)
    found = []
    for tolerance in (1e-9, 1e-10, 1e-11, 1e-12, 1e-13):  # which of them it can reach differs
        try:
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance)
        except cp.SolverError:
            continue
        found.append(tuple(torch.tensor(np.array([s.value for s in v])) for v in (u, y)))
    return found


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("case", CASES)
def test_a_cone_solver_finds_the_same_plan(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert (sol.info.n_active > 0).any() and float(sol.info.residual.max()) < EXACT
    soft = layer.y_set if isinstance(layer.y_set, dpc.SoftBox) else None
    for i in range(3):
        plans = cone_plan(layer, CASES[case][1], soft, u_ini[i], y_ini[i])
        assert min(max(relative(sol.u[i], u), relative(sol.y[i], y)) for u, y in plans) < CONE_SOLVER


@pytest.mark.parametrize("case", CASES)
def test_gradients_are_those_of_differences(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()
    weights = randn(3, 6, 2, seed=5), randn(3, 6, 4, seed=6), randn(3, layer.reduced_kkt_size, seed=7)
    point = {"u_ini": u_ini, "y_ini": y_ini, "y_ref": Y_REF + 0.1 * randn(3, 6, 4, seed=8), "u_ref": randn(3, 6, 2)}

    def scalar(**changed):
        sol = layer(**{**point, **changed})
        assert not sol.info.n_weakly_active.any()
        return sum((w * x).sum() for w, x in zip(weights, (sol.u, sol.y, sol.lam), strict=True))

    for name, value in point.items():
        x = value.clone().requires_grad_()
        scalar(**{name: x}).backward()
        assert relative(x.grad, central(lambda x, name=name: scalar(**{name: x}), value, 1e-6)) < DIFFERENCES


number = torch.tensor
PARAMETERS = {
    "a radius": (lambda r: {"u_set": dpc.Ball(r)}, number(0.6)),
    "a radius a step": (lambda r: {"u_set": dpc.Ball(r)}, torch.linspace(0.4, 0.6, 6)),
    "a radius a sample": (lambda r: {"u_set": dpc.Ball(r)}, torch.linspace(0.4, 0.6, 3)[:, None]),
    "the radius of a trajectory": (lambda r: {"u_set": dpc.Ball(r, per="trajectory")}, number(1.0)),
    "a center": (lambda c: {"u_set": dpc.Ball(0.6, c)}, number([0.1, -0.2])),
    "a price": (lambda w: {"u_set": dpc.Box(-0.5, 0.5), "y_set": dpc.SoftBox(-0.4, 0.4, w)}, number(3.0)),
    "a soft bound": (lambda b: {"u_set": dpc.Box(-0.5, 0.5), "y_set": dpc.SoftBox(-0.9, b, 30.0)}, number(0.8)),
    "a bound a sample": (lambda b: {"u_set": dpc.Box(-0.5, b)}, torch.linspace(0.2, 0.4, 3)[:, None, None]),
    "a bound in a product": (
        lambda b: {"y_set": dpc.Product([(dpc.Ball(0.8), [0, 1]), (dpc.Box(-b, b), [2, 3])])},
        number(0.5),
    ),
    "a limit of changes": (lambda b: {"du_set": dpc.Box(-b, b), "u_set": dpc.Ball(0.6)}, number(0.2)),
    "lambda_g": (lambda w: {"u_set": dpc.Ball(0.6), "lambda_g": w}, number(1.0)),
    "Q": (lambda w: {"u_set": dpc.Ball(0.6), "Q": torch.diag(w)}, number([10.0, 8.0, 5.0, 1.0])),
}


@pytest.mark.parametrize("which", PARAMETERS)
def test_gradients_of_parameters(which):
    make, value = PARAMETERS[which]
    value, (u_ini, y_ini) = value.double(), inputs()
    weights = randn(3, 6, 2, seed=5), randn(3, 6, 4, seed=6)

    def scalar(x):
        sol = dpc.DPCLayer(small_data(), **{**SMALL, **make(x)})(u_ini, y_ini, y_ref=Y_REF)
        return sum((w * part).sum() for w, part in zip(weights, (sol.u, sol.y), strict=True))

    x = value.clone().requires_grad_()
    scalar(x).backward()
    assert float(x.grad.abs().max()) > 1e-3
    assert relative(x.grad, central(scalar, value, 1e-6)) < DIFFERENCES


@pytest.mark.parametrize("case", ["ball", "product", "soft outputs", "a user's"])
def test_every_transform(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()

    def plan(u, y):
        return layer(u, y, y_ref=Y_REF).u

    def scalar(y):
        sol = layer(u_ini[0], y, y_ref=Y_REF)
        return (sol.u**2).sum() + (sol.lam**2).sum()

    def of_y(y):
        return plan(u_ini[0], y)

    J = central(of_y, y_ini[0], 1e-6)
    assert relative(jacrev(of_y)(y_ini[0]), J) < DIFFERENCES
    assert relative(jacfwd(of_y)(y_ini[0]), J) < DIFFERENCES
    assert relative(vmap(plan)(u_ini, y_ini), plan(u_ini, y_ini)) < EXACT
    assert relative(vmap(plan, (None, 0))(u_ini[0], y_ini), plan(u_ini[:1].expand_as(u_ini), y_ini)) < EXACT
    H = central(grad(scalar), y_ini[0], 1e-6)
    assert relative(hessian(scalar)(y_ini[0]), H) < DIFFERENCES
    assert relative(jacrev(jacrev(scalar))(y_ini[0]), H) < DIFFERENCES
    assert relative(jacrev(jacfwd(scalar))(y_ini[0]), H) < DIFFERENCES
    if case == "soft outputs":  # piecewise affine
        assert relative(jacfwd(jacfwd(scalar))(y_ini[0]), H) < DIFFERENCES
    else:
        with pytest.raises(NotImplementedError, match="forward derivatives of forward derivatives"):
            jacfwd(jacfwd(scalar))(y_ini[0])
    assert relative(vmap(hessian(scalar))(y_ini)[0], H) < DIFFERENCES


@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_many_cotangents_at_once(case, batch):
    layer, (u_ini, y_ini) = layer_of(case), inputs()
    u_ini, y_ini = (u_ini, y_ini) if batch else (u_ini[0], y_ini[0])
    x = y_ini.clone().requires_grad_()
    sol = layer(u_ini, x, y_ref=Y_REF)
    out = torch.cat([sol.u.flatten(-2), sol.y.flatten(-2), sol.lam], dim=-1)
    cotangents = randn(3, *out.shape, seed=5)
    one_by_one = torch.stack([torch.autograd.grad(out, x, c, retain_graph=True)[0] for c in cotangents])
    (found,) = torch.autograd.grad(out, x, cotangents, is_grads_batched=True)
    assert relative(found, one_by_one) < EXACT


@pytest.mark.parametrize("case", ["ball", "cone of outputs", "product", "soft outputs", "a user's"])
def test_the_older_vmap_has_every_rule(case):
    """`vectorize=True` and the batched checks of torch.autograd know no rules of a Function."""
    layer, (u_ini, y_ini) = layer_of(case), inputs()

    def part(y):
        sol = layer(u_ini[0], y, y_ref=Y_REF)
        return torch.cat([sol.u[:2].reshape(-1) ** 3, sol.y[-1] * sol.lam[:4]])

    expected = jacrev(part)(y_ini[0])
    for strategy in ("reverse-mode", "forward-mode"):
        found = torch.autograd.functional.jacobian(part, y_ini[0], vectorize=True, strategy=strategy)
        assert relative(found, expected) < EXACT, strategy
    twice = torch.autograd.functional.hessian(lambda y: part(y).sum(), y_ini[0], vectorize=True)
    assert relative(twice, hessian(lambda y: part(y).sum())(y_ini[0])) < EXACT
    x = y_ini[0].clone().requires_grad_()
    batched = {"check_batched_grad": True, "check_forward_ad": True, "check_batched_forward_grad": True}
    assert torch.autograd.gradcheck(part, x, **batched)


def test_vmap_over_a_parameter_of_a_set_says_what_to_do():
    u_ini, y_ini = (x[0] for x in inputs())
    layer = dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Ball(torch.nn.Parameter(torch.tensor(0.6).double())))
    plans = {
        "radius": lambda r: dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Ball(r))(u_ini, y_ini).u,
        "price": lambda w: dpc.DPCLayer(small_data(), **SMALL, y_set=dpc.SoftBox(-0.4, 0.4, w))(u_ini, y_ini).u,
        "functional_call": lambda r: torch.func.functional_call(layer, {"u_set.radius": r}, (u_ini, y_ini)).u,
    }
    for plan in plans.values():
        with pytest.raises(NotImplementedError, match="a leading batch dimension"):
            vmap(plan)(torch.tensor([0.4, 0.6], dtype=torch.float64))


@pytest.mark.parametrize("case", ["ball", "cone of inputs", "product"])
def test_gradcheck_and_gradgradcheck(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()

    def function(u, y):
        sol = layer(u, y, y_ref=Y_REF)
        return sol.u**3, sol.lam * sol.lam.roll(1, -1), sol.g[..., :3] ** 2

    point = (u_ini[0].requires_grad_(), y_ini[0].requires_grad_())
    assert torch.autograd.gradcheck(function, point, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(function, point)


def test_the_hyper_gradient_of_a_gradient():
    """d/d radius of the gradient in y_ini: the curvature of the set and its size both matter."""
    u_ini, y_ini = (x[0] for x in inputs())

    def first(radius):
        y = y_ini.clone().requires_grad_()
        sol = dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Ball(radius))(u_ini, y, y_ref=Y_REF)
        (g,) = torch.autograd.grad((sol.u**2).sum(), y, create_graph=True)
        return (g * randn(3, 4, seed=3)).sum()

    radius = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    first(radius).backward()
    difference = (first(radius.detach() + 1e-5) - first(radius.detach() - 1e-5)) / 2e-5
    assert relative(radius.grad, difference) < DIFFERENCES


SECOND = {k: PARAMETERS[k] for k in ("a radius", "the radius of a trajectory", "a center", "a price")}


@pytest.mark.parametrize("which", SECOND)
def test_second_derivatives_over_a_set_know_that_the_plan_moves(which):
    make, value = SECOND[which]
    value, (u_ini, y_ini) = value.double(), inputs()

    def cost(x, y=y_ini):
        sol = dpc.DPCLayer(small_data(), **{**SMALL, **make(x)})(u_ini, y, y_ref=Y_REF)
        return (sol.u**3).sum() + (sol.lam**2).sum()

    def first(x, y=y_ini):
        with torch.enable_grad():
            x = x.detach().clone().requires_grad_()
            return torch.autograd.grad(cost(x, y), x)[0]

    expected = central(first, value, 1e-6)
    x, y = value.clone().requires_grad_(), y_ini.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(cost(x, y), x, create_graph=True)
    rows = [torch.autograd.grad(g, x, retain_graph=True)[0] for g in gradient.reshape(-1)]
    assert relative(torch.stack(rows).reshape(expected.shape), expected) < DIFFERENCES
    assert relative(hessian(cost)(value), expected) < DIFFERENCES
    (mixed,) = torch.autograd.grad(gradient.sum(), y)
    assert relative(mixed, central(lambda y: first(value, y).sum(), y_ini, 1e-6)) < DIFFERENCES


HARD = {
    "balls of inputs and outputs": {"u_set": dpc.Ball(0.8), "y_set": dpc.Ball(2.5)},
    "tight balls": {"u_set": dpc.Ball(0.2), "y_set": dpc.Box(-5.0, 5.0)},
    "cones": {"u_set": dpc.SecondOrderCone(), "y_set": dpc.Box(-5.0, 5.0)},
    "a trajectory": {"u_set": dpc.Ball(2.0, per="trajectory"), "y_set": dpc.Box(-3.0, 3.0)},
    "cheap violations": {"u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.SoftBox(-1.0, 1.0, 5.0)},
    "dear violations": {"u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.SoftBox(-0.5, 0.5, 100.0)},
}


@pytest.mark.parametrize("noise", [0.0, 1e-2])
@pytest.mark.parametrize("case", HARD)
def test_hard_problems_on_the_papers_data(case, noise):
    """On noise-free data the rows of the outputs depend on each other: Newton alone fails where many of them bind."""
    layer = paper_layer(noise, **HARD[case])
    u_ini, y_ini = windows(12, seed=3)
    info = layer(u_ini, y_ini + 0.02 * randn(12, 6, 4, seed=4), y_ref=Y_REF, u_ref=0.5 * HOLDING).info
    assert float(info.residual.max()) < F_AT_A_SOLUTION and (info.n_active > 0).any()


def test_a_box_in_disguise_is_the_box():
    u_ini, y_ini = inputs()
    plain = dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Box(-0.3, 0.3))(u_ini, y_ini, y_ref=Y_REF)
    # A ball of one channel is an interval; it goes the other way.
    interval = dpc.Product([(dpc.Ball(0.3), [0]), (dpc.Ball(0.3), [1])])
    same = dpc.DPCLayer(small_data(), **SMALL, u_set=interval)(u_ini, y_ini, y_ref=Y_REF)
    for name in ("u", "y", "lam", "g"):
        assert relative(getattr(same, name), getattr(plain, name)) < EXACT
    assert torch.equal(same.info.n_active, plain.info.n_active)


def test_a_price_above_the_multipliers_is_the_hard_box():
    u_ini, y_ini = inputs()
    hard = dpc.DPCLayer(small_data(), **SMALL, y_set=dpc.Box(-0.9, 0.9))(u_ini, y_ini, y_ref=Y_REF)
    price = 2 * float(hard.lam.abs().max())
    soft = dpc.DPCLayer(small_data(), **SMALL, y_set=dpc.SoftBox(-0.9, 0.9, price))(u_ini, y_ini, y_ref=Y_REF)
    assert float(hard.lam.abs().max()) > 0 and relative(soft.u, hard.u) < 1e-8
    cheap = dpc.DPCLayer(small_data(), **SMALL, y_set=dpc.SoftBox(-0.9, 0.9, price / 20))(u_ini, y_ini, y_ref=Y_REF)
    assert float(cheap.y.abs().max()) > 0.9 + 1e-6
    assert float(cheap.lam.abs().max()) <= price / 20 * (1 + EXACT)


def test_impossible_samples_are_proven_and_leave_the_others_alone():
    y_set = dpc.Product([(dpc.Box(-0.3, 0.3), [0]), (dpc.Ball(0.5), [1])])
    layer = delayed_layer(y_set=y_set, on_failure="nan")
    u_ini, y_ini = delayed_windows(4, impossible=(1, 3))
    y_ini.requires_grad_()
    sol = layer(u_ini, y_ini)
    assert sol.info.status.tolist() == [0, dpc.Status.INFEASIBLE, 0, dpc.Status.INFEASIBLE]
    assert sol.u[1].isnan().all() and sol.u[0].isfinite().all() and sol.g[3].isnan().all()
    sol.u.nan_to_num().sum().backward()
    alone = y_ini.detach()[[0, 2]].requires_grad_()
    layer(u_ini[[0, 2]], alone).u.sum().backward()
    assert relative(y_ini.grad[[0, 2]], alone.grad) < 1e-12 and not y_ini.grad[[1, 3]].any()
    with pytest.raises(dpc.InfeasibleError, match="batch indices 1, 3"):
        layer(u_ini, y_ini, on_failure="raise")


@pytest.mark.parametrize("batch", [(), (1,), (0,), (2, 3)], ids=str)
def test_any_leading_shape(batch):
    layer = layer_of("ball")
    n = max(int(np.prod(batch)), 1)
    u_ini, y_ini = inputs(n)
    expected = layer(u_ini, y_ini, y_ref=Y_REF).u
    count = int(np.prod(batch))
    u_ini, y_ini = u_ini[:count].reshape(*batch, 3, 2), y_ini[:count].reshape(*batch, 3, 4)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert sol.u.shape == (*batch, 6, 2) and sol.info.status.shape == batch
    assert relative(sol.u.reshape(-1, 6, 2), expected[:count]) < EXACT if count else True


@pytest.mark.parametrize("case", ["ball", "cone of outputs", "product", "soft outputs"])
def test_the_papers_full_system_gives_the_same_derivative(case):
    u_ini, y_ini = inputs()
    x = y_ini.clone().requires_grad_()
    bars = []
    for backward in ("reduced", "full"):
        sol = layer_of(case, backward=backward)(u_ini, x, y_ref=Y_REF)
        loss = (randn(*sol.u.shape, seed=1) * sol.u).sum() + (randn(*sol.lam.shape, seed=2) * sol.lam).sum()
        bars.append(torch.autograd.grad(loss, x)[0])
    assert (sol.info.n_active > 0).any() and relative(bars[1], bars[0]) < FULL


@pytest.mark.parametrize("case", ["radius", "soft bound"])
def test_forward_derivatives_over_the_parameters_of_a_set(case):
    """By torch.autograd.forward_ad, which does not nest, as gradcheck takes them."""
    u_ini, y_ini = inputs(2)
    start = torch.tensor([0.4, 5.0], dtype=torch.float64, requires_grad=True)

    def plan(x):
        sets = {"u_set": dpc.Ball(x[0])} if case == "radius" else {"y_set": dpc.SoftBox(-x[0], x[0], weight=x[1])}
        return dpc.DPCLayer(small_data(), **SMALL, **sets)(u_ini, y_ini, y_ref=Y_REF).u

    assert torch.autograd.gradcheck(plan, start, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(plan, start, check_fwd_over_rev=True)


def test_the_full_system_reaches_a_radius_and_derives_once():
    radius = torch.nn.Parameter(torch.tensor(0.4, dtype=torch.float64))
    u_ini, y_ini = inputs()
    bars = []
    for backward in ("reduced", "full"):
        sol = layer_of("ball", u_set=dpc.Ball(radius), backward=backward)(u_ini, y_ini, y_ref=Y_REF)
        bars.append(torch.autograd.grad((randn(*sol.u.shape, seed=1) * sol.u).sum(), radius)[0])
    assert bars[0].abs() > 1e-3 and relative(bars[1], bars[0]) < FULL
    (bar,) = torch.autograd.grad(
        layer_of("ball", u_set=dpc.Ball(radius), backward="full")(u_ini, y_ini, y_ref=Y_REF).u.sum(),
        radius,
        create_graph=True,
    )
    with pytest.raises(NotImplementedError, match="gives first derivatives"):
        bar.backward()


def test_newton_may_be_named_for_any_set():
    u_ini, y_ini = inputs()
    plans = [layer_of("ball", solver=solver)(u_ini, y_ini, y_ref=Y_REF).u for solver in ("auto", "newton")]
    assert relative(plans[1], plans[0]) < EXACT


def test_a_sweep_of_weights_is_one_call():
    u_ini, y_ini = (x[0] for x in inputs())
    sweep = torch.tensor([0.1, 1.0, 10.0], dtype=torch.float64)
    whole = layer_of("ball", lambda_g=sweep)(u_ini, y_ini, y_ref=Y_REF)
    for weight, u in zip(sweep, whole.u, strict=True):
        assert relative(u, layer_of("ball", lambda_g=weight)(u_ini, y_ini, y_ref=Y_REF).u) < EXACT


@pytest.mark.parametrize(
    "how", [copy.deepcopy, lambda layer: pickle.loads(pickle.dumps(layer))], ids=["copy", "pickle"]
)
def test_copies_answer_alike(how):
    layer, (u_ini, y_ini) = layer_of("product"), inputs()
    before = layer(u_ini, y_ini).u
    assert torch.equal(how(layer)(u_ini, y_ini).u, before)


def test_a_set_learns_and_its_change_is_seen():
    layer = layer_of("ball", u_set=dpc.Ball(torch.nn.Parameter(torch.tensor(0.6, dtype=torch.float64))))
    u_ini, y_ini = inputs()
    assert [name for name, _ in layer.named_parameters()] == ["u_set.radius"]
    before = layer(u_ini, y_ini, y_ref=Y_REF).u
    layer.u_set.radius.data.fill_(0.3)
    after = layer(u_ini, y_ini, y_ref=Y_REF).u
    assert float(after.detach().norm(dim=-1).max()) < 0.3 + EXACT < float(before.detach().norm(dim=-1).max())


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"u_set": dpc.Ball(1.0, torch.zeros(3))}, "`u_set` does not fit 2 channels over 6 steps"),
        ({"y_set": dpc.Product([(dpc.Ball(1.0), [0, 1])])}, "`y_set`|the product has 2 channels, the plan 4"),
        ({"u_set": dpc.Ball(1.0), "lambda_u": 1.0, "backward": "full"}, "is the system of the paper"),
        ({"u_set": dpc.Ball(1.0), "solver": "daqp"}, "for sets that are boxes"),
        ({"u_set": 1.0}, "`u_set` must be a ConvexSet or None"),
    ],
)
def test_bad_layers_are_named(options, says):
    with pytest.raises(ValueError, match=says):
        dpc.DPCLayer(small_data(), **{**SMALL, **options})(*inputs())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("case", ["ball", "cone of outputs", "product", "soft outputs", "changes of the input"])
def test_on_a_gpu(case):
    layer, (u_ini, y_ini) = layer_of(case), inputs()
    found = {}
    for device in ("cpu", "cuda"):
        y = y_ini.to(device).requires_grad_()
        sol = layer(u_ini.to(device), y, y_ref=Y_REF.to(device))
        sol.u.square().sum().backward()
        assert sol.u.device.type == device
        found[device] = (sol.u.cpu(), sol.lam.cpu(), y.grad.cpu())
    for on_gpu, on_cpu in zip(found["cuda"], found["cpu"], strict=True):
        assert relative(on_gpu, on_cpu) < 1e-9
