"""Budgets: membership by their definitions, projections against independent solvers, linear minimisers, edges."""

import itertools

import numpy as np
import pytest
import torch
from scipy.optimize import LinearConstraint, NonlinearConstraint, minimize

import torch_dpc as dpc
from helpers import generator, nearest_point, randn, relative
from torch_dpc import attacks

EXACT = 1e-12
ORACLE = 1e-9  # of the interior-point oracle
SCIPY = 2e-6  # of SLSQP and trust-constr
INSIDE = 1e-9  # the promise

SIZES = torch.tensor([0.1, 0.2, 0.3, 0.0], dtype=torch.float64)  # of the four channels
BY_ENTRY = torch.linspace(0.0, 0.5, 12, dtype=torch.float64).reshape(3, 4)


def two(p):
    return p.square().sum((-2, -1)).sqrt()


def one(p):
    return p.abs().sum((-2, -1))


def per_channel(p):
    return p.square().sum(-2).sqrt()


def ratio(size, reach):
    return torch.where(size > 0, size / torch.as_tensor(reach, dtype=torch.float64), 0.0)


def sparse(p, radius, k):
    return torch.where((per_channel(p) > 0).sum(-1) <= k, ratio(two(p), radius), torch.inf)


#: name: (the budget, how large p is in it by its definition: at most 1 when admissible)
BUDGETS = {
    "ball": (attacks.Ball(0.3), lambda p, y: two(p) / 0.3),
    "relative ball": (attacks.RelativeBall(0.3), lambda p, y: ratio(two(p), 0.3 * two(y))),
    "1-norm": (attacks.L1Ball(0.3), lambda p, y: one(p) / 0.3),
    "relative 1-norm": (attacks.L1Ball(0.3, relative=True), lambda p, y: ratio(one(p), 0.3 * one(y))),
    "sparse": (attacks.SparseBall(2, 0.3), lambda p, y: sparse(p, 0.3, 2)),
    "relative sparse": (attacks.SparseBall(1, 0.3, relative=True), lambda p, y: sparse(p, 0.3 * two(y), 1)),
    "box": (attacks.Box(0.3), lambda p, y: (p.abs() / 0.3).amax((-2, -1))),
    "box by channel": (attacks.Box([0.1, 0.2, 0.3, 0.0]), lambda p, y: ratio(p.abs().amax(-2), SIZES).amax(-1)),
    "box by entry": (attacks.Box(BY_ENTRY), lambda p, y: ratio(p.abs(), BY_ENTRY).amax((-2, -1))),
    "relative box": (
        attacks.Box(0.3, relative=True),
        lambda p, y: ratio(p.abs().amax((-2, -1)), 0.3 * y.abs().amax((-2, -1))),
    ),
    "relative box by channel": (
        attacks.Box(SIZES, relative=True),
        lambda p, y: ratio(p.abs().amax(-2), SIZES * y.abs().amax(-2)).amax(-1),
    ),
    "relative box by entry": (
        attacks.Box(BY_ENTRY, relative=True),
        lambda p, y: ratio(p.abs(), BY_ENTRY * y.abs()).amax((-2, -1)),
    ),
    "ellipsoid": (attacks.Ellipsoid(SIZES), lambda p, y: two(ratio(p.abs(), SIZES))),
    "relative ellipsoid": (
        attacks.Ellipsoid(SIZES, relative=True),
        lambda p, y: ratio(per_channel(p), SIZES * per_channel(y)).square().sum(-1).sqrt(),
    ),
    "balls by channel": (
        attacks.PerChannel(attacks.Ball(SIZES)),
        lambda p, y: ratio(per_channel(p), SIZES).amax(-1),
    ),
    "relative balls by channel": (
        attacks.PerChannel(attacks.RelativeBall(0.3)),
        lambda p, y: ratio(per_channel(p), 0.3 * per_channel(y)).amax(-1),
    ),
    "relative 1-norms by channel": (
        attacks.PerChannel(attacks.L1Ball(SIZES, relative=True)),
        lambda p, y: ratio(p.abs().sum(-2), SIZES * y.abs().sum(-2)).amax(-1),
    ),
}
every_budget = pytest.mark.parametrize(("budget", "size"), BUDGETS.values(), ids=BUDGETS)


