"""Properties that hold for every problem; a case is drawn by its index and shrinks towards the first."""

from dataclasses import replace

import numpy as np
import torch
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st

import torch_dpc as dpc
from tests.fuzz.posed import problem_of
from tests.fuzz.problems import make
from tests.fuzz.run import call, layer_of
from tests.fuzz.transforms import boxed, in_units, mixes_channels, of_the_paper, permuted
from tests.oracles.judge import cost
from tests.oracles.problem import Sample
from tests.oracles.reduction import rows_of

# A smaller index is no simpler a case, so nothing is shrunk.
PHASES = (Phase.explicit, Phase.generate)
FEW = settings(max_examples=12, deadline=None, derandomize=True, database=None, phases=PHASES)
CASES = st.integers(0, 5000).map(lambda index: make("sensible", index))
UNITS = st.integers(-6, 6).map(lambda k: 10.0**k)
ROUNDING = 1e-9  # of a plan, relative to each channel
NEIGHBOUR = 1e-12  # what another sample of the batch may change, relative to each channel
DIFFERENCES = 1e-7  # central differences of a plan that is affine between kinks: rounding over the step
STEP = 1e-4  # of the differences
FULL = 1e-5  # the paper's own system has a condition of up to 1e14


def tensors(case):
    """Return (u_ini, y_ini, y_ref, u_ref) of all samples."""
    names = ("u_ini", "y_ini", "y_ref", "u_ref")
    return [torch.stack([torch.as_tensor(getattr(s, name)) for s in case.samples]) for name in names]


def plan_of(layer, u_ini, y_ini, y_ref, u_ref):
    return layer(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref)


def assert_plans_agree(ours, theirs, case, tolerance):
    """Compare u and y of the solved samples, relative to the largest value of each channel in plan or recording."""
    assert torch.equal(ours.info.status, theirs.info.status)
    kept = ours.info.status == 0
    if not kept.any():
        return
    for name, recorded in zip(("u", "y"), zip(*case.recordings, strict=True), strict=True):
        a, b = (getattr(plan, name)[kept] for plan in (ours, theirs))
        size = torch.as_tensor(np.abs(np.concatenate(recorded)).max(0)).clamp_min(1e-300)
        assert ((a - b).abs() / torch.maximum(size, b.abs().amax((0, 1)))).max() <= tolerance


def has_wide_margins(layer, case, plan):
    """Return whether every sample is solved, off its kinks, and neither weakly active nor a selection."""
    return bool((plan.info.status == 0).all()) and not plan.info.n_weakly_active.any() and not plan.info.is_selection


@FEW
@given(CASES, st.integers(0, 2**31))
def test_the_forward_and_the_backward_derivative_are_adjoint(case, seed):
    layer, inputs = layer_of(case), tensors(case)
    source = torch.Generator().manual_seed(seed)
    change = [torch.randn(x.shape, generator=source, dtype=x.dtype) for x in inputs]

    def both(*theta):
        plan = plan_of(layer, *theta)
        return plan.u, plan.y

    assume(has_wide_margins(layer, case, plan_of(layer, *inputs)))
    (u, y), (du, dy) = torch.func.jvp(both, tuple(inputs), tuple(change))
    weights = [torch.randn(x.shape, generator=source, dtype=x.dtype) for x in (u, y)]
    inputs = [x.requires_grad_() for x in inputs]
    u, y = both(*inputs)
    back = torch.autograd.grad((u * weights[0]).sum() + (y * weights[1]).sum(), inputs)
    ahead = (du * weights[0]).sum() + (dy * weights[1]).sum()
    behind = sum((g * d).sum() for g, d in zip(back, change, strict=True))
    size = (du.norm() ** 2 + dy.norm() ** 2).sqrt() * (weights[0].norm() ** 2 + weights[1].norm() ** 2).sqrt()
    assert (ahead - behind).abs() <= 1e-9 * size


@FEW
@given(CASES, st.randoms(use_true_random=False))
def test_a_plan_follows_the_order_of_its_channels(case, random):
    assume(not any(spec[0] == "cone" for spec in case.sets.values()))  # its first channel is its bound
    order_u, order_y = (np.array(random.sample(range(n), n)) for n in (case.n_u, case.n_y))
    other = permuted(case, order_u, order_y)
    ours, theirs = call(layer_of(case), case), call(layer_of(other), other)
    assume(not ours.info.is_selection)
    theirs = replace(theirs, u=theirs.u[..., np.argsort(order_u)], y=theirs.y[..., np.argsort(order_y)])
    assert_plans_agree(ours, theirs, case, ROUNDING)


@FEW
@given(CASES, st.lists(UNITS, min_size=4, max_size=4), UNITS)
def test_units_do_not_matter(case, unit_u, unit_y):
    unit_u = np.array(unit_u[: case.n_u])
    if "lambda_u" in case.weights or any(mixes_channels(case.sets.get(n)) for n in ("u_set", "du_set")):
        unit_u = np.full(case.n_u, unit_u[0])
    if "lambda_u" in case.weights:
        case = replace(case, weights={k: v for k, v in case.weights.items() if k != "lambda_u"})
    other = in_units(case, unit_u, unit_y)
    ours, theirs = call(layer_of(case), case), call(layer_of(other), other)
    theirs = replace(theirs, u=theirs.u / torch.as_tensor(unit_u), y=theirs.y / unit_y)
    assert_plans_agree(ours, theirs, case, ROUNDING)


