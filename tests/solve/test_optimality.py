"""The plan is optimal: closed forms, the paper's F = 0, and predictive control with the true model."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import (
    HOLDING,
    SMALL,
    Y_REF,
    bounds_of,
    delayed_data,
    masses_data,
    model_plan,
    paper_layer,
    randn,
    relative,
    small_data,
    small_layer,
    windows,
)
from torch_dpc import CompactForm
from torch_dpc.problem.projected_kkt import optimality_map

#: F relative to its terms, 1e-8 at most. A w found here by least squares is no better than its condition (lambda_s).
F_TOLERANCE = {"lam": 1e-10, "least squares": 1e-9}
PLAN = 1e-9
CLOSED_FORM = 1e-10


def paper_F(layer, sol, u_ini, y_ini, i, w_from, **refs):
    """Return |F| of sample i, each block relative to its own terms, from P, q, H, b as printed."""
    P, q, H, b = layer.compact_form(u_ini[i], y_ini[i], **refs)
    lower, upper = bounds_of(layer)
    n = len(lower)
    v = torch.cat([sol.u[i].reshape(-1), sol.y[i].reshape(-1)])
    z = torch.cat([v, sol.g[i]])
    slope = P @ z + q
    if w_from == "lam":  # the rows of u and y: P z + q - w + lam = 0; those of g: P z + q + [Uf; Yf]'w + Up'w_p = 0
        w_v = slope[:n] + sol.lam[i]
        n_p = H.shape[0] - n
        w_p = torch.linalg.lstsq(H[:n_p, n:].T, -(slope[n:] + H[n_p:, n:].T @ w_v)[:, None]).solution[:, 0]
        w = torch.cat([w_p, w_v])
    else:  # stationarity of everything that no bound holds, by least squares
        free = torch.ones(len(z), dtype=torch.bool)
        free[:n] = (v > lower + 1e-9) & (v < upper - 1e-9)
        w = torch.linalg.lstsq(H[:, free].T, -slope[free, None], driver="gelsd").solution[:, 0]
    pushed = z - slope - H.T @ w
    pushed[:n] = torch.minimum(torch.maximum(pushed[:n], lower), upper)
    F1, F2 = z - pushed, H @ z - b
    # The package's own map says the same, to the rounding of its terms.
    rounding = 1e-12 * (1 + (P.abs() @ z.abs()).max() + q.abs().max() + (H.T @ w).abs().max()).item()
    ours = optimality_map(CompactForm(P, q, H, b), z, w, lower, upper)
    torch.testing.assert_close(ours, torch.cat([F1, F2]), rtol=0, atol=rounding)
    parts = []
    n_u = layer.data.horizon * layer.data.n_u
    for block in (slice(0, n_u), slice(n_u, n), slice(n, None)):
        terms = (P[block] @ z).norm() + q[block].norm() + (H.T @ w)[block].norm() + v.norm()
        parts.append(float(F1[block].norm() / terms))
    parts.append(float(F2.norm() / (b.norm() + v.norm())))
    return max(parts)


def test_compact_form_is_what_the_paper_prints():
    layer = small_layer(1e-2, Q=torch.diag(randn(4).abs()), R=torch.diag(randn(2).abs() + 0.1))
    data = layer.data
    u_ini, y_ini = windows(3, 3, seed=1)
    y_ref, u_ref = randn(3, 6, 4, seed=2), randn(6, 2, seed=3)
    P, q, H, b = layer.compact_form(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref)
    n, m = 6 * 6 + data.n_g, 6 * 6 + 3 * 2
    assert (P.shape, q.shape, H.shape, b.shape) == ((n, n), (3, n), (m, n), (3, m))
    assert layer.full_kkt_size == n + m and layer.reduced_kkt_size == 36
    assert paper_layer().full_kkt_size == 812 and paper_layer().reduced_kkt_size == 150
    u, y, g = randn(6, 2, seed=4), randn(6, 4, seed=5), randn(data.n_g, seed=6)
    W = torch.cat([data.Up, data.Yp, data.Uf])
    Mg = g - torch.linalg.pinv(W) @ (W @ g)
    for i in range(3):
        cost = 0.5 * ((y - y_ref[i]) ** 2 * layer.Q.diag()).sum() + 0.5 * ((u - u_ref) ** 2 * layer.R.diag()).sum()
        cost = cost + layer.lambda_g * Mg @ Mg + layer.lambda_s * (data.Yp @ g - y_ini[i].reshape(-1)).square().sum()
        at_zero = 0.5 * (y_ref[i] ** 2 * layer.Q.diag()).sum() + 0.5 * (u_ref**2 * layer.R.diag()).sum()
        at_zero = at_zero + layer.lambda_s * y_ini[i].square().sum()
        z = torch.cat([u.reshape(-1), y.reshape(-1), g])
        torch.testing.assert_close(0.5 * z @ P @ z + q[i] @ z, cost - at_zero, rtol=1e-10, atol=0)
        constraint = [data.Up @ g - u_ini[i].reshape(-1), data.Uf @ g - u.reshape(-1), data.Yf @ g - y.reshape(-1)]
        torch.testing.assert_close(H @ z - b[i], torch.cat(constraint), rtol=0, atol=1e-11)


@pytest.mark.parametrize("w_from", ["lam", "least squares"])
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_F_is_zero_on_the_papers_problem(noise, w_from):
    layer = paper_layer(noise)
    u_ini, y_ini = windows(4, seed=2)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    assert (sol.info.n_active > 0).all() and (sol.info.residual < F_TOLERANCE["lam"]).all()
    for i in range(4):
        assert paper_F(layer, sol, u_ini, y_ini, i, w_from, y_ref=Y_REF, u_ref=HOLDING) < F_TOLERANCE[w_from]


@pytest.mark.parametrize("w_from", ["lam", "least squares"])
def test_F_is_zero_where_outputs_meet_their_bounds(w_from):
    layer = small_layer(0.0, y_set=dpc.Box(-0.8, 0.8))
    u_ini, y_ini = windows(8, 3, seed=3, scale=0.5)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert (sol.lam[:, 12:] != 0).any(dim=1).sum() >= 3
    for i in range(8):
        assert paper_F(layer, sol, u_ini, y_ini, i, w_from, y_ref=Y_REF) < F_TOLERANCE[w_from]


def test_F_sees_a_plan_that_is_not_optimal():
    layer = small_layer()
    u_ini, y_ini = windows(1, 3)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    other = layer(u_ini, y_ini, y_ref=0.999 * Y_REF)
    for w_from in ("lam", "least squares"):
        assert paper_F(layer, sol, u_ini, y_ini, 0, w_from, y_ref=Y_REF) < F_TOLERANCE[w_from]
        assert paper_F(layer, other, u_ini, y_ini, 0, w_from, y_ref=Y_REF) > 1e-6


# --- closed forms -----------------------------------------------------------------------------------------------------


def least_squares_plan(layer, u_ini, y_ini, y_ref, u_ref, fixed_u=None):
    """The unconstrained plan, in all of g: min |E g - e| on Up g = u_ini, and on Uf g = fixed_u where given."""
    data, steps = layer.data, layer.data.horizon
    Up, Yp, Uf, Yf = (m.numpy() for m in (data.Up, data.Yp, data.Uf, data.Yf))
    W = np.concatenate([Up, Yp, Uf])
    M = np.eye(data.n_g) - np.linalg.pinv(W, rcond=1e-9) @ W
    roots = [float(w) ** 0.5 for w in (layer.R, layer.Q, 2 * layer.lambda_g, 2 * layer.lambda_s)]
    E = np.concatenate([r * m for r, m in zip(roots, (Uf, Yf, M, Yp), strict=True)])
    targets = [np.tile(u_ref, steps), np.tile(y_ref, steps), np.zeros(data.n_g), y_ini.numpy().reshape(-1)]
    e = np.concatenate([r * t for r, t in zip(roots, targets, strict=True)])
    A, b = (Up, u_ini) if fixed_u is None else (np.concatenate([Up, Uf]), torch.cat([u_ini, fixed_u]))
    g0 = np.linalg.pinv(A, rcond=1e-9) @ b.numpy().reshape(-1)
    _, size, right = np.linalg.svd(A)
    kernel = right[(size > 1e-9 * size[0]).sum() :].T
    g = g0 + kernel @ np.linalg.lstsq(E @ kernel, e - E @ g0, rcond=1e-12)[0]
    return torch.from_numpy(Uf @ g).reshape(steps, -1), torch.from_numpy(Yf @ g).reshape(steps, -1)


@pytest.mark.parametrize("backward", ["reduced", "full"])
@pytest.mark.parametrize("bounds", [None, dpc.Box(-1e6, 1e6)], ids=["reals", "far"])
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_without_active_bounds_the_plan_is_least_squares(noise, bounds, backward):
    layer = dpc.DPCLayer(small_data(noise), **SMALL, u_set=bounds, y_set=bounds, backward=backward)
    u_ini, y_ini = windows(3, 3, seed=4)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    assert sol.info.n_active.tolist() == [0, 0, 0] and not sol.lam.any()
    for i in range(3):
        u, y = least_squares_plan(layer, u_ini[i], y_ini[i], Y_REF, HOLDING)
        assert relative(sol.u[i], u) < CLOSED_FORM
        assert relative(sol.y[i], y) < CLOSED_FORM


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_with_every_input_at_a_bound_the_rest_is_least_squares(noise):
    layer = small_layer(noise, u_set=dpc.Box(-1e-3, 2e-3))
    u_ini, y_ini = windows(3, 3, seed=4)
    signs = torch.tensor([1.0, -1.0], dtype=torch.float64)
    sol = layer(u_ini, y_ini, u_ref=1e3 * signs)  # far outside: pulls every input to its bound
    at_bounds = torch.tensor([2e-3, -1e-3], dtype=torch.float64).expand(6, 2)
    assert sol.info.n_active.tolist() == [12, 12, 12]
    for i in range(3):
        assert torch.equal(sol.u[i], at_bounds)
        u, y = least_squares_plan(layer, u_ini[i], y_ini[i], np.zeros(4), 1e3 * signs, fixed_u=at_bounds)
        assert relative(sol.y[i], y) < CLOSED_FORM
    assert (sol.lam[:, :12].unflatten(1, (6, 2)) * signs > 0).all()


def test_bounds_that_leave_one_point_fix_the_input():
    fixed = 0.3 * randn(6, 2, seed=7)
    layer = small_layer(u_set=dpc.Box(fixed, fixed))
    u_ini, y_ini = windows(2, 3, seed=4)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    for i in range(2):
        torch.testing.assert_close(sol.u[i], fixed, rtol=0, atol=0)
        assert relative(sol.y[i], least_squares_plan(layer, u_ini[i], y_ini[i], Y_REF, [0, 0], fixed)[1]) < CLOSED_FORM


def test_a_plan_lies_in_its_sets_to_the_last_bit():
    layer = small_layer(0.0, y_set=dpc.Box(-0.8, 0.8))
    u_ini, y_ini = windows(50, 3, seed=3, scale=0.5)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert sol.u.abs().max() <= 0.5 and sol.y.abs().max() <= 0.8


def test_step_by_step_and_channel_by_channel_bounds():
    lower, upper = -0.5 * randn(6, 2, seed=8).abs(), torch.tensor([0.2, torch.inf], dtype=torch.float64)
    layer = small_layer(u_set=dpc.Box(lower, upper))
    u_ini, y_ini = windows(4, 3, seed=5)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    assert (sol.u >= lower).all() and (sol.u <= upper).all() and (sol.info.n_active > 0).all()
    for i in range(4):
        assert paper_F(layer, sol, u_ini, y_ini, i, "lam", y_ref=Y_REF) < F_TOLERANCE["lam"]


def test_weights_of_the_whole_horizon_are_the_steps_side_by_side():
    Q, R = randn(4, 4, seed=1), randn(2, 2, seed=2)
    Q, R = Q @ Q.T, R @ R.T
    u_ini, y_ini = windows(4, 3, seed=5)
    whole = {"Q": torch.block_diag(*[Q] * 6), "R": torch.block_diag(*[R] * 6)}
    a, b = (small_layer(**weights)(u_ini, y_ini, y_ref=Y_REF) for weights in ({"Q": Q, "R": R}, whole))
    assert relative(a.u, b.u) < CLOSED_FORM


# --- predictive control with the model --------------------------------------------------------------------------------


@pytest.mark.parametrize("u_bound", [0.4, 1.0, 10.0])
def test_on_noise_free_data_the_plan_is_that_of_the_true_model(u_bound):
    layer = paper_layer(u_set=dpc.Box(-u_bound, u_bound), y_set=dpc.Box(-3.0, 3.0))
    u_ini, y_ini = windows(3, seed=6)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    for i in range(3):
        u, y = model_plan(layer, u_ini[i], y_ini[i], Y_REF, HOLDING)
        assert relative(sol.u[i], u) < PLAN
        assert relative(sol.y[i], y) < PLAN


def test_under_disturbed_measurements_too():
    """The state that fits the disturbed window best, at the price lambda_s: the attack's own situation."""
    layer = paper_layer()
    u_ini, y_ini = windows(3, seed=6)
    y_ini = y_ini + 0.1 * randn(*y_ini.shape, seed=9)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    for i in range(3):
        assert relative(sol.u[i], model_plan(layer, u_ini[i], y_ini[i], Y_REF, HOLDING)[0]) < PLAN


def test_textbook_predictive_control_is_the_limit_of_a_large_lambda_s():
    u_ini, y_ini = windows(1, seed=6)
    gaps = []
    for lambda_s in (1e4, 1e6, 1e8):
        layer = paper_layer(lambda_s=lambda_s)
        sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
        gaps.append(relative(sol.y[0], model_plan(layer, u_ini[0], y_ini[0], Y_REF, HOLDING, hard=True)[1]))
    # The state may move by what it saves over lambda_s: the gap falls in proportion.
    assert gaps[0] == pytest.approx(100 * gaps[1], rel=0.1) and gaps[1] == pytest.approx(100 * gaps[2], rel=0.1)
    assert gaps[2] < 1e-6


def test_a_delay_makes_the_first_output_of_the_plan_known():
    layer = dpc.DPCLayer(delayed_data(), 1.0, 1.0, 1.0, 1e3)
    u_ini, y_ini = randn(5, 3, 1, seed=1), randn(5, 3, 2, seed=2)
    torch.testing.assert_close(layer(u_ini, y_ini).y[:, 0, 1], u_ini[:, -1, 0], rtol=0, atol=1e-12)
    assert masses_data().rank != layer.data.rank == 1 + 9 + 1  # the lag, the inputs, and the input before the window
