"""The guards: whatever an engine returns, a plan is right or marked. Each test fails when its guard is weakened."""

import math

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import Y_REF, small_layer, windows
from torch_dpc.sets.bounds import Bounds
from torch_dpc.solve import active_set, certificate, daqp, last_resort, optimality, outcome, weakness
from torch_dpc.solve.compiled import CompiledPlanner
from torch_dpc.solve.engines import Engines
from torch_dpc.solve.outcome import Found
from torch_dpc.solve.second_look import SecondLook

SETS = {"boxes": {}, "balls": {"u_set": dpc.Ball(0.4)}}  # both bite on the windows below
TOLERANCE = 1e-8  # of a plan that is called solved, relative to the largest entry


@pytest.fixture(params=SETS)
def problem(request, monkeypatch):
    """A layer whose sets bite, its plans, and the inputs; whole plans in one kernel call are off."""
    layer = small_layer(on_failure="nan", **SETS[request.param])
    inputs = windows(8, 3)
    right = layer(*inputs, y_ref=Y_REF)
    assert (right.info.status == 0).all() and (right.info.n_active > 0).all()
    monkeypatch.setattr(CompiledPlanner, "of", staticmethod(lambda *_: None))
    fresh = small_layer(on_failure="nan", **SETS[request.param])
    return fresh, inputs, right


def engine_that_spoils(monkeypatch, spoil):
    """Have every engine return spoilt multipliers, and say that they have converged."""
    run = Engines.run

    def spoilt(self, name, v0, sets):
        found = run(self, name, v0, sets)
        return Found(spoil(found.lam), found.iterations, torch.ones_like(found.converged), found.gap)

    monkeypatch.setattr(Engines, "run", spoilt)


def unpolished(self, theta, lam, moved, step):
    """In place of the polish of a second look."""
    return lam, self._raw(theta, lam, torch.zeros_like(lam)) + moved


def solved_and_wrong(plan, right):
    error = ((plan.u - right.u).abs() / right.u.abs().max()).flatten(1).amax(1)
    return (plan.info.status == 0) & ~(error <= TOLERANCE)


def test_multipliers_of_zero_are_not_believed(problem, monkeypatch):
    layer, inputs, right = problem
    engine_that_spoils(monkeypatch, torch.zeros_like)
    plan = layer(*inputs, y_ref=Y_REF)
    assert not solved_and_wrong(plan, right).any()  # on balls, a second look finds the solution from zero


@pytest.mark.parametrize("off", [1e-2, 1e-4, 1e-6])
def test_multipliers_that_are_a_little_off_are_polished_or_refused(problem, monkeypatch, off):
    layer, inputs, right = problem
    engine_that_spoils(monkeypatch, lambda lam: lam * (1 + off))
    monkeypatch.setattr(SecondLook, "polished", unpolished)
    monkeypatch.setattr(last_resort, "settled", lambda *_: dpc.Status.FAILED)
    plan = layer(*inputs, y_ref=Y_REF)
    assert not solved_and_wrong(plan, right).any() and (plan.info.status == dpc.Status.FAILED).all()


@pytest.mark.parametrize("factor, shift", [(0.0, 0.0), (-1.0, 0.0), (1.0, 1e3), (torch.nan, 0.0)])
def test_the_last_resort_solves_what_every_engine_spoils(problem, monkeypatch, factor, shift):
    layer, inputs, right = problem
    engine_that_spoils(monkeypatch, lambda lam: lam * factor + shift)
    monkeypatch.setattr(SecondLook, "polished", unpolished)
    plan = layer(*inputs, y_ref=Y_REF)
    assert (plan.info.status == dpc.Status.SOLVED).all() and not solved_and_wrong(plan, right).any()
    assert torch.allclose(plan.lam, right.lam, rtol=1e-7, atol=1e-9)


def test_a_second_look_repairs_what_is_a_little_off(problem, monkeypatch):
    layer, inputs, right = problem
    engine_that_spoils(monkeypatch, lambda lam: lam * (1 + 1e-7))
    plan = layer(*inputs, y_ref=Y_REF)
    assert (plan.info.status == 0).all() and not solved_and_wrong(plan, right).any()


def test_a_failed_solve_is_not_called_infeasible(problem, monkeypatch):
    """Every problem has a plan: a bad engine must not make a proof."""
    layer, inputs, _ = problem
    engine_that_spoils(monkeypatch, lambda lam: -lam - 1.0)
    assert not (layer(*inputs, y_ref=Y_REF).info.status == dpc.Status.INFEASIBLE).any()


