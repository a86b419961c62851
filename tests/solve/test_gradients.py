"""Derivatives with respect to measurements and references, by every road torch offers."""

import pytest
import torch
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, central, model_plan, paper_layer, randn, relative, small_layer, windows

#: The solution is affine in its data between kinks: differences lose only rounding over their step.
DIFFERENCES = 1e-6
EXACT = 1e-10
FULL = 1e-7  # cond(J) = 1e14 before scaling
NAMES = ["u_ini", "y_ini", "y_ref", "u_ref"]


def strict_inputs(n=2, noise=1e-2, layer=None, seed=1):
    """Inputs `(n, steps, channels)` of a small problem with active bounds, none of them weakly."""
    u_ini, y_ini = windows(n, 3, seed=seed, scale=0.5)
    inputs = {
        "u_ini": u_ini,
        "y_ini": y_ini + 0.1 * randn(n, 3, 4, seed=seed + 1),
        "y_ref": Y_REF + 0.1 * randn(n, 6, 4, seed=seed + 2),
        "u_ref": 0.3 * randn(n, 6, 2, seed=seed + 3),
    }
    info = (layer or small_layer(noise))(**inputs).info
    assert (info.n_active > 0).all() and not info.n_weakly_active.any()
    return inputs


def bounded_layer(noise=1e-2, **options):
    """Inputs and outputs meet their bounds."""
    return small_layer(noise, **{"u_set": dpc.Box(-0.4, 0.4), "y_set": dpc.Box(-0.9, 0.9), **options})


def outputs(sol):
    return sol.u, sol.y, sol.lam, sol.g


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("solver", ["newton", "daqp"])
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_gradcheck(name, solver, noise):
    layer = bounded_layer(noise, solver=solver)
    inputs = {k: v[0] for k, v in strict_inputs(1, layer=layer).items()}
    x = inputs.pop(name).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: outputs(layer(**{name: x}, **inputs)), x, check_forward_ad=True)


@pytest.mark.parametrize("batched", [False, True])
def test_gradgradcheck_where_the_active_set_is_strict(batched):
    layer = bounded_layer()
    inputs = strict_inputs(2, layer=layer)
    inputs = [inputs[name] if batched else inputs[name][0] for name in NAMES]
    rows = [0, 3, -1]

    def function(*x):
        sol = layer(**dict(zip(NAMES, x, strict=True)))
        # powers: otherwise every second derivative is zero, and a lost cotangent stays unseen
        u, y = (v.flatten(-2)[..., rows] for v in (sol.u, sol.y))
        return u**3, sol.lam[..., rows] * y, sol.g[..., rows] ** 2

    inputs = tuple(x.requires_grad_() for x in inputs)
    assert torch.autograd.gradgradcheck(function, inputs)


@pytest.mark.parametrize("noise", [0.0, 1e-2])
@pytest.mark.parametrize("backward", ["reduced", "full"])
def test_central_differences_on_the_papers_data(noise, backward):
    layer = paper_layer(noise, backward=backward)
    u_ini, y_ini = (w[0] for w in windows(1, seed=3))
    y_ini = y_ini + 0.02 * randn(6, 4, seed=4)  # what the data cannot produce costs lambda_s = 1e6
    # Not the holding input: the last input of a plan moves no output in it, follows u_ref, and would touch the bound.
    inputs = {"u_ini": u_ini, "y_ini": y_ini, "y_ref": Y_REF, "u_ref": 0.5 * HOLDING}
    weight_u, weight_y = randn(25, 2, seed=5), randn(25, 4, seed=6)

    def scalar(**changed):
        sol = layer(**{**inputs, **changed})
        assert sol.info.n_active > 0 and sol.info.n_weakly_active == 0
        return (weight_u * sol.u).sum() + (weight_y * sol.y).sum()

    leaves = {k: v.clone().requires_grad_() for k, v in inputs.items()}
    found = torch.autograd.grad(scalar(**leaves), list(leaves.values()))
    for name, g in zip(leaves, found, strict=True):
        assert relative(g, central(lambda x, name=name: scalar(**{name: x}), inputs[name])) < DIFFERENCES, name


def test_differences_of_the_true_model_agree():
    """An oracle without data, without Hankel matrices, and without our solver."""
    layer = paper_layer()
    u_ini, y_ini = (w[0] for w in windows(1, seed=3))
    x = y_ini.clone().requires_grad_()
    layer(u_ini, x, y_ref=Y_REF, u_ref=HOLDING).u.sum().backward()
    expected = central(lambda y: model_plan(layer, u_ini, y, Y_REF, HOLDING)[0].sum(), y_ini, step=1e-4)
    assert relative(x.grad, expected) < DIFFERENCES