@FEW
@given(CASES)
def test_each_sample_of_a_batch_is_planned_as_if_alone(case):
    layer, inputs = layer_of(case), tensors(case)
    batch = plan_of(layer, *inputs)
    for i in range(len(case.samples)):
        alone = plan_of(layer, *(x[i : i + 1] for x in inputs))
        one = replace(alone, u=batch.u[i : i + 1], y=batch.y[i : i + 1])
        assert int(batch.info.status[i]) == int(alone.info.status)
        assert_plans_agree(one, alone, case, ROUNDING)


@FEW
@given(CASES, st.floats(1.05, 3.0))
def test_wider_bounds_never_cost_more(case, factor):
    tight, wide = boxed(case, 0.4, 0.5), boxed(case, 0.4 * factor, 0.5 * factor)
    costs = []
    for one in (tight, wide):
        p, plan = problem_of(one), call(layer_of(one), one)
        rows, g = rows_of(p), plan.g
        costs.append([float(cost(p, rows, s, plan.u[i].numpy(), plan.y[i].numpy(), g[i].numpy())[0])
                      if int(plan.info.status[i]) == 0 else np.inf for i, s in enumerate(one.samples)])  # fmt: skip
    assert (np.array(costs[1]) <= np.array(costs[0]) * (1 + 1e-9) + 1e-12).all()


@FEW
@given(CASES, st.sampled_from(["Q", "R", "lambda_g", "lambda_s"]), st.floats(1.1, 10.0))
def test_the_optimal_cost_grows_with_each_weight(case, name, factor):
    heavier = replace(case, weights={**case.weights, name: case.weights[name] * factor})
    costs = []
    for one in (case, heavier):
        p, plan = problem_of(one), call(layer_of(one), one)
        rows, g = rows_of(p), plan.g
        costs.append([float(cost(p, rows, s, plan.u[i].numpy(), plan.y[i].numpy(), g[i].numpy())[0])
                      if int(plan.info.status[i]) == 0 else np.nan for i, s in enumerate(one.samples)])  # fmt: skip
    before, after = np.array(costs)
    assert not (after < before * (1 - 1e-9) - 1e-12).any()


@FEW
@given(CASES)
def test_a_sample_without_a_plan_changes_nothing_for_its_neighbours(case):
    case = boxed(case, 1.0, 0.3)
    far = case.samples[0]
    far = Sample(far.u_ini + 100 * np.abs(case.recordings[0][0]).max(), far.y_ini, far.u_ref, far.y_ref)
    layer, inputs = layer_of(case), tensors(case)
    more = tensors(replace(case, samples=[far, *case.samples]))
    results = []
    for theta in (inputs, more):
        theta = [x.requires_grad_() for x in theta]
        plan = plan_of(layer, *theta)
        solved = plan.info.status == dpc.Status.SOLVED
        grads = torch.autograd.grad(plan.u[solved].sum() + plan.y[solved].sum(), theta)
        results.append((plan, grads))
    (plan, grads), (joined, joined_grads) = results
    assert int(joined.info.status[0]) == dpc.Status.INFEASIBLE
    others = replace(joined, u=joined.u[1:], y=joined.y[1:], info=plan.info)
    assert torch.equal(joined.info.status[1:], plan.info.status)
    assert_plans_agree(others, plan, case, NEIGHBOUR)
    for g, h in zip(grads, joined_grads, strict=True):
        assert (g - h[1:]).abs().max() <= NEIGHBOUR * g.abs().max().clamp_min(1e-300) and not h[0].any()


@FEW
@given(CASES, st.integers(0, 2**31))
def test_reduced_and_full_derivatives_are_those_of_differences(case, seed):
    case = of_the_paper(case)
    inputs = tensors(case)
    source = torch.Generator().manual_seed(seed)
    layers = {backward: layer_of(case, backward=backward) for backward in ("reduced", "full")}
    plan = plan_of(layers["reduced"], *inputs)
    assume(has_wide_margins(layers["reduced"], case, plan))
    weight = torch.randn(plan.u.shape, generator=source, dtype=torch.float64)
    y_ini = inputs[1].clone().requires_grad_()
    grads = {}
    for backward, layer in layers.items():
        value = (plan_of(layer, inputs[0], y_ini, *inputs[2:]).u * weight).sum()
        (grads[backward],) = torch.autograd.grad(value, y_ini)
    change = torch.randn(y_ini.shape, generator=source, dtype=torch.float64)

    def slope(step):
        with torch.no_grad():
            ends = [plan_of(layers["reduced"], inputs[0], inputs[1] + s * step * change, *inputs[2:]) for s in (1, -1)]
        active = [p.info.n_active for p in (plan, *ends)]
        assume(all(torch.equal(a, active[0]) for a in active))  # no kink between
        return ((ends[0].u - ends[1].u) * weight).sum() / (2 * step)

    size = (grads["reduced"].abs() * change.abs()).sum().clamp_min(1e-9)
    assert (grads["reduced"] - grads["full"]).abs().max() <= FULL * grads["reduced"].abs().max().clamp_min(1e-12)
    assert ((grads["reduced"] * change).sum() - slope(STEP)).abs() <= DIFFERENCES * size
