"""Poisoned recordings: the influence of windows against differences, and what changed samples do."""

import functools
import math
from dataclasses import replace

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, central, generator, randn, relative, small_layer, windows
from torch_dpc import attacks

COST = attacks.TargetInput(torch.tensor([0.4, -0.3]))
U_INI, Y_INI = windows(5, 3, seed=7, scale=0.3)
REFS = {"y_ref": torch.tensor([0.2, -0.1, 0.0, 0.0]).double()}
# Central differences of step 1e-4 in a weight near 1: their own error is 1e-8 of the derivative.
STEP, DIFFERENCES = 1e-4, 1e-6


@functools.cache
def recording(noise=1e-2, seed=0, steps=150):
    source = generator(seed)
    plant = dpc.systems.OscillatingMasses(noise=noise, generator=source)
    return dpc.collect(plant, steps, generator=source)


def psi(layer):
    return COST(layer(U_INI, Y_INI, **REFS)).mean()


def planner(data, **options):
    return dpc.DPCLayer(data, **{**SMALL, "u_set": dpc.Box(-0.5, 0.5), **options})


# --- the weight of a window -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "ridge"),
    [({}, 0.0), ({"affine": True}, 0.0), ({"regularizer": "identity"}, 0.0), ({}, 0.01), ({"affine": True}, 0.01)],
    ids=["paper", "affine", "identity", "ridge", "affine ridge"],
)
def test_the_influence_is_the_derivative_in_every_windows_weight(options, ridge):
    layer = small_layer(**options)
    layer = planner(layer.data.with_ridge(ridge), **options) if ridge else layer
    data = layer.data.with_ones if layer.affine else layer.data
    found = attacks.window_influence(layer, COST, U_INI, Y_INI, **REFS)
    assert layer(U_INI, Y_INI, **REFS).info.n_active.sum() > 0  # bounds are met
    directions = [randn(data.n_g, seed=s) for s in range(3)] + list(torch.eye(data.n_g, dtype=torch.float64)[[0, 70]])
    for v in directions:
        expected = central(
            lambda x, v=v: psi(planner(attacks.weigh_windows(data, 1 + x * v), **options)),
            torch.zeros(1, dtype=torch.float64),
            STEP,
        )
        assert relative(found @ v, expected[0]) < DIFFERENCES


def without(data, j):
    kept = torch.arange(data.n_g) != j
    return replace(data, **{name: getattr(data, name)[:, kept] for name in ("Up", "Uf", "Yp", "Yf")})


def test_a_weight_of_zero_removes_a_window_and_one_of_two_repeats_it():
    data = small_layer().data
    weights = torch.ones(data.n_g, dtype=torch.float64)
    weights[11] = 0.0
    plan = planner(attacks.weigh_windows(data, weights))(U_INI, Y_INI, **REFS)
    assert relative(plan.u, planner(without(data, 11))(U_INI, Y_INI, **REFS).u) < 1e-9
    weights[11] = 2.0
    twice = {name: torch.cat([getattr(data, name), getattr(data, name)[:, 11:12]], 1) for name in ("Up", "Uf")}
    twice |= {name: torch.cat([getattr(data, name), getattr(data, name)[:, 11:12]], 1) for name in ("Yp", "Yf")}
    plan = planner(attacks.weigh_windows(data, weights))(U_INI, Y_INI, **REFS)
    assert relative(plan.u, planner(replace(data, **twice))(U_INI, Y_INI, **REFS).u) < 1e-9
    with pytest.raises(ValueError, match="`g` weighs the recorded windows"):
        plan.g  # noqa: B018


def test_the_influence_tells_what_removing_a_window_does():
    layer = small_layer()
    found = attacks.window_influence(layer, COST, U_INI, Y_INI, **REFS)
    with torch.no_grad():
        base = psi(layer)
        falls = torch.stack([base - psi(planner(without(layer.data, j))) for j in range(layer.data.n_g)])
    assert torch.corrcoef(torch.stack([found, falls]))[0, 1] > 0.9
    assert falls[found.argmax()] > 0 > falls[found.argmin()]


# --- poisoned samples -------------------------------------------------------------------------------------------------

BUDGET = attacks.BallBudget(0.05)


def poisoned(noise=1e-2, samples=5, **options):
    u, y = recording(noise)
    layer = planner(dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6))
    attack = attacks.PoisonedRecording(layer, COST, BUDGET, samples=samples, **options)
    return attack(u, y, U_INI, Y_INI, **REFS, generator=generator(1)), layer


@pytest.mark.parametrize("noise", [0.0, 1e-2])
@pytest.mark.parametrize("choose", ["influence", "greedy", "random"])
def test_few_samples_change_within_the_budget_and_psi_is_as_told(noise, choose):
    found, layer = poisoned(noise, choose=choose)
    u, y = recording(noise)
    changed = found.p.norm(dim=1) > 0
    assert changed.nonzero()[:, 0].tolist() == sorted(found.samples.tolist()) and len(found.samples) == 5
    assert float(found.p.norm(dim=1).max()) <= 0.05 * (1 + 1e-9)
    torch.testing.assert_close(found.y, y + found.p)
    again = planner(dpc.HankelData.from_trajectories(u, found.y, t_ini=3, horizon=6))
    assert math.isclose(found.before, float(psi(layer)), rel_tol=1e-9)
    assert math.isclose(found.after, float(psi(again)), rel_tol=1e-9) and found.after < found.before
    assert math.isclose(float(psi(found.layer)), found.after, rel_tol=1e-9)


