"""Hankel matrices, their ranks, and what is said about excitation."""

import warnings

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import generator, masses_data, randn, relative, small_data
from torch_dpc.problem.compact_form import projector

EXACT = 1e-10
GOOD = {"t_ini": 2, "horizon": 3}


def recording(steps=40, n_u=2, n_y=3, seed=0):
    return randn(steps, n_u, seed=seed), randn(steps, n_y, seed=seed + 1)


def test_hankel_entry_by_entry():
    w = randn(9, 2)
    H = dpc.hankel(w, depth=4)
    assert H.shape == (8, 6)
    for row in range(8):
        for column in range(6):
            assert H[row, column] == w[column + row // 2, row % 2]


def test_past_and_future_are_the_windows_of_the_recording():
    u, y = recording()
    data = dpc.HankelData.from_trajectories(u, y, **GOOD)
    assert (data.n_u, data.n_y, data.t_ini, data.horizon, data.n_g) == (2, 3, 2, 3, 36)
    for j in range(data.n_g):
        torch.testing.assert_close(data.Up[:, j], u[j : j + 2].reshape(-1), rtol=0, atol=0)
        torch.testing.assert_close(data.Uf[:, j], u[j + 2 : j + 5].reshape(-1), rtol=0, atol=0)
        torch.testing.assert_close(data.Yp[:, j], y[j : j + 2].reshape(-1), rtol=0, atol=0)
        torch.testing.assert_close(data.Yf[:, j], y[j + 2 : j + 5].reshape(-1), rtol=0, atol=0)


def test_several_recordings_stand_side_by_side_without_a_seam():
    parts = [recording(steps, seed=steps) for steps in (25, 5, 31)]
    data = dpc.HankelData.from_trajectories([u for u, _ in parts], [y for _, y in parts], **GOOD)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dpc.ExcitationWarning)  # the recording of 5 samples alone is one window
        alone = [dpc.HankelData.from_trajectories(u, y, **GOOD) for u, y in parts]
    assert data.n_g == 21 + 1 + 27
    for name in ("Up", "Uf", "Yp", "Yf"):
        whole = torch.cat([getattr(a, name) for a in alone], dim=1)
        torch.testing.assert_close(getattr(data, name), whole, rtol=0, atol=0)


@pytest.mark.parametrize("convert", [torch.Tensor.numpy, torch.Tensor.tolist], ids=["numpy", "lists"])
def test_numpy_and_nested_lists_are_data(convert):
    parts = [recording(steps, seed=steps) for steps in (25, 31)]
    for u, y in (parts[0], ([u for u, _ in parts], [y for _, y in parts])):
        many = isinstance(u, list)
        expected = dpc.HankelData.from_trajectories(u, y, **GOOD)
        us, ys = ([convert(w) for w in u], [convert(w) for w in y]) if many else (convert(u), convert(y))
        torch.testing.assert_close(dpc.HankelData.from_trajectories(us, ys, **GOOD).Yf, expected.Yf, rtol=0, atol=0)


def test_the_recording_is_not_changed_and_a_graph_is_kept():
    u, y = recording()
    kept = u.clone(), y.clone()
    u.requires_grad_(), y.requires_grad_()
    data = dpc.HankelData.from_trajectories(u, y, **GOOD)
    (data.Uf.sum() + data.Yp.sum()).backward()
    # sample k is in Uf as often as windows hold it among their last three steps, in Yp among their first two
    k = torch.arange(40)
    in_future = sum(((k - i >= 0) & (k - i < 36)).double() for i in (2, 3, 4))
    torch.testing.assert_close(u.grad, in_future[:, None].expand(40, 2))
    torch.testing.assert_close(y.grad[:3, 0], torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64))
    assert torch.equal(u.detach(), kept[0]) and torch.equal(y.detach(), kept[1])


# --- rank -------------------------------------------------------------------------------------------------------------


def test_rank_of_a_noise_free_linear_system_is_its_order_plus_its_inputs():
    assert masses_data().rank == 4 + 2 * 31
    assert "rank=66" in repr(masses_data())


def test_rank_of_noisy_data_is_full():
    assert masses_data(1e-6).rank == (6 + 25) * (2 + 4)


@pytest.mark.parametrize("scales", [(1e6, 1e-6), (1e-4, 1e5)], ids=str)
def test_rank_does_not_depend_on_the_units_of_the_channels(scales):
    u, y = dpc.collect(dpc.systems.OscillatingMasses(), 200, generator=generator())
    units_y = torch.tensor([1.0, scales[0], 1.0, scales[1]], dtype=torch.float64)
    units_u = torch.tensor([scales[1], 1.0], dtype=torch.float64)
    data = dpc.HankelData.from_trajectories(u * units_u, y * units_y, t_ini=4, horizon=8)
    assert data.rank == 4 + 2 * 12


def test_rank_of_single_precision_recordings_ignores_their_rounding():
    u, y = dpc.collect(dpc.systems.OscillatingMasses(), 300, generator=generator())
    data = dpc.HankelData.from_trajectories(u.float(), y.float(), t_ini=4, horizon=10)
    assert data.rank == 4 + 2 * 14