def test_a_flag_of_daqp_is_not_believed(monkeypatch):
    right = small_layer(solver="newton")(*(w[0] for w in windows(1, 3)), y_ref=Y_REF)
    assert right.info.n_active > 0
    monkeypatch.setattr(daqp.Daqp, "solve", lambda self, lower, *_: (np.zeros_like(lower), daqp.SOLVED_FLAG, 1))
    plan = small_layer(solver="daqp", on_failure="nan")(*(w[0] for w in windows(1, 3)), y_ref=Y_REF)
    wrong = int(plan.info.status) == 0 and not torch.allclose(plan.u, right.u, atol=1e-8)
    assert not wrong


def test_the_errors_of_the_map_are_part_of_the_residual():
    solver = small_layer().factored(torch.device("cpu")).solver
    judge = optimality.Optimality(solver.in_units.reduction, optimality.BATCHED)
    lam = torch.zeros(2, solver.sizes.v, dtype=torch.float64)
    assert judge.residual(lam, torch.zeros_like(lam), torch.tensor([0.0, 1e-3], dtype=torch.float64)).tolist() == [
        0.0,
        1e-3,
    ]


def test_tolerances_are_the_documented_ones():
    """The figures that docs and acceptance rest on: a change is a decision, and is made here too."""
    assert outcome.ACCEPTANCE.residual == 1e-8 and outcome.ACCEPTANCE.convincing <= 1e-9
    assert weakness.WEAKLY_ACTIVE == 1e-9


@pytest.mark.parametrize(
    ("v0", "Ct", "is_proof"),
    [
        (2.0, 0.0, True),  # fixed, outside of [-1, 1]
        (0.0, 0.0, False),  # fixed, inside
        (1 + 1e-12, 0.0, False),  # outside by rounding
        (2.0, 1.0, False),  # outside, but it can move
        (2.0, 1e-3, False),
    ],
)
def test_a_direction_proves_only_what_it_separates(v0, Ct, is_proof):
    bounds = Bounds(torch.tensor([-1.0]).double(), torch.tensor([1.0]).double())
    d, rows = torch.ones(1).double(), torch.full((1, 1), Ct).double()
    assert bool(certificate._separates(d, rows, torch.tensor([v0], dtype=torch.float64), bounds)) is is_proof


def test_rows_that_depend_on_each_other_are_not_trusted():
    """A Cholesky factor of their system exists by rounding, and its answer is rounding."""
    rows = torch.tensor([[1.0, 0.0], [1.0, 1e-6], [0.0, 1.0]], dtype=torch.float64)
    active = torch.tensor([[True, True, False], [True, False, True]])
    trusted = active_set._packed(rows @ rows.T, active, torch.ones(2, 3, dtype=torch.float64))[1]
    assert trusted.tolist() == [False, True]


def test_a_multiplier_is_weak_by_the_displacement_it_makes():
    v, diagonal = torch.zeros(3).double(), torch.tensor([1.0, 1.0, 1e6]).double()
    lam = torch.tensor([1e-10, 1e-7, 1e-10]).double()
    assert weakness.is_without_multiplier(v, lam, diagonal).tolist() == [True, False, False]


def test_bounds_that_leave_no_choice_and_press_on_nothing_give_one_derivative():
    """At rest between equal bounds the multiplier is zero: forward and backward mode must name the same bound."""
    zero = torch.zeros(6, 2, dtype=torch.float64)

    def inputs_of(lower, upper):
        layer = small_layer(noise=0.0, u_set=dpc.Box(lower, upper))
        return layer(zero[:3], torch.zeros(3, 4, dtype=torch.float64)).u

    weight = torch.arange(12, dtype=torch.float64).reshape(6, 2) + 1
    ends = [zero.clone().requires_grad_() for _ in range(2)]
    back = torch.autograd.grad((inputs_of(*ends) * weight).sum(), ends)
    for i, bar in enumerate(back):
        change = [torch.zeros_like(zero), torch.zeros_like(zero)]
        change[i] = torch.ones_like(zero)
        ahead = torch.func.jvp(inputs_of, (zero, zero), tuple(change))[1]
        assert math.isclose(float((ahead * weight).sum()), float(bar.sum()), abs_tol=1e-9)
    assert torch.allclose(back[1], weight) and not back[0].any()