@pytest.mark.parametrize("case", ["free", "some", "all at bounds", "outputs", "weak", "paper", "paper weak"])
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_reduced_and_full_backward_agree(case, noise):
    sets = {
        "free": {"u_set": None},
        "some": {},
        "all at bounds": {"u_set": dpc.Box(-1e-3, 1e-3)},
        "outputs": {"u_set": dpc.Box(-0.4, 0.4), "y_set": dpc.Box(-0.9, 0.9)},
    }
    grads = []
    for backward in ("reduced", "full"):
        if case.startswith("paper"):
            layer = paper_layer(noise, backward=backward)
            u_ini, y_ini = windows(2, seed=3)
        else:
            layer = small_layer(noise, backward=backward, **sets.get(case, {"u_set": dpc.Box(-1.0, 1.0)}))
            u_ini, y_ini = windows(2, 3, seed=3, scale=0.5)
        if case.endswith("weak"):  # the steady state, on the bound
            u_ini, y_ini = HOLDING.expand_as(u_ini), Y_REF.expand_as(y_ini)
        leaves = [x.clone().requires_grad_() for x in (u_ini, y_ini, Y_REF, HOLDING)]
        sol = layer(leaves[0], leaves[1], y_ref=leaves[2], u_ref=leaves[3])
        loss = (sol.u * randn(*sol.u.shape)).sum() + (sol.y**2).sum()
        grads.append(torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, leaves)]))
    assert relative(grads[1], grads[0]) < FULL


def test_the_full_backward_says_what_it_cannot_do():
    layer = small_layer(backward="full")
    u_ini, y_ini = (w[0] for w in windows(1, 3))
    with pytest.raises((NotImplementedError, ValueError, RuntimeError), match="reduced"):
        torch.autograd.functional.hessian(lambda y: (layer(u_ini, y).u ** 3).sum(), y_ini)


# --- batches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 5, 40])
def test_the_gradient_of_a_batch_is_that_of_its_samples(count):
    layer = bounded_layer(0.0)
    u_ini, y_ini = windows(count, 3, seed=2, scale=0.5)
    x = y_ini.clone().requires_grad_()
    (batch,) = torch.autograd.grad(layer(u_ini, x, y_ref=Y_REF).u.square().sum(), x)
    for i in {0, 1, count - 1}:
        alone = y_ini[i].clone().requires_grad_()
        (single,) = torch.autograd.grad(layer(u_ini[i], alone, y_ref=Y_REF).u.square().sum(), alone)
        assert relative(batch[i], single) < EXACT


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_of_a_shared_input_is_the_sum(name):
    layer = small_layer()
    inputs = strict_inputs(7)
    inputs[name] = inputs[name][0]
    shared = inputs[name].clone().requires_grad_()
    own = inputs[name].expand(7, *inputs[name].shape).clone().requires_grad_()
    for x in (shared, own):
        layer(**{**inputs, name: x}).u.pow(3).sum().backward()
    assert relative(shared.grad, own.grad.sum(0)) < EXACT


def test_a_reference_given_once_collects_the_horizon():
    layer = small_layer()
    u_ini, y_ini = windows(3, 3, seed=1, scale=0.5)
    short, long = Y_REF.clone().requires_grad_(), Y_REF.repeat(3, 6, 1).requires_grad_()
    for y_ref in (short, long):
        layer(u_ini, y_ini, y_ref=y_ref).y.pow(2).sum().backward()
    assert relative(short.grad, long.grad.sum((0, 1))) < EXACT


# --- transforms -------------------------------------------------------------------------------------------------------


MAPPED = [("u_ini",), ("y_ref",), ("u_ini", "y_ini"), ("y_ini", "u_ref"), tuple(NAMES)]


@pytest.mark.parametrize("mapped", MAPPED, ids=str)
@pytest.mark.parametrize("dim", [0, 1, -1])
def test_vmap_over_any_inputs(mapped, dim):
    layer = small_layer()
    inputs = strict_inputs(3)
    one = {k: v if k in mapped else v[0] for k, v in inputs.items()}
    moved = [one[k].movedim(0, dim) if k in mapped else one[k] for k in NAMES]
    in_dims = tuple(dim if k in mapped else None for k in NAMES)
    found = vmap(lambda *x: outputs(layer(**dict(zip(NAMES, x, strict=True)))), in_dims)(*moved)
    for a, b in zip(found, outputs(layer(**one)), strict=True):
        assert relative(a, b.expand_as(a)) < EXACT


