"""The proven worst case: against brute force, against every attack, and for every budget it takes."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, paper_layer, small_layer, windows
from torch_dpc import attacks
from torch_dpc.attacks.exact.complementarity import Rows, in_few_variables

pytest.importorskip("clarabel", reason="extra `exact`")

BRUTE = 1e-6  # of psi: the grids are refined until neighbours agree to this
REFS = {"y_ref": 0.2 * Y_REF, "u_ref": 0.2 * HOLDING}  # within reach of inputs of 0.5
COST = attacks.TargetInput(torch.tensor([0.3, -0.4]))


def psi_of(layer, u_ini, y_ini, p, cost=COST):
    """psi for many perturbations of one window."""
    plan = layer(u_ini.expand(len(p), -1, -1), y_ini + p, **REFS)
    return cost(plan)


def brute_force(layer, u_ini, y_ini, radius, entries, zooms=12):
    """Return the least psi over a box with one or two free entries, by grids that close in on their best point."""
    points = 4001 if len(entries) == 1 else 81
    centre, width = torch.zeros(len(entries), dtype=torch.float64), radius
    best = np.inf
    for _ in range(zooms):
        axes = [(c + width * torch.linspace(-1, 1, points, dtype=torch.float64)).clamp(-radius, radius) for c in centre]
        values = torch.cartesian_prod(*axes).reshape(-1, len(entries))
        p = torch.zeros(len(values), y_ini.numel(), dtype=torch.float64)
        p[:, entries] = values
        psi = psi_of(layer, u_ini, y_ini, p.reshape(-1, *y_ini.shape))
        best, centre = min(best, float(psi.min())), values[psi.argmin()]
        width = width * (0.02 if len(entries) == 1 else 0.3)
    return best


@pytest.mark.parametrize("entries", [[8], [3], [8, 11], [0, 9]], ids=str)
@pytest.mark.parametrize("sample", range(3))
def test_brute_force_agrees(entries, sample):
    layer, radius = small_layer(), 0.4
    u_ini, y_ini = (w[sample] for w in windows(3, 3, seed=5, scale=0.3))
    size = torch.zeros(12, dtype=torch.float64)
    size[entries] = radius
    budget = attacks.Box(size.reshape(3, 4))
    result = attacks.worst_case(layer, COST, budget, u_ini, y_ini, **REFS, tolerance=1e-6)
    best = brute_force(layer, u_ini, y_ini, radius, entries)
    assert result.status == "optimal"
    assert abs(float(result.value) - best) < BRUTE * best
    assert best * (1 - 2 * BRUTE) <= float(result.bound) <= best * (1 + BRUTE)
    assert float(result.value) < float(result.nominal)


@pytest.mark.parametrize(
    "budget",
    [
        attacks.RelativeBall(0.2),
        attacks.Ellipsoid([0.05, 0.1, 0.0, 0.2]),
        attacks.Box(0.05),
        attacks.PerChannel(attacks.Ball([0.05, 0.1, 0.0, 0.2])),
    ],
    ids=lambda budget: type(budget).__name__,
)
def test_no_attack_is_below_the_bound_and_the_answer_is_what_it_says(budget):
    layer = small_layer()
    u_ini, y_ini = windows(3, 3, seed=5, scale=0.3)
    result = attacks.worst_case(layer, COST, budget, u_ini, y_ini, **REFS)
    assert result.status == ["optimal"] * 3 and result.p.shape == y_ini.shape
    assert budget.excess(result.p, y_ini).max() < 1e-9
    torch.testing.assert_close(COST(layer(u_ini, y_ini + result.p, **REFS)), result.value, rtol=1e-9, atol=0)
    torch.testing.assert_close(COST(layer(u_ini, y_ini, **REFS)), result.nominal, rtol=1e-12, atol=0)
    others = [
        attacks.LinearizedAttack(layer, COST, budget),
        attacks.ProjectedGradientAttack(layer, COST, budget, 50, restarts=5),
        attacks.FrankWolfeAttack(layer, COST, budget, 50),
        *[attacks.RandomAttack(budget)] * 50,
    ]
    source = generator()
    for attack in others:
        psi = COST(layer(u_ini, y_ini + attack(u_ini, y_ini, **REFS, generator=source), **REFS))
        assert (psi >= result.bound * (1 - 1e-9)).all()
        assert (psi >= result.value * (1 - 1.01e-4)).all()


@pytest.mark.parametrize(("target", "stays_active"), [((1.0, 1.0), True), ((0.0, 0.0), False)], ids=str)
def test_output_bounds_that_bite_are_part_of_the_search(target, stays_active):
    layer, refs = small_layer(y_set=dpc.Box(-0.1, 0.1)), {"y_ref": 0.3 * Y_REF}
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=7, scale=0.05))
    u_ini, budget, cost = 0.1 * u_ini, attacks.Ball(0.05), attacks.TargetInput(torch.tensor(target))
    result = attacks.worst_case(layer, cost, budget, u_ini, y_ini, **refs)
    assert result.status == "optimal"
    assert (layer(u_ini, y_ini, **refs).lam[12:] != 0).any()
    assert bool((layer(u_ini, y_ini + result.p, **refs).lam[12:] != 0).any()) is stays_active
    shrunk = torch.rand(3000, 1, 1, dtype=torch.float64, generator=generator(1))
    p = shrunk * budget.random(y_ini.expand(3000, 3, 4), generator())
    random = layer(u_ini.expand(3000, 3, 2), y_ini + p, **refs, on_failure="nan")
    assert float(result.value) <= float(torch.nan_to_num(cost(random), nan=torch.inf).min())


def test_a_paper_sized_window_is_proven():
    layer = paper_layer()
    u_ini, y_ini = (w[0] for w in windows(1, seed=4))
    result = attacks.worst_case(
        layer, attacks.TargetInput(torch.zeros(2)), attacks.RelativeBall(0.1), u_ini, y_ini, **REFS
    )
    assert float(result.gap) <= 0.01 and "WorstCase(value=" in repr(result)


def test_intervals_hold_every_plan():
    layer = small_layer()
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=5, scale=0.3))
    budget, data, reduction = attacks.Ball(0.2), layer.data, layer.reduction
    theta, _ = layer.flatten(u_ini, y_ini, REFS["y_ref"], REFS["u_ref"])
    Vp = reduction.V[:, 6:18].numpy()
    of_s = in_few_variables(Vp, budget.norm_bounds(y_ini))
    nominal = layer(u_ini, y_ini, **REFS).lam.numpy()
    v0, G = (reduction.V @ theta).numpy(), reduction.G.numpy()
    bounds = tuple(b.numpy() for b in layer.bounds(data.device))
    index = np.arange(12)
    rows = Rows.of(index, v0, Vp @ of_s.N, G, bounds, (v0 - G @ nominal, nominal), of_s)
    before = float((rows.v_high - rows.v_low).sum())
    assert rows.propagate() and float((rows.v_high - rows.v_low).sum()) < before
    p = budget.random(y_ini.expand(3000, 3, 4), generator()) * torch.rand(3000, 1, 1, generator=generator(1)).double()
    plans = layer(u_ini.expand(3000, 3, 2), y_ini + p, **REFS)
    v, lam = plans.u.flatten(1).numpy(), plans.lam[:, :12].numpy()
    for x, low, high in ((v, rows.v_low, rows.v_high), (lam, rows.lam_low, rows.lam_high)):
        assert (x >= low - 1e-8).all() and (x <= high + 1e-8).all()


def test_a_zero_budget_leaves_the_plan():
    layer = small_layer()
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=5))
    result = attacks.worst_case(layer, COST, attacks.Ball(0.0), u_ini, y_ini, **REFS)
    assert not result.p.any() and result.value == result.bound == result.nominal and result.status == "optimal"


def test_what_it_does_not_take_is_named():
    layer, (u_ini, y_ini) = small_layer(), windows(1, 3, seed=5)
    call = (u_ini, y_ini)
    with pytest.raises(ValueError, match="`cost` must be a TargetInput"):
        attacks.worst_case(layer, attacks.TrackingError(layer.data), attacks.Ball(0.1), *call)
    with pytest.raises(ValueError, match="L1BallBudget is no intersection of Euclidean norm bounds"):
        attacks.worst_case(layer, COST, attacks.L1Ball(0.1), *call)
    with pytest.raises(ValueError, match="`layer` must have boxes"):
        attacks.worst_case(small_layer(u_set=dpc.Ball(0.5)), COST, attacks.Ball(0.1), *call)
    with pytest.raises(ValueError, match="`time_limit` must be positive"):
        attacks.worst_case(layer, COST, attacks.Ball(0.1), *call, time_limit=0.0)