@every_budget
@pytest.mark.parametrize("reach", [1e-3, 1.0, 1e6], ids=["near", "around", "far"])
def test_answers_lie_in_their_budget_by_its_definition(budget, size, reach):
    y_ini, c, p = (randn(30, 3, 4, seed=s) for s in (1, 2, 3))
    random = budget.random(y_ini, generator())
    for q in (budget.minimize_linear(c, y_ini), budget.project(reach * p, y_ini), random):
        assert q.shape == (30, 3, 4) and (size(q, y_ini) <= 1 + INSIDE).all()
        torch.testing.assert_close(budget.excess(q, y_ini).clamp_min(-1), size(q, y_ini) - 1, rtol=0, atol=EXACT)
    torch.testing.assert_close(size(random, y_ini), torch.ones(30, dtype=torch.float64), rtol=EXACT, atol=0)


@every_budget
def test_more_than_the_budget_is_noticed(budget, size):
    y_ini, c = randn(30, 3, 4, seed=1), randn(30, 3, 4, seed=2)
    for by in (2.0, 1 + 1e-7):
        outside = by * budget.minimize_linear(c, y_ini)
        torch.testing.assert_close(budget.excess(outside, y_ini), torch.full((30,), by - 1).double(), rtol=1e-6, atol=0)
    if "sparse" in str(type(budget)).lower():
        assert (budget.excess(1e-9 * torch.ones(1, 3, 4).double(), y_ini[:1]) == torch.inf).all()
        assert (budget.project(torch.ones(1, 3, 4).double(), y_ini[:1]) != 0).any(-2).sum() == budget.channels


@every_budget
def test_no_admissible_point_does_better(budget, size):
    y_ini, c = randn(30, 3, 4, seed=1), randn(30, 3, 4, seed=2)
    best = budget.minimize_linear(c, y_ini)
    others = randn(500, 30, 3, 4, seed=4)
    if not budget.convex:
        others = torch.stack([budget.project(o, y_ini) for o in others])
    others = others / torch.stack([size(o, y_ini) for o in others])[..., None, None].clamp_min(1e-300)
    others = torch.where(others.isfinite(), others, 0.0)  # an entry without reach
    value = (c * best).sum((-2, -1))
    assert (value < 0).all() and ((c * others).sum((-2, -1)) >= value - EXACT).all()


@every_budget
def test_projections_are_nearest(budget, size):
    """The projection's own inequality for convex sets, no nearer point among many for all; idempotent."""
    y_ini, p = randn(30, 3, 4, seed=1), randn(30, 3, 4, seed=3)
    near = budget.project(p, y_ini)
    others = budget.project(3 * randn(300, 30, 3, 4, seed=4), y_ini)
    assert (two(p - others) >= two(p - near) - EXACT).all()
    if budget.convex:
        assert (((p - near) * (others - near)).sum((-2, -1)) < 1e-9).all()
    torch.testing.assert_close(budget.project(near, y_ini), near, rtol=0, atol=EXACT)
    torch.testing.assert_close(budget.project(0.01 * near, y_ini), 0.01 * near, rtol=0, atol=1e-15)


@every_budget
def test_a_batch_is_its_samples_and_may_be_empty(budget, size):
    y_ini, p = randn(2, 3, 3, 4, seed=1), randn(2, 3, 3, 4, seed=2)
    for method in (budget.minimize_linear, budget.project, budget.excess):
        whole = method(p, y_ini)
        for i, j in itertools.product(range(2), range(3)):
            torch.testing.assert_close(whole[i, j], method(p[i, j], y_ini[i, j]), rtol=EXACT, atol=EXACT)
        assert method(p[:0], y_ini[:0]).shape == whole[:0].shape
    assert budget.random(y_ini[:0]).shape == (0, 3, 3, 4)


@every_budget
def test_at_zero_every_answer_is_finite(budget, size):
    y_ini, zero = randn(2, 3, 4, seed=1), torch.zeros(2, 3, 4, dtype=torch.float64)
    assert not budget.minimize_linear(zero, y_ini).any() and not budget.project(zero, y_ini).any()
    assert (budget.excess(zero, y_ini) <= 0).all() and (budget.excess(zero, zero) <= 0).all()
    answers = budget.minimize_linear(y_ini, zero), budget.project(y_ini, zero), budget.random(zero, generator())
    for q in answers:
        assert q.isfinite().all()
        assert not getattr(getattr(budget, "budget", budget), "relative", False) or not q.any()  # {0}


@every_budget
def test_random_perturbations_repeat_by_their_generator(budget, size):
    y_ini = randn(5, 3, 4, seed=1)
    a, b, c = (budget.random(y_ini, generator(s)) for s in (7, 7, 8))
    assert torch.equal(a, b) and not torch.equal(a, c)