def test_jacobians_by_every_road():
    layer = bounded_layer()
    inputs = {k: v[0] for k, v in strict_inputs(1, layer=layer).items()}
    y_ini = inputs.pop("y_ini")

    def plan(y):
        return layer(y_ini=y, **inputs).u

    expected = central(plan, y_ini)
    tangents = torch.eye(12, dtype=torch.float64).reshape(12, 3, 4)
    roads = {
        "jacrev": jacrev(plan)(y_ini),
        "jacfwd": jacfwd(plan)(y_ini),
        "jvp": torch.stack([jvp(plan, (y_ini,), (t,))[1] for t in tangents], dim=-1).reshape(6, 2, 3, 4),
        "vmap of jvp": vmap(lambda t: jvp(plan, (y_ini,), (t,))[1])(tangents).movedim(0, -1).reshape(6, 2, 3, 4),
    }
    for road, found in roads.items():
        assert relative(found, roads["jacrev"]) < EXACT, road
    assert relative(roads["jacrev"], expected) < DIFFERENCES


@pytest.mark.parametrize("backward", ["reduced", "full"])
@pytest.mark.parametrize("batch", [(), (1,), (2,), (20,)], ids=str)
def test_many_cotangents_at_once(batch, backward):
    layer = bounded_layer(backward=backward)
    u_ini, y_ini = windows(20, 3, seed=1, scale=0.5)
    u_ini, y_ini = (w[: batch[0]] if batch else w[0] for w in (u_ini, y_ini))
    x = y_ini.clone().requires_grad_()
    sol = layer(u_ini, x, y_ref=Y_REF)
    cotangents = randn(3, *sol.u.shape, seed=5)
    one_by_one = torch.stack([torch.autograd.grad(sol.u, x, c, retain_graph=True)[0] for c in cotangents])
    (found,) = torch.autograd.grad(sol.u, x, cotangents, is_grads_batched=True, retain_graph=True)
    assert relative(found, one_by_one) < EXACT
    if not batch:
        rows = torch.autograd.functional.jacobian(lambda y: layer(u_ini, y, y_ref=Y_REF).u, y_ini, vectorize=True)
        assert relative((rows * cotangents[0][..., None, None]).sum((0, 1)), one_by_one[0]) < EXACT


def test_hessians_and_their_vmap():
    layer = bounded_layer()
    inputs = strict_inputs(3, layer=layer)

    def loss(y, u, y_ref):
        sol = layer(u, y, y_ref=y_ref)
        return (sol.u**3).sum() + (sol.lam * sol.y.sum()).sum() + (sol.g**2).sum()

    args = inputs["y_ini"], inputs["u_ini"], inputs["y_ref"]
    found = vmap(hessian(loss))(*args)
    first = [a[0] for a in args]
    expected = central(lambda y: grad(loss)(y, *first[1:]), first[0])
    assert relative(found[0], expected) < DIFFERENCES
    for road in (hessian(loss), jacrev(jacrev(loss)), jacrev(grad(loss)), jacfwd(jacfwd(loss))):
        assert relative(road(*first), found[0]) < EXACT
    assert relative(vmap(grad(loss))(*args)[0], grad(loss)(*first)) < EXACT


def test_the_older_vmap_has_every_rule():
    """`vectorize=True` and the batched checks of torch.autograd know no rules of a Function."""
    layer = bounded_layer()
    inputs = {k: v[0] for k, v in strict_inputs(1, layer=layer).items()}
    y_ini = inputs.pop("y_ini")

    def part(y):
        sol = layer(y_ini=y, **inputs)
        return torch.cat([sol.u[:2].reshape(-1) ** 3, sol.y[-1] * sol.lam[:4], sol.g[:2] ** 2])

    expected = jacrev(part)(y_ini)
    for strategy in ("reverse-mode", "forward-mode"):
        found = torch.autograd.functional.jacobian(part, y_ini, vectorize=True, strategy=strategy)
        assert relative(found, expected) < EXACT, strategy
    twice = torch.autograd.functional.hessian(lambda y: part(y).sum(), y_ini, vectorize=True)
    assert relative(twice, hessian(lambda y: part(y).sum())(y_ini)) < EXACT
    x = y_ini.clone().requires_grad_()
    batched = {"check_batched_grad": True, "check_forward_ad": True, "check_batched_forward_grad": True}
    assert torch.autograd.gradcheck(part, x, **batched)
    assert torch.autograd.gradgradcheck(part, x, check_batched_grad=True)


