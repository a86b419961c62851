"""Sets by themselves: projection, its Jacobian, linear minimisation, bounds of a plan."""

import math

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import central, randn, relative

EXACT = 1e-12
#: The Jacobian against central differences of the projection, which is curved.
DIFFERENCES = 1e-7

STEPS, CHANNELS = 4, 3
SETS = {
    "box": dpc.Box(-0.5, torch.tensor([0.4, 0.6, math.inf])),
    "box of every step": dpc.Box(-torch.rand(STEPS, CHANNELS), 0.3),
    "reals": dpc.Reals(),
    "non-negative": dpc.NonNegative(),
    "ball": dpc.Ball(0.7, torch.tensor([0.1, -0.2, 0.3])),
    "ball of radius 0": dpc.Ball(0.0, 0.2),
    "balls that grow": dpc.Ball(torch.linspace(0.2, 0.9, STEPS)),
    "cone": dpc.SecondOrderCone(),
    "product": dpc.Product([(dpc.Ball(0.5), [0, 2]), (dpc.Box(-0.1, 0.1), 1)]),
}
WHOLE = {
    "ball": dpc.Ball(1.0, torch.full((STEPS, CHANNELS), 0.1), per="trajectory"),
    "ball around one step's center": dpc.Ball(1.0, torch.tensor([0.1, 0.2, 0.3]), per="trajectory"),
    "cone": dpc.SecondOrderCone(per="trajectory"),
    "product": dpc.Product([(dpc.Ball(0.5, per="trajectory"), [0, 2]), (dpc.Box(-0.1, torch.rand(STEPS, 1)), [1])]),
}


def of_plan(owner, x):
    """x as the set takes a plan: every step, or all of it."""
    return x.flatten(-2) if owner.per == "trajectory" else x


ALL = [pytest.param(s, id=name) for name, s in SETS.items()]
ALL += [pytest.param(s, id=f"{name} of a trajectory") for name, s in WHOLE.items()]


@pytest.mark.parametrize("owner", ALL)
def test_the_projection_is_the_nearest_point(owner):
    x = of_plan(owner, 2 * randn(5, STEPS, CHANNELS, seed=1))
    p = owner.project(x)
    torch.testing.assert_close(owner.project(p), p, rtol=0, atol=EXACT)
    # By the variational inequality no point of the set lies on the far side of p: <x - p, z - p> <= 0.
    for seed in range(30):
        z = owner.project(of_plan(owner, 2 * randn(5, STEPS, CHANNELS, seed=seed + 2)))
        product = (x - p) * (z - p)
        assert (product.sum(-1) <= EXACT).all()


@pytest.mark.parametrize("owner", ALL)
def test_the_jacobian_is_that_of_the_projection(owner):
    x = of_plan(owner, randn(STEPS, CHANNELS, seed=3))
    v = torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(4))
    expected = (central(owner.project, x, 1e-6) * v).flatten(-x.ndim).sum(-1)
    assert float((owner.jacobian_product(x, v) - expected).abs().max()) < DIFFERENCES
    if not isinstance(owner, dpc.Product):
        J = owner.jacobian(x)
        torch.testing.assert_close(J, J.mT)
        default = dpc.ConvexSet.jacobian(owner, x)  # what a set that gives `project` alone has
        torch.testing.assert_close(J, default, rtol=0, atol=EXACT)


@pytest.mark.parametrize("owner", ALL)
def test_linear_minimisation_beats_every_point(owner):
    c = of_plan(owner, randn(STEPS, CHANNELS, seed=5))
    best = owner.minimize_linear(c)
    bounded = best.isfinite().all(-1)
    value = torch.where(bounded, torch.where(c == 0, 0.0, c * best).sum(-1), -math.inf)
    if not isinstance(owner, dpc.Product):
        torch.testing.assert_close(-owner.support(-c), value)
    for seed in range(30):
        z = owner.project(of_plan(owner, 3 * randn(STEPS, CHANNELS, seed=seed + 6)))
        assert (value <= (c * z).sum(-1) + EXACT).all()
    if bool(best.isfinite().all()):
        torch.testing.assert_close(owner.project(best), best, rtol=0, atol=EXACT)


def test_a_cone_has_a_minimum_in_its_dual_directions_alone():
    cone = dpc.SecondOrderCone()
    inside, outside = torch.tensor([2.0, 1.0, 1.0]), torch.tensor([1.0, 1.0, 1.0])
    assert torch.equal(cone.minimize_linear(inside), torch.zeros(3))
    assert not cone.minimize_linear(outside).isfinite().all()
    assert float(cone.support(-inside)) == 0.0 and float(cone.support(-outside)) == math.inf