def test_the_sample_of_most_influence_is_that_of_the_steepest_differences():
    u, y = recording()
    h = 1e-5

    def at(k, i, sign):
        moved = y.clone()
        moved[k, i] += sign * h
        return float(psi(planner(dpc.HankelData.from_trajectories(u, moved, t_ini=3, horizon=6))))

    slopes = torch.tensor([[(at(k, i, 1) - at(k, i, -1)) / (2 * h) for i in range(4)] for k in range(40, 60)])
    # a ball: the promised fall is its radius times the length of the slope
    rows = list(range(40, 60))
    steepest = rows[int(slopes.norm(dim=1).argmax())]
    u_, y_ = recording()
    layer = planner(dpc.HankelData.from_trajectories(u_, y_, t_ini=3, horizon=6))
    attack = attacks.PoisonedRecording(layer, COST, attacks.BallBudget(1e-6), samples=150, steps=0)
    order = [k for k in attack(u_, y_, U_INI, Y_INI, **REFS).samples.tolist() if k in rows]
    assert order[0] == steepest


def test_chosen_samples_do_more_than_random_ones_and_steps_help():
    random = [poisoned(choose="random", samples=10)[0].after]
    chosen, greedy = (poisoned(choose=choose, samples=10)[0] for choose in ("influence", "greedy"))
    assert chosen.after < min(random) and greedy.after < min(random)
    assert chosen.after <= poisoned(samples=10, steps=0)[0].after
    assert poisoned(samples=30)[0].after < chosen.after < poisoned(samples=1)[0].after < chosen.before


def test_a_small_budget_does_what_the_derivative_says():
    u, y = recording()
    layer = planner(dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6))
    falls = []
    for radius in (1e-5, 2e-5):
        attack = attacks.PoisonedRecording(layer, COST, attacks.BallBudget(radius), samples=[30, 31], steps=0)
        found = attack(u, y, U_INI, Y_INI, **REFS)
        falls.append(found.before - found.after)
    assert falls[0] > 0 and math.isclose(falls[1], 2 * falls[0], rel_tol=1e-2)


def test_lists_of_recordings_and_rows_of_ones_own():
    us, ys = zip(recording(), recording(seed=1), strict=True)
    layer = planner(dpc.HankelData.from_trajectories(list(us), list(ys), t_ini=3, horizon=6))
    attack = attacks.PoisonedRecording(layer, COST, BUDGET, samples=[3, 170], steps=2)
    found = attack(list(us), list(ys), U_INI, Y_INI, **REFS)
    assert isinstance(found.y, list) and len(found.y) == 2 and found.p.shape == (300, 4)
    assert (found.y[0] != ys[0]).any(1).nonzero().tolist() == [[3]]
    assert (found.y[1] != ys[1]).any(1).nonzero().tolist() == [[20]]
    assert "2 of 300 samples" in repr(found)


def test_a_tracking_attack_raises_the_true_error():
    u, y = recording()
    layer = planner(dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6))
    clean = dpc.HankelData.from_trajectories(*recording(seed=3), t_ini=3, horizon=6)
    cost = attacks.TrackingError(clean, Q=torch.diag(torch.tensor([1.0, 1.0, 0.0, 0.0])))
    attack = attacks.PoisonedRecording(layer, cost, attacks.BallBudget(0.2), samples=30, steps=5)
    found = attack(u, y, U_INI, Y_INI, **REFS)

    def error(planner):
        y = attacks.Predictor(clean)(U_INI, Y_INI, planner(U_INI, Y_INI, **REFS).u)
        return float((y - REFS["y_ref"])[..., :2].square().sum())

    assert error(found.layer) > 1.05 * error(layer)


def test_a_ridge_stays_in_the_poisoned_data():
    u, y = recording()
    data = dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6).with_ridge(0.05)
    found = attacks.PoisonedRecording(planner(data), COST, BUDGET, samples=5)(u, y, U_INI, Y_INI, **REFS)
    again = dpc.HankelData.from_trajectories(u, found.y, t_ini=3, horizon=6).with_ridge(0.05)
    assert math.isclose(found.after, float(psi(planner(again))), rel_tol=1e-9)
    assert math.isclose(found.before, float(psi(planner(data))), rel_tol=1e-9) and found.after < found.before


def test_what_does_not_fit_is_named():
    u, y = recording()
    layer = planner(dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6))
    with pytest.raises(ValueError, match="asks for more than the 150 recorded samples"):
        attacks.PoisonedRecording(layer, COST, BUDGET, samples=151)(u, y, U_INI, Y_INI)
    with pytest.raises(ValueError, match="`budget` must be convex, got SparseBallBudget"):
        attacks.PoisonedRecording(layer, COST, attacks.SparseBall(1, 0.1), samples=1)
    with pytest.raises(ValueError, match="these are compact"):
        attacks.weigh_windows(layer.data.compressed(), torch.ones(14))