# --- projections by others --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.0, 0.3, 1.0, 3.0, 50.0])
@pytest.mark.parametrize("relative_to", [False, True])
def test_1_norm_projection_against_a_quadratic_program(radius, relative_to):
    """The signs stay, and min |q - |p||^2 subject to q >= 0, sum q <= r gives the sizes."""
    y_ini, p = randn(8, 2, 3, seed=1), randn(8, 2, 3, seed=2)
    p[0, 0, 0] = -p[0, 1, 2]  # a tie
    budget, rows = attacks.L1Ball(radius, relative=relative_to), torch.cat([torch.eye(6), torch.ones(1, 6)]).double()
    for sample, window, near in zip(p, y_ini, budget.project(p, y_ini), strict=True):
        reach = radius * (window.abs().sum() if relative_to else 1.0)
        sizes = sample.abs().reshape(-1)
        lower = torch.cat([-sizes, torch.tensor([-torch.inf])])
        upper = torch.cat([torch.full((6,), torch.inf), torch.as_tensor([reach - sizes.sum()])])
        nearest = sizes + nearest_point(rows, lower, upper.double()) if reach > 0 else 0 * sizes
        torch.testing.assert_close(near.reshape(-1), sample.sign().reshape(-1) * nearest, rtol=0, atol=ORACLE)


def test_the_ellipsoid_answers_with_the_axes_it_can_reach():
    """min <c, p> over sum (p / s)^2 <= 1 is -|s c|, at p = -s^2 c / |s c|."""
    c = randn(30, 3, 4, seed=2)
    p = attacks.Ellipsoid(SIZES).minimize_linear(c, c)
    torch.testing.assert_close((c * p).sum((-2, -1)), -two(SIZES * c))
    torch.testing.assert_close(p, -SIZES.square() * c / two(SIZES * c)[..., None, None])


@pytest.mark.parametrize("relative_to", [False, True])
def test_ellipsoid_projection_against_scipy(relative_to):
    y_ini, p = randn(6, 2, 3, seed=1), 2 * randn(6, 2, 3, seed=2)
    scale = torch.tensor([[0.1, 0.5, 2.0], [1.0, 0.0, 0.3]], dtype=torch.float64)
    budget = attacks.Ellipsoid(scale, relative=relative_to)
    for sample, window, near in zip(p, y_ini, budget.project(p, y_ini), strict=True):
        reach = (scale * window.abs() if relative_to else scale).reshape(-1).numpy()
        free, target = reach > 0, sample.reshape(-1).numpy()
        inside = NonlinearConstraint(lambda q, r=reach[free]: np.square(q / r).sum(), -np.inf, 1.0)
        found = minimize(
            lambda q, t=target[free]: 0.5 * np.square(q - t).sum(),
            0 * target[free],
            jac=lambda q, t=target[free]: q - t,
            constraints=inside,
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 500},
        )
        expected = np.zeros(6)
        expected[free] = found.x
        np.testing.assert_allclose(near.reshape(-1).numpy(), expected, atol=SCIPY)


def test_box_projection_against_scipy():
    y_ini, p = randn(3, 2, 3, seed=1), 2 * randn(3, 2, 3, seed=2)
    radius = torch.tensor([0.1, 0.5, 2.0], dtype=torch.float64)
    for sample, window, near in zip(p, y_ini, attacks.Box(radius, relative=True).project(p, y_ini), strict=True):
        reach, target = (radius * window.abs().amax(0)).expand(2, 3).reshape(-1).numpy(), sample.reshape(-1).numpy()
        found = minimize(
            lambda q, t=target: 0.5 * np.square(q - t).sum(),
            0 * target,
            jac=lambda q, t=target: q - t,
            constraints=LinearConstraint(np.eye(6), -reach, reach),
            method="SLSQP",
            options={"ftol": 1e-15},
        )
        np.testing.assert_allclose(near.reshape(-1).numpy(), found.x, atol=SCIPY)


@pytest.mark.parametrize("channels", [1, 2, 3, 7])
def test_sparse_projection_and_minimiser_against_every_choice_of_sensors(channels):
    y_ini, c, radius = randn(20, 2, 5, seed=1), randn(20, 2, 5, seed=2), 0.7
    budget = attacks.SparseBall(channels, radius)
    for scale in (0.1, 1.0, 10.0):
        p = scale * c
        choices = []
        for chosen in itertools.combinations(range(5), min(channels, 5)):
            mask = torch.zeros(5, dtype=torch.float64)
            mask[list(chosen)] = 1.0
            choices.append(p * mask * (radius / two(p * mask)).clamp_max(1.0)[..., None, None])
        distances = torch.stack([two(p - q) for q in choices])
        near = budget.project(p, y_ini)
        torch.testing.assert_close(two(p - near), distances.amin(0), rtol=EXACT, atol=EXACT)
        picked = torch.stack(choices)[distances.argmin(0), torch.arange(20)]
        torch.testing.assert_close(near, picked, rtol=EXACT, atol=EXACT)
    least = torch.stack([-radius * two(c * (q != 0)) for q in choices]).amin(0)
    torch.testing.assert_close((c * budget.minimize_linear(c, y_ini)).sum((-2, -1)), least, rtol=EXACT, atol=0)


