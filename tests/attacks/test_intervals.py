"""Certified intervals: no attack leaves them, whichever bounds hold the plan, and they are close."""

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, randn, small_layer, windows
from torch_dpc import attacks

REFS = {"y_ref": 0.2 * Y_REF, "u_ref": 0.2 * HOLDING}
LAYERS = {
    "inputs": {"u_set": dpc.Box(-0.5, 0.5)},
    "outputs": {"u_set": dpc.Box(-2.0, 2.0), "y_set": dpc.Box(-0.4, 0.4)},
    "both": {"u_set": dpc.Box(-0.4, 0.4), "y_set": dpc.Box(-0.4, 0.4)},
    "none": {"u_set": None},
}
BUDGETS = [attacks.Ball(0.1), attacks.Box(0.02), attacks.RelativeBall(0.1), attacks.Ellipsoid([0.05, 0.1, 0.0, 0.1])]
TIGHT = 0.5  # share of the interval's width that attacks span, with inputs alone in reach


def suite(layer, c, budget, restarts=3):
    """Attacks that lower and raise <c, u>, and others."""
    down = lambda plan: (c * plan.u).sum((-2, -1))  # noqa: E731
    up = lambda plan: -(c * plan.u).sum((-2, -1))  # noqa: E731
    for cost in (down, up, attacks.TargetInput(torch.tensor([0.3, -0.4]))):
        yield attacks.LinearizedAttack(layer, cost, budget)
        yield attacks.ProjectedGradientAttack(layer, cost, budget, 15, restarts=restarts)
        yield attacks.FrankWolfeAttack(layer, cost, budget, 10)
        yield attacks.RandomSearchAttack(layer, cost, budget, queries=20)
    yield from [attacks.RandomAttack(budget)] * 20


@pytest.mark.parametrize("budget", BUDGETS, ids=lambda budget: type(budget).__name__)
@pytest.mark.parametrize("bounds", LAYERS)
def test_no_attack_leaves_it(bounds, budget):
    layer, source = small_layer(**LAYERS[bounds]), generator(1)
    u_ini, y_ini = windows(4, 3, seed=5, scale=0.1)
    u_ini, c = 0.2 * u_ini, randn(6, 2, seed=3)
    nominal = layer(u_ini, y_ini, **REFS, on_failure="nan")
    keep = nominal.info.status == 0
    assert keep.sum() >= 2
    u_ini, y_ini = u_ini[keep], y_ini[keep]
    interval = attacks.certified_interval(layer, c, budget, u_ini, y_ini, **REFS)
    torch.testing.assert_close(interval.nominal, (c * nominal.u[keep]).sum((-2, -1)), rtol=1e-9, atol=1e-9)
    seen = [interval.nominal]
    for attack in suite(layer, c, budget):
        p = attack(u_ini, y_ini, **REFS, generator=source)
        plan = layer(u_ini, y_ini + p, **REFS, on_failure="nan")
        value = (c * plan.u).sum((-2, -1))
        solved = plan.info.status == 0
        assert ((value >= interval.lower - 1e-9) & (value <= interval.upper + 1e-9))[solved].all()
        seen.append(torch.where(solved, value, interval.nominal))
    span = torch.stack(seen).amax(0) - torch.stack(seen).amin(0)
    if bounds in ("inputs", "none"):
        assert (span >= TIGHT * interval.width).all()


def test_without_bounds_it_is_what_a_linear_map_does():
    layer, c = small_layer(u_set=None), randn(6, 2, seed=3)
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=5))
    slope = torch.func.jacrev(lambda y: (c * layer(u_ini, y).u).sum())(y_ini)
    interval = attacks.certified_interval(layer, c, attacks.Ball(0.1), u_ini, y_ini)
    assert float(interval.width) == pytest.approx(0.2 * float(slope.norm()), rel=2e-2)


def test_planned_outputs_count_too():
    layer, source = small_layer(), generator(2)
    u_ini, y_ini = windows(3, 3, seed=5, scale=0.3)
    c_y, budget = randn(6, 4, seed=4), attacks.Ball(0.1)
    interval = attacks.certified_interval(layer, 0.0, budget, u_ini, y_ini, c_y=c_y, **REFS)
    for _ in range(200):
        y = layer(u_ini, y_ini + budget.random(y_ini, source), **REFS).y
        value = (c_y * y).sum((-2, -1))
        assert ((value >= interval.lower) & (value <= interval.upper)).all()


def test_a_zero_budget_leaves_a_point():
    layer, (u_ini, y_ini) = small_layer(), windows(2, 3, seed=5)
    interval = attacks.certified_interval(layer, 1.0, attacks.Ball(0.0), u_ini, y_ini)
    assert torch.equal(interval.lower, interval.upper) and torch.equal(interval.lower, interval.nominal)
    assert "batch=(2,)" in repr(interval)


def test_bad_weights_are_named():
    layer, (u_ini, y_ini) = small_layer(), windows(1, 3, seed=5)
    with pytest.raises(ValueError, match=r"`c` must have shape \(horizon, n\) = \(6, 2\)"):
        attacks.certified_interval(layer, torch.ones(5, 2), attacks.Ball(0.1), u_ini, y_ini)
    with pytest.raises(ValueError, match="`layer` must have boxes"):
        attacks.certified_interval(small_layer(u_set=dpc.Ball(0.5)), 1.0, attacks.Ball(0.1), u_ini, y_ini)
