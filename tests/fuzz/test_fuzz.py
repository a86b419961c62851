"""A short fuzz; and the reference itself, on problems with known answers and on plans that are wrong on purpose."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.fuzz.posed import problem_of
from tests.fuzz.problems import Case, make
from tests.fuzz.run import call, layer_of, run
from tests.oracles.extended import minimum_norm, qr
from tests.oracles.judge import Answer, Verdict, check_plan, reference
from tests.oracles.problem import Sample
from tests.oracles.reduction import rows_of

SHORT = 25


@pytest.mark.parametrize("index", range(SHORT))
def test_sensible_problems_are_solved_or_rightly_marked(index):
    report = run("sensible", index)
    assert not report.error, report
    for sample in report.samples:
        assert sample["verdict"] in (Verdict.RIGHT.value, Verdict.MARKED.value), report


def solved(index: int, stream: str = "sensible"):
    """Return problem, rows, sample, reference, u, y, g of the first sample of a case."""
    case = make(stream, index)
    problem = problem_of(case)
    rows = rows_of(problem)
    with torch.no_grad():
        plan = call(layer_of(case), case)
        g = plan.g
    s = case.samples[0]
    return problem, rows, s, reference(problem, rows, s), *(x[0].numpy() for x in (plan.u, plan.y, g))


@pytest.mark.parametrize("index", range(4))
def test_the_judge_sees_a_worse_plan(index):
    """Another plan that satisfies every row costs more; by 1e-3 of a channel is enough to see it."""
    p, rows, s, ref, u, y, g = solved(index)
    assert check_plan(p, rows, s, ref, u, y, g).verdict is Verdict.RIGHT
    kernel = np.linalg.svd(p.Up)[2][np.linalg.matrix_rank(p.Up) :]
    step = kernel.T @ np.random.default_rng(0).normal(size=len(kernel))
    moved = g + 1e-3 * step / np.abs(p.Yf @ step / np.tile(p.scale_y, p.horizon)).max()
    worse = (p.Uf @ moved).reshape(u.shape), (p.Yf @ moved).reshape(y.shape), moved
    assert check_plan(p, rows, s, ref, *worse).verdict in (Verdict.SUBOPTIMAL, Verdict.OUTSIDE)


@pytest.mark.parametrize("index", range(4))
def test_the_judge_sees_rows_that_do_not_hold(index):
    p, rows, s, ref, u, y, g = solved(index)
    assert check_plan(p, rows, s, ref, u + 1e-4 * p.scale_u, y, g).verdict is Verdict.NO_TRAJECTORY
    assert check_plan(p, rows, s, ref, u, y, g * (1 + 1e-4)).verdict is Verdict.NO_TRAJECTORY


def integrator(**changes) -> Case:
    """y[k + 1] = y[k] + u[k] without noise, y_ref = 1 from rest."""
    u = np.random.default_rng(0).uniform(-1, 1, (40, 1))
    y = np.cumsum(u, 0) - u
    weights = {"Q": np.eye(1), "R": np.zeros((1, 1)), "lambda_g": 1.0, "lambda_s": 1e3}
    sample = Sample(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((3, 1)), np.ones((3, 1)))
    case = Case(
        "by hand", 0, [(u, y)], 2, 3, weights, {"u_set": ("box", np.array([-0.25]), np.array([0.25]))}, [sample]
    )
    return dataclasses.replace(case, **changes)


def reference_of(case: Case):
    problem = problem_of(case)
    return problem, reference(problem, rows_of(problem), case.samples[0])


def test_the_reference_finds_a_known_optimum():
    """Full thrust each step: y = 0, 1/4, 1/2; cost 1/2 (1 + 9/16 + 1/4)."""
    problem, ref = reference_of(integrator())
    assert ref.answer is Answer.FEASIBLE
    assert float(ref.optimum.value) == pytest.approx(0.5 * (1 + 9 / 16 + 1 / 4), rel=5e-3)  # y_ini gives a little
    assert float(ref.optimum.value - ref.optimum.bound) < 1e-12
    v = ref.plan[0][:3] * problem.scale_u
    assert np.allclose(np.asarray(v[:2], float), 0.25, atol=1e-12)


def test_the_reference_proves_that_there_is_no_plan():
    sets = {"u_set": ("box", np.array([-0.25]), np.array([0.25])), "du_set": ("box", np.array([0.3]), np.array([0.4]))}
    assert reference_of(integrator(sets=sets))[1].answer is Answer.INFEASIBLE


def test_a_soft_interval_is_left_at_its_price():
    """The last input moves no output: it stays inside; of the first, every unit beyond 1/4 costs the price."""
    sets = {"u_set": ("soft", np.array([-0.25]), np.array([0.25]), np.array([0.1]))}
    weights = {**integrator().weights, "lambda_s": 1e6}
    problem, ref = reference_of(integrator(sets=sets, weights=weights))
    u = np.asarray(ref.plan[0][:3] * problem.scale_u, float)
    # d/du_0: (y_1 - 1) + (y_2 - 1) + 0.1 = 0 and d/du_1: (y_2 - 1) + price inside [-0.1, 0.1]
    assert abs((u[0] - 1) + (u[0] + u[1] - 1) + 0.1) < 1e-4 and abs(u[0] + u[1] - 1) <= 0.1 + 1e-6
    assert float(ref.optimum.value - ref.optimum.bound) < 1e-12


def test_long_double_algebra():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(7, 5)) @ rng.normal(size=(5, 12))
    q, r, p = qr(a.T)
    assert np.abs(q @ r - a.T[:, p]).max() < 1e-17 and np.abs(q.T @ q - np.eye(12)).max() < 1e-17
    x, kernel, left = minimum_norm(a, a @ np.ones(12), 1e-12)
    assert kernel.shape == (12, 7) and np.abs(left).max() < 1e-15 and np.abs(kernel.T @ x).max() < 1e-15