@pytest.mark.parametrize("owner", [dpc.Ball(1.0), dpc.SecondOrderCone()], ids=["ball", "cone"])
@pytest.mark.parametrize("point", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
def test_derivatives_are_finite_where_norms_have_none(owner, point):
    x = torch.tensor([point, [0.3, 2.0, 1.0]], dtype=torch.float64, requires_grad=True)
    owner.project(x).sum().backward()
    assert x.grad.isfinite().all() and owner.jacobian(x.detach()).isfinite().all()


def test_the_soft_box_is_the_proximal_map_of_its_price():
    soft = dpc.SoftBox(torch.tensor([-1.0, -0.5]), 1.0, weight=2.0)
    gamma, x = 0.7, 4 * randn(50, 2, seed=9)
    p = soft.prox(x, gamma)
    # p minimises weight * distance to the box + 1/(2 gamma) |z - x|^2: no nearby point does better.

    def price(z):
        return 2.0 * (z - soft.box.project(z)).abs() + (z - x) ** 2 / (2 * gamma)

    for step in (1e-3, -1e-3):
        assert (price(p) <= price(p + step) + EXACT).all()
    diagonal = soft.jacobian_diagonal(x, gamma)
    slope = (soft.prox(x + 1e-6, gamma) - soft.prox(x - 1e-6, gamma)) / 2e-6
    torch.testing.assert_close(diagonal, slope, rtol=0, atol=1e-8)
    assert 0 < float(diagonal.mean()) < 1


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: dpc.Ball(-1.0), "`radius` must be finite and not negative"),
        (lambda: dpc.Ball(1.0, math.nan), "`center` must be finite"),
        (lambda: dpc.Ball(1.0, per="horizon"), '`per` must be "step" or "trajectory"'),
        (lambda: dpc.Box(-torch.ones(3, 6, 2), torch.ones(2, 6, 2)), r"shapes that broadcast, got \(3, 6, 2\) and"),
        (lambda: dpc.Box(1.0, -1.0), "`lower` must be at most `upper`"),
        (lambda: dpc.SoftBox(-1.0, 1.0, 0.0), "`weight` must be positive"),
        (lambda: dpc.Product([(dpc.Ball(1.0), [0, 0])]), "every channel from 0 on once"),
        (lambda: dpc.Product([(1.0, [0])]), "pairs of a ConvexSet"),
        (lambda: dpc.Box(torch.tensor([1]), 2.0), "floating-point"),
        (lambda: dpc.Box(0.0, True), "`upper` must be a number or an array of numbers, got True"),
        (lambda: dpc.Box([False, True], 2.0), "`lower` must be a number or an array of numbers"),
        (lambda: dpc.Ball(np.ones(3, dtype=bool)), "`radius` must be a number or an array of numbers"),
        (lambda: dpc.Product(None), "`factors` must be pairs .* got None"),
        (lambda: dpc.Product([dpc.Ball(1.0)]), "`factors` must be pairs .* got .Ball"),
        (lambda: dpc.Product([(dpc.Ball(1.0), [0.0, 1.0])]), "a channel is an integer, got 0.0"),
        (lambda: dpc.Product([(dpc.Ball(1.0), 0.0)]), "a channel is an integer, got 0.0"),
        (lambda: dpc.Product([(dpc.Ball(1.0), False)]), "a channel is an integer, got False"),
        (lambda: dpc.Product([(dpc.Ball(1.0), "x")]), "a channel is an integer, got 'x'"),
    ],
)
def test_bad_sets_are_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_a_box_of_a_trajectory_is_the_same_box():
    lower, upper = -torch.rand(STEPS, CHANNELS), torch.rand(STEPS, CHANNELS)
    x = randn(STEPS, CHANNELS, seed=11)
    by_step = dpc.Box(lower, upper).project(x)
    whole = dpc.Box(lower, upper, per="trajectory").project(x.flatten())
    assert relative(whole.reshape(STEPS, CHANNELS), by_step) == 0


def test_channels_may_be_any_integers():
    ball = dpc.Ball(1.0)
    product = dpc.Product([(ball, np.int64(0)), (ball, torch.tensor(3)), (ball, np.array([2, 1])), (ball, range(4, 5))])
    assert product.channels == [[0], [3], [2, 1], [4]]
    assert all(type(channel) is int for own in product.channels for channel in own)


def test_what_follows_from_a_projection_follows_from_ones_own():
    class Inner(dpc.Box):
        def project(self, x):
            return x * (self.upper / x.norm(dim=-1, keepdim=True)).clamp_max(1.0)

    class Named(dpc.Box):
        """Keeps the projection, and what belongs to it."""

    x = randn(5, 3, seed=12) + 1.0
    torch.testing.assert_close(Inner(-0.5, 0.5).jacobian(x), dpc.Ball(0.5).jacobian(x), rtol=0, atol=EXACT)
    assert not Inner.separable and Named.separable and Named.jacobian is dpc.Box.jacobian
    with pytest.raises(NotImplementedError):
        Inner(-0.5, 0.5).minimize_linear(x)