@pytest.mark.parametrize("u_set", [dpc.Box(-0.5, 0.5), dpc.Ball(0.5)], ids=["box", "ball"])
def test_many_cotangents_of_a_sweep_of_weights(u_set):
    """One matrix a sample, and the parameters of the problem differentiated too."""
    weights = torch.tensor([0.1, 1.0, 10.0], dtype=torch.float64, requires_grad=True)
    bound = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
    u_ini, y_ini = windows(3, 3, seed=1, scale=0.5)
    u = small_layer(lambda_g=weights, u_set=u_set, y_set=dpc.Box(-bound, bound))(u_ini, y_ini, y_ref=Y_REF).u
    cotangents = randn(4, *u.shape, seed=5)
    found = torch.autograd.grad(u, (weights, bound), cotangents, is_grads_batched=True, retain_graph=True)
    for i, c in enumerate(cotangents):
        for many, one in zip(found, torch.autograd.grad(u, (weights, bound), c, retain_graph=True), strict=True):
            assert one.abs().max() > 0 and relative(many[i], one) < EXACT


def vmapped_bounds(road):
    """A plan as a function of the upper bound of its inputs."""
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=1, scale=0.5))
    if road == "set":
        return lambda b: small_layer(u_set=dpc.Box(-0.5, b))(u_ini, y_ini, y_ref=Y_REF).u
    layer = small_layer(u_set=dpc.Box(-0.5, torch.nn.Parameter(torch.ones((), dtype=torch.float64))))
    if road == "functional_call":
        return lambda b: torch.func.functional_call(layer, {"u_set.upper": b}, (u_ini, y_ini), {"y_ref": Y_REF}).u
    theta = layer.flatten(u_ini, y_ini, Y_REF, None)[0]
    lower, upper = (b.detach() for b in layer.bounds(theta.device))
    return lambda b: layer.plan(theta, lower, torch.cat([b.expand(12), upper[12:]])).u


@pytest.mark.parametrize("road", ["set", "functional_call", "plan"])
def test_vmap_over_bounds_alone(road):
    plan = vmapped_bounds(road)
    bounds = torch.tensor([0.1, 0.25, 0.4], dtype=torch.float64)
    one_by_one = torch.stack([plan(b) for b in bounds])
    assert (one_by_one.amax((1, 2)) == bounds).all()  # every bound is met
    assert relative(vmap(plan)(bounds), one_by_one) < EXACT

    def scalar(b):
        return (plan(b) ** 3).sum()

    slopes = torch.stack([central(scalar, b) for b in bounds])
    assert relative(vmap(grad(scalar))(bounds), slopes) < DIFFERENCES
    assert relative(vmap(jacfwd(scalar))(bounds), slopes) < DIFFERENCES
    curvature = torch.stack([central(grad(scalar), b) for b in bounds])
    assert relative(vmap(hessian(scalar))(bounds), curvature) < DIFFERENCES
    assert relative(plan(bounds[0]), one_by_one[0]) < EXACT  # nothing mapped was kept


@pytest.mark.parametrize("bad", [-0.6, float("nan")])
def test_mapped_bounds_are_checked_too(bad):
    bounds = torch.tensor([0.5, bad], dtype=torch.float64)
    by_set, by_call = vmapped_bounds("set"), vmapped_bounds("functional_call")
    for road in (vmap(by_set), vmap(grad(lambda b: by_call(b).sum()))):
        with pytest.raises(ValueError, match="at most `upper`"):
            road(bounds)


