"""The moment relaxation: bounds and intervals that hold for every plan, and are exact where the problem is convex."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import Y_REF, generator, small_layer, windows
from torch_dpc import attacks
from torch_dpc.attacks.exact.complementarity import FREE, allowed_states
from torch_dpc.attacks.exact.moments import Moments
from torch_dpc.attacks.exact.relaxation import Quadratic
from torch_dpc.attacks.exact.semidefinite import Program, prove
from torch_dpc.attacks.exact.shrink import shrink
from torch_dpc.attacks.exact.window import Window

TARGET = torch.tensor([0.3, -0.4], dtype=torch.float64)
ROUNDING = 1e-7


def held_window(radius=0.05):
    """A window whose plans meet bounds of outputs within the budget."""
    layer = small_layer(y_set=dpc.Box(-0.1, 0.1))
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=7, scale=0.05))
    theta, _ = layer.flatten(0.1 * u_ini, y_ini, 0.3 * Y_REF, None)
    window = Window(layer, attacks.Ball(radius), theta)
    rows = window.rows(np.flatnonzero(window.has_bound))
    rows.propagate()
    rows = window.rows(rows.index[allowed_states(rows) != FREE])
    assert rows.H is not None and (rows.index >= window.n_u).any()
    rows.propagate()
    psi = Quadratic(
        window.v0[: window.n_u] - TARGET.repeat(6).numpy(),
        window.A[: window.n_u],
        -window.G[: window.n_u, rows.index],
    )
    return window, rows, psi


def sampled(window, n=2000):
    many = window.y_ini.expand(n, -1, -1)
    shrunk = torch.rand(n, 1, 1, dtype=torch.float64, generator=generator(1)) ** 0.1
    p = window.budget.random(many, generator()) * shrunk
    plans = window.layer(window.u_ini.expand(n, -1, -1), many + p, **window.refs, on_failure="nan")
    assert (plans.info.status == 0).all()
    return plans, attacks.TargetInput(TARGET)(plans)


@pytest.mark.parametrize("wanted", [2.0, 0.3, -5.0])
def test_a_convex_problem_is_solved(wanted):
    """min (s - wanted)^2 over s^2 <= 1."""
    ball, one = np.diag([1.0, -1.0]), np.array([[1.0, 0.0]])
    F = np.array([[wanted**2, -wanted], [-wanted, 1.0]])
    proof = prove(Program(F, one, one, ball[None], np.array([False])), np.array([0.0, 1.0]), tolerance=1e-8)
    expected = max(abs(wanted) - 1, 0.0) ** 2
    assert proof.bound <= expected + ROUNDING and proof.bound == pytest.approx(expected, abs=1e-6)
    assert np.linalg.eigvalsh(proof.M)[0] > 0


def test_a_nonconvex_objective_over_a_ball_is_bounded_exactly():
    """min of -s_1^2 + s_2 over the unit ball: -s_1^2 + s_2 with s_1^2 = 1 - s_2^2 is s_2^2 + s_2 - 1 >= -5/4."""
    F = np.array([[0.0, 0.0, 0.5], [0.0, -1.0, 0.0], [0.5, 0.0, 0.0]])
    one = np.array([[1.0, 0.0, 0.0]])
    ball = np.diag([1.0, -1.0, -1.0])[None]
    proof = prove(Program(F, one, one, ball, np.array([False])), np.array([-5.0, 3.0]), tolerance=1e-8)
    assert proof.bound == pytest.approx(-1.25, abs=1e-6)


def test_the_bound_is_below_every_plan_and_above_what_shrinking_started_from():
    window, rows, psi = held_window()
    plans, value = sampled(window)
    assert (plans.lam[:, window.n_u :] != 0).any()
    lam, pieces = window.lam[rows.index], window.of_s.pieces
    moments = Moments(rows, pieces, lam)
    first = moments.minimum(moments.quadratic(psi), tolerance=1e-5).bound
    assert shrink(rows, pieces, lam, window.channel[rows.index], np.inf)
    moments = Moments(rows, pieces, lam)
    second = moments.minimum(moments.quadratic(psi), tolerance=1e-5).bound
    assert first - 1e-4 <= second <= float(value.min()) + ROUNDING


@pytest.mark.parametrize("better", [False, True])
def test_shrunk_intervals_hold_every_plan(better):
    window, rows, psi = held_window()
    plans, value = sampled(window)
    cut = float(value.quantile(0.2))
    before = rows.copy()
    lam, channel = window.lam[rows.index], window.channel[rows.index]
    assert shrink(rows, window.of_s.pieces, lam, channel, np.inf, (psi, cut) if better else None)
    assert (rows.lam_high - rows.lam_low).sum() < (before.lam_high - before.lam_low).sum()
    keep = value < cut if better else torch.ones_like(value, dtype=torch.bool)
    v = torch.cat([plans.u.flatten(1), plans.y.flatten(1)], 1)[keep][:, rows.index].numpy()
    multipliers = plans.lam[keep][:, rows.index].numpy()
    for x, low, high in ((v, rows.v_low, rows.v_high), (multipliers, rows.lam_low, rows.lam_high)):
        assert (x >= low - 1e-6).all() and (x <= high + 1e-6).all()