@pytest.mark.parametrize("noise", [0.0, 1e-8, 1e-2])
def test_the_basis_is_orthonormal_and_holds_every_row(noise):
    data = masses_data(noise)
    B = data.row_space.basis
    torch.testing.assert_close(B.T @ B, torch.eye(data.rank, dtype=B.dtype), rtol=0, atol=EXACT)
    for rows in data.matrices:
        assert relative(rows @ B @ B.T, rows) < EXACT


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-2])
def test_M_is_the_projector_of_the_paper(noise):
    data = small_data(noise)
    W = torch.cat([data.Up, data.Yp, data.Uf]).numpy()
    M = np.eye(data.n_g) - np.linalg.pinv(W, rcond=1e-9) @ W
    assert np.abs(projector(data).numpy() - M).max() < 1e-9
    a = randn(data.rank, seed=1)
    tail = a[data.row_space.rank_W :].norm()
    assert abs(torch.from_numpy(M @ (data.row_space.basis @ a).numpy()).norm() - tail) < 1e-9


# --- excitation -------------------------------------------------------------------------------------------------------


def brute_force_order(recordings):
    order = 0
    for depth in range(1, max(len(w) for w in recordings) + 1):
        H = np.concatenate([dpc.hankel(w, depth).numpy() for w in recordings if len(w) >= depth], axis=1)
        if np.linalg.matrix_rank(H) == H.shape[0]:
            order = depth
    return order


def test_excitation_order_of_known_inputs():
    steps = torch.arange(60.0, dtype=torch.float64)
    assert dpc.excitation_order([torch.zeros(9, 1, dtype=torch.float64)]) == 0
    assert dpc.excitation_order([torch.ones(9, 1, dtype=torch.float64)]) == 1
    assert dpc.excitation_order([torch.sin(0.3 * steps)[:, None]]) == 2  # two orders a frequency
    assert dpc.excitation_order([(torch.sin(0.3 * steps) + torch.sin(1.1 * steps))[:, None]]) == 4


@pytest.mark.parametrize("lengths", [(30,), (9, 17), (4, 4, 21)], ids=str)
def test_excitation_order_is_the_largest_depth_of_full_row_rank(lengths):
    for n_u in (1, 2):
        recordings = [randn(steps, n_u, seed=steps + i) for i, steps in enumerate(lengths)]
        assert dpc.excitation_order(recordings) == brute_force_order(recordings)


def test_too_little_excitation_warns_with_the_numbers():
    u, y = recording(steps=60, n_u=1)
    with pytest.warns(dpc.ExcitationWarning, match=r"persistently exciting of order 2, 9 .*needed"):
        u_sine = torch.sin(0.3 * torch.arange(60.0, dtype=torch.float64))[:, None]
        dpc.HankelData.from_trajectories(u_sine, y, t_ini=3, horizon=6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_a_recording_shorter_than_one_window_is_an_error():
    u, y = recording(steps=5)
    with pytest.raises(ValueError, match=r"recording 1 .*t_ini \+ horizon = 5 .*got 4"):
        dpc.HankelData.from_trajectories([u, u[:4]], [y, y[:4]], **GOOD)


@pytest.mark.parametrize("value", [0, -1, 2.0, True, "3", None], ids=str)
@pytest.mark.parametrize("name", ["t_ini", "horizon"])
def test_lengths_must_be_positive_integers(name, value):
    with pytest.raises(ValueError, match=f"`{name}` must be a positive integer, got"):
        dpc.HankelData.from_trajectories(*recording(), **{**GOOD, name: value})


U, Y = recording()
WITH_NAN, WITH_INF = Y.clone(), U.clone()
WITH_NAN[3, 1], WITH_INF[0, 0] = torch.nan, torch.inf


@pytest.mark.parametrize(
    ("u", "y", "says"),
    [
        (U, WITH_NAN, "`y.*finite.*1 NaN"),
        (WITH_INF, Y, "`u.*finite.*1 NaN or infinite"),
        (U.long(), Y, "`u.*floating.*int64"),
        (U, Y > 0, "`y.*floating.*bool"),
        (U[:, 0], Y, r"`u` must have shape \(T, n\).*\(40,\)"),
        (U, Y[None, None], r"`y` must have shape \(T, n\)"),
        (U[:30], Y, "as long, got 30 and 40"),
        ([U, U], [Y], "as many recordings, got 2 and 1"),
        ([U, U[:, :1]], [Y, Y], "recording 1 has other channels"),
        (U[:, :0], Y, "`u` must have shape"),
        ([[1, 2], [3, 4]], Y, "`u.*floating"),
        ([[1.0, 2.0], [3.0]], Y, "`u.*rectangular"),
        ([], [], "`u`"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_bad_recordings_are_named(u, y, says):
    with pytest.raises(ValueError, match=says):
        dpc.HankelData.from_trajectories(u, y, **GOOD)


def test_the_basis_is_orthonormal_to_rounding_where_the_remainder_is_faint():
    """Orthogonalised once, the directions of Yf that W does not reach keep 4e-14 of W on this noisy recording."""
    basis = small_data().row_space.basis
    assert (basis.mT @ basis - torch.eye(basis.shape[1])).abs().max() < 1e-14