@pytest.mark.parametrize("u_set", [dpc.Box(-0.5, 0.5), dpc.Ball(0.5)], ids=["box", "ball"])
@pytest.mark.parametrize("name", ["lambda_g", "lambda_s", "R", "Q"])
def test_every_transform_over_a_weight(name, u_set):
    value = torch.diag(torch.tensor([10.0, 8.0, 5.0, 1.0])).double() if name == "Q" else torch.tensor(2.0).double()
    layer = small_layer(u_set=u_set, **{name: torch.nn.Parameter(value.clone())})
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=1, scale=0.5))
    y_ini = y_ini + 0.1 * randn(3, 4, seed=2)
    diagonal = value.diagonal() if value.ndim else value

    def plan(x):
        given = {name: torch.diag(x) if x.ndim else x}
        return torch.func.functional_call(layer, given, (u_ini, y_ini), {"y_ref": Y_REF}).u

    def scalar(x):
        return (plan(x) ** 3).sum()

    J = central(plan, diagonal)
    assert J.abs().max() > 1e-6
    for road in (jacrev, jacfwd):
        assert relative(road(plan)(diagonal), J) < DIFFERENCES, road.__name__
    for strategy in ("reverse-mode", "forward-mode"):
        rows = torch.autograd.functional.jacobian(plan, diagonal, vectorize=True, strategy=strategy)
        assert relative(rows, J) < DIFFERENCES, strategy
    found = {"forward": hessian(scalar)(diagonal), "backward": jacrev(jacrev(scalar))(diagonal)}
    found["backward over forward"] = jacrev(jacfwd(scalar))(diagonal)
    found["older vmap"] = torch.autograd.functional.hessian(scalar, diagonal, vectorize=True)
    H = central(grad(scalar), diagonal)
    for road, second in found.items():
        assert relative(second, H) < DIFFERENCES, road
    with pytest.raises(NotImplementedError, match="forward derivatives of forward derivatives"):
        jacfwd(jacfwd(scalar))(diagonal)
    with pytest.raises(NotImplementedError, match=f"`{name}` a leading batch dimension"):
        vmap(plan)(torch.stack([diagonal, 2 * diagonal]))


@pytest.mark.parametrize("u_set", [dpc.Box(-0.5, 0.5), dpc.Ball(0.5)], ids=["box", "ball"])
@pytest.mark.parametrize("road", [hessian, jacrev, jacfwd, vmap])
def test_a_first_call_within_a_transform_leaves_a_sound_layer(road, u_set):
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=1, scale=0.5))

    def loss(layer):
        return lambda y: (layer(u_ini, y, y_ref=Y_REF).u ** 3).sum()

    layer, used = small_layer(u_set=u_set), small_layer(u_set=u_set)
    used(u_ini, y_ini, y_ref=Y_REF)
    x = y_ini[None] if road is vmap else y_ini
    expected = road(loss(used))(x)
    assert relative(road(loss(layer))(x), expected) < EXACT
    assert relative(road(lambda y: loss(small_layer(u_set=u_set))(y))(x), expected) < EXACT  # made within it
    assert relative(hessian(loss(layer))(y_ini), hessian(loss(used))(y_ini)) < EXACT
    y = y_ini.clone().requires_grad_()
    assert relative(torch.autograd.grad(loss(layer)(y), y)[0], grad(loss(used))(y_ini)) < EXACT


@pytest.mark.parametrize("u_set", [dpc.Box(-0.5, 0.5), dpc.Ball(0.5)], ids=["box", "ball"])
@pytest.mark.parametrize("name", ["lambda_g", "bound", "data"])
def test_an_outer_derivative_is_seen_from_within_an_inner_one(name, u_set):
    """The slope of a gradient in y_ini, as a weight, a bound or the data change: each has a transform of its own."""
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=1, scale=0.5))
    u, y = dpc.collect(dpc.systems.OscillatingMasses(noise=0.02, generator=torch.Generator().manual_seed(5)), 90)
    direction, way = randn(3, 4, seed=9), randn(*y.shape, seed=10)
    curved = isinstance(u_set, dpc.Ball)

    def loss(x, y_ini):
        if name == "lambda_g":
            layer = small_layer(lambda_g=2 * x, u_set=u_set)
        elif name == "bound":
            layer = small_layer(u_set=dpc.Ball(x * x.exp()) if curved else dpc.Box(-0.5, x * x.exp()))
        else:
            data = dpc.HankelData.from_trajectories(u, y + 0.1 * x * way, t_ini=3, horizon=6)
            layer = dpc.DPCLayer(data, 10.0, 1.0, 1.0, 1e3, u_set=u_set)
        return (layer(u_ini, y_ini, y_ref=Y_REF).u ** 3).sum()

    def by_grad(x):
        return (grad(lambda y: loss(x, y))(y_ini) * direction).sum()

    def by_jvp(x):
        return jvp(lambda y: loss(x, y), (y_ini,), (direction,))[1]

    at = torch.tensor(0.35, dtype=torch.float64)
    expected = central(by_grad, at)
    assert expected.abs() > 1e-3
    for inner in (by_grad, by_jvp):
        assert relative(grad(inner)(at), expected) < 1e-5, inner.__name__
    if name != "data":
        assert relative(jacfwd(by_grad)(at), expected) < 1e-5
    if name == "lambda_g" or (name == "bound" and curved):
        with pytest.raises(NotImplementedError, match="forward derivatives of forward derivatives"):
            jacfwd(by_jvp)(at)
