"""Slips that newcomers make: accepted where the meaning is clear, else refused or warned of, with the cure."""

import warnings

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import generator, small_layer
from torch_dpc import attacks

LAYER = small_layer()
HORIZON, T_INI, N_U, N_Y = LAYER.data.horizon, LAYER.data.t_ini, LAYER.data.n_u, LAYER.data.n_y
COST, BUDGET = attacks.TargetInput(torch.ones(N_U)), attacks.RelativeBallBudget(0.1)


def windows(count):
    u, y = dpc.collect(dpc.systems.OscillatingMasses(), 60, generator=generator(0))
    rows = torch.arange(count)[:, None] + torch.arange(T_INI)
    return u[rows], y[rows]


def randn(*shape):
    return torch.randn(*shape, dtype=torch.float64, generator=generator(1))


# --- a reference for each sample, or one over the horizon? ------------------------------------------------------------


@pytest.mark.parametrize("name", ["y_ref", "u_ref"])
def test_as_many_rows_as_samples_and_steps_are_warned_of(name):
    reference = randn(HORIZON, N_Y if name == "y_ref" else N_U)
    with pytest.warns(UserWarning, match=rf"`{name}` .* one trajectory of {HORIZON} steps for all {HORIZON} samples"):
        read = LAYER(*windows(HORIZON), **{name: reference})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        meant = LAYER(*windows(HORIZON), **{name: reference[None]})  # what the warning offers, and its other reading
        each = LAYER(*windows(HORIZON), **{name: reference[:, None]})
    torch.testing.assert_close(read.u, meant.u, rtol=0, atol=0)
    assert not torch.allclose(read.u, each.u)


def test_the_warning_names_the_line_of_the_caller():
    with pytest.warns(UserWarning, match="one trajectory") as caught:
        LAYER(*windows(HORIZON), y_ref=randn(HORIZON, N_Y))
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("count", "reference"),
    [
        (HORIZON, torch.ones(HORIZON, N_Y)),  # alike in either reading
        (HORIZON, torch.ones(N_Y)),
        (HORIZON - 1, randn(HORIZON, N_Y)),
        (1, randn(HORIZON, N_Y)),
    ],
)
def test_clear_references_are_not_warned_of(count, reference):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LAYER(*windows(count), y_ref=reference)


def test_mapped_references_are_not_looked_at():
    u_ini, y_ini = windows(HORIZON)
    torch.vmap(lambda y_ref: LAYER(u_ini, y_ini, y_ref=y_ref).u)(0.1 * randn(2, HORIZON, N_Y))


def test_one_reference_a_sample_names_its_shape():
    with pytest.raises(ValueError, match=r"For one constant reference a sample give y_ref\[:, None\]"):
        LAYER(*windows(4), y_ref=randn(4, N_Y))
    plans = LAYER(*windows(4), y_ref=randn(4, N_Y)[:, None])
    alone = LAYER(*(w[2] for w in windows(4)), y_ref=randn(4, N_Y)[2])
    torch.testing.assert_close(plans.u[2], alone.u)


def test_as_many_rows_as_runs_are_warned_of():
    plant, controller = dpc.systems.OscillatingMasses(), dpc.DPCController(LAYER, 3)
    reference = 0.1 * randn(8, N_Y)
    with pytest.warns(UserWarning, match="one trajectory of 8 steps for all 8 runs") as caught:
        read = dpc.simulate(plant, controller, reference, steps=6, batch=8)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        meant = dpc.simulate(plant, controller, reference[None], steps=6, batch=8)
        each = dpc.simulate(plant, controller, reference[:, None], steps=6, batch=8)
        dpc.simulate(plant, controller, 0.1 * randn(HORIZON + 3, N_Y), steps=3, batch=HORIZON)  # its windows are silent
    torch.testing.assert_close(read.y, meant.y, rtol=0, atol=0)
    assert torch.equal(each.y_ref, reference[:, None].expand(-1, 6, -1))


# --- numbers that are typed by hand -----------------------------------------------------------------------------------


def test_lists_of_integers_are_references_and_targets():
    u_ini, y_ini = (w[0] for w in windows(1))
    floats = LAYER(u_ini, y_ini, y_ref=[1.0, 1.0, 0.0, 0.0], u_ref=1.0)
    integers = LAYER(u_ini, y_ini, y_ref=[1, 1, 0, 0], u_ref=1)
    assert torch.equal(floats.u, integers.u)
    plant, controller = dpc.systems.OscillatingMasses(), dpc.DPCController(LAYER, 3)
    runs = [dpc.simulate(plant, controller, one, steps=4) for one in ([1, 1, 1, 1], 1, 1.0, torch.ones(4))]
    assert all(torch.equal(run.y, runs[0].y) for run in runs)
    assert torch.equal(attacks.TargetInput([1, -1])(floats), attacks.TargetInput([1.0, -1.0])(floats))
    attack = attacks.LinearizedAttack(LAYER, COST, BUDGET)
    assert torch.equal(attack(u_ini, y_ini, y_ref=[1, 1, 0, 0]), attack(u_ini, y_ini, y_ref=[1.0, 1.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("value", "cure"),
    [
        (torch.ones(N_Y, dtype=torch.int64), r"y_ref.double\(\)"),
        (np.ones(N_Y, dtype=int), r"x.astype\(float\)"),
    ],
)
def test_arrays_of_integers_are_no_references(value, cure):
    with pytest.raises(ValueError, match=cure):
        LAYER(*(w[0] for w in windows(1)), y_ref=value)


# --- one object taken for another -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "cure"),
    [
        (lambda: small_layer(Q=torch.ones(N_Y)), r"torch.diag\(Q\)"),
        (lambda: small_layer(R=[1.0, 2.0]), r"torch.diag\(R\)"),
        (lambda: small_layer(R=torch.ones(HORIZON * N_U)), r"torch.diag\(R\)"),
        (lambda: small_layer(u_set=(-1.0, 1.0)), r"Box\(lower, upper\)"),
        (lambda: small_layer(u_set=attacks.Box(1.0)), "Box or Ball bounds plans"),
        (lambda: attacks.LinearizedAttack(LAYER, COST, dpc.Box(-1.0, 1.0)), "attacks.BoxBudget"),
        (lambda: attacks.RandomAttack(dpc.Ball(1.0)), "attacks.BallBudget"),
        (lambda: attacks.RandomAttack(0.1), r"attacks.RelativeBallBudget\(0.1\)"),
        (lambda: attacks.LinearizedAttack(dpc.DPCController(LAYER), COST, BUDGET), "controller.layer"),
        (lambda: run(controller=LAYER), r"DPCController\(layer\)"),
        (lambda: run(attack=BUDGET), r"attacks.RandomAttack\(budget\)"),
    ],
)
def test_what_was_meant_is_named(call, cure):
    with pytest.raises(ValueError, match=cure):
        call()


def run(controller=None, attack=None):
    controller = dpc.DPCController(LAYER) if controller is None else controller
    return dpc.simulate(dpc.systems.OscillatingMasses(), controller, torch.zeros(N_Y), steps=4, attack=attack)


@pytest.mark.parametrize("target", [torch.ones(3), torch.ones(HORIZON, 3), torch.ones(1)])
def test_a_target_of_other_inputs_is_named(target):
    attack = attacks.LinearizedAttack(LAYER, attacks.TargetInput(target), BUDGET)
    with pytest.raises(ValueError, match="`u_target` must have one value for each input"):
        attack(*(w[0] for w in windows(1)))