def test_a_budget_by_channel_is_the_budget_of_each_channel():
    y_ini, p = randn(4, 3, 2, seed=1), randn(4, 3, 2, seed=2)
    radii = torch.tensor([0.1, 0.4], dtype=torch.float64)
    for kind in (attacks.Ball, attacks.L1Ball):
        for relative_to in (False, True):
            lifted = attacks.PerChannel(kind(radii, relative=relative_to))
            for i in range(2):
                alone, part = kind(radii[i], relative=relative_to), slice(i, i + 1)
                for method in ("project", "minimize_linear"):
                    whole = getattr(lifted, method)(p, y_ini)[..., part]
                    assert relative(whole, getattr(alone, method)(p[..., part], y_ini[..., part])) < EXACT


def test_one_radius_a_sample():
    y_ini, p = randn(3, 2, 4, seed=1), 9 * randn(3, 2, 4, seed=2)
    radii = [0.1, 0.5, 0.0]
    for kind in (attacks.Ball, attacks.RelativeBall, attacks.L1Ball):
        together = kind(radii).project(p, y_ini)
        for i, radius in enumerate(radii):
            torch.testing.assert_close(together[i], kind(radius).project(p[i], y_ini[i]), rtol=EXACT, atol=0)


def test_relative_ball_is_the_ball_with_relative():
    y_ini, c = randn(4, 3, 2, seed=1), randn(4, 3, 2, seed=2)
    same = attacks.RelativeBall(rho=0.1), attacks.Ball(0.1, relative=True)
    assert torch.equal(*(b.minimize_linear(c, y_ini) for b in same)) and same[0].rho == 0.1


def test_random_1_norm_perturbations_use_every_entry():
    p = attacks.L1Ball(1.0).random(torch.zeros(2000, 3, 4, dtype=torch.float64), generator())
    assert (p != 0).all()
    # uniform on the sphere: |p_i| is Beta(1, 11), mean 1/12, standard deviation 0.0766; here to five standard errors
    assert (p.abs().mean(0) - 1 / 12).abs().max() < 5 * 0.0766 / 2000**0.5


# --- bad input --------------------------------------------------------------------------------------------------------

MAKERS = {
    "radius": [attacks.Ball, attacks.L1Ball, attacks.Box, lambda v: attacks.SparseBall(1, v)],
    "rho": [attacks.RelativeBall],
    "scale": [attacks.Ellipsoid],
}


@pytest.mark.parametrize("value", [-0.1, torch.nan, torch.inf, [0.1, -0.1]], ids=str)
@pytest.mark.parametrize(("name", "make"), [(name, make) for name, makers in MAKERS.items() for make in makers])
def test_bad_sizes_are_named(name, make, value):
    with pytest.raises(ValueError, match=f"`{name}` must be finite and not negative, got"):
        make(value)


@pytest.mark.parametrize("make", [attacks.Box, attacks.Ellipsoid])
def test_sizes_of_too_many_dimensions_are_named(make):
    with pytest.raises(ValueError, match=r"shape \(n_y,\) or \(t_ini, n_y\), got \(2, 3, 4\)"):
        make(torch.ones(2, 3, 4))


@pytest.mark.parametrize("channels", [0, -1, 1.0, True])
def test_a_bad_number_of_sensors_is_named(channels):
    with pytest.raises(ValueError, match="`channels` must be a positive integer"):
        attacks.SparseBall(channels, 0.1)


@pytest.mark.parametrize(
    "inner",
    [attacks.Box(0.1), attacks.SparseBall(1, 0.1), attacks.Ellipsoid(0.1), 0.1],
    ids=["box", "sparse", "ellipsoid", "number"],
)
def test_what_has_no_radius_a_channel_is_refused(inner):
    with pytest.raises(ValueError, match="must be a Ball, RelativeBall or L1Ball"):
        attacks.PerChannel(inner)


# --- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Ball", "Box", "Ellipsoid", "L1Ball", "PerChannel", "RelativeBall", "SparseBall"])
def test_a_short_name_is_the_same_class_and_the_long_one_is_at_top_level(name):
    assert getattr(attacks, name) is getattr(attacks, name + "Budget") is getattr(dpc, name + "Budget")


def test_a_budget_shows_its_size():
    assert repr(attacks.RelativeBall(0.1)) == "RelativeBallBudget(radius=0.1, relative=True, rho=0.1)"
