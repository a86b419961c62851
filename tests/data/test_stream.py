"""Data from streams: the same plans as from whole recordings, in constant memory, with and without forgetting."""

import pickle
import time
import tracemalloc
import warnings

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, PAPER, SMALL, Y_REF, generator, randn, relative, windows
from torch_dpc.data.window_factor import BLOCK
from torch_dpc.problem.compact_form import projector

#: Plans and gradients. On noise-free data the order of the windows alone moves gradients by 6e-10.
SAME = 1e-9
EXACT = 1e-12
SIZES = {"t_ini": 3, "horizon": 5}


def masses(steps=530, noise=0.0, seed=0):
    source = generator(seed)
    return dpc.collect(dpc.systems.OscillatingMasses(noise=noise, generator=source), steps, generator=source)


def pieces(u, y, size):
    return ((u[i : i + size], y[i : i + size]) for i in range(0, len(u), size))


def stacked(data):
    return torch.cat([m.double() for m in data.matrices])


def gram(data):
    """D D', what the problem sees of the data; small enough errors for a test on well-conditioned numbers."""
    D = stacked(data)
    return D @ D.T


def plans(data, n=5, **options):
    """Return u, y, lam and the gradient of |u|^2 with respect to y_ini of some problems whose bounds bite."""
    weights = {**PAPER, "u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.Box(-5.0, 5.0), **options}
    u_ini, y_ini = windows(n, data.t_ini)
    y_ini.requires_grad_()
    plan = dpc.DPCLayer(data, **weights)(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    assert int(plan.info.n_active.sum()) > 0
    (plan.u.square().sum() + plan.y.square().sum()).backward()
    return plan.u.detach(), plan.y.detach(), plan.lam.detach(), y_ini.grad


# --- the same as whole recordings -------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_plans_and_gradients_are_those_of_the_whole_recording(noise):
    u, y = masses(noise=noise)
    whole = dpc.HankelData.from_trajectories(u, y, t_ini=6, horizon=25)
    stream = dpc.HankelData.from_stream(pieces(u, y, 37), t_ini=6, horizon=25)
    assert (stream.rank, stream.n_windows, stream.n_g) == (whole.rank, 500, 186)
    for ours, theirs in zip(plans(stream), plans(whole), strict=True):
        assert relative(ours, theirs) < SAME


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_several_recordings_have_no_window_across_a_seam(noise):
    parts = [masses(steps, noise, seed=steps) for steps in (200, 31, 350)]
    whole = dpc.HankelData.from_trajectories([u for u, _ in parts], [y for _, y in parts], t_ini=6, horizon=25)
    chunks = []
    for u, y in parts:
        chunks += [*pieces(u, y, 90), None]
    stream = dpc.HankelData.from_stream(chunks, t_ini=6, horizon=25)
    assert stream.n_windows == whole.n_g == 170 + 1 + 320
    for ours, theirs in zip(plans(stream), plans(whole), strict=True):
        assert relative(ours, theirs) < SAME


@pytest.mark.parametrize("size", [1, 2, 7, 8, 9, BLOCK - 1, BLOCK, BLOCK + 1, BLOCK + 7, BLOCK + 8, 5000], ids=str)
def test_how_the_recording_is_cut_does_not_matter(size):
    u, y = randn(1300, 2), randn(1300, 3, seed=1)
    whole = dpc.HankelData.from_trajectories(u, y, **SIZES)
    stream = dpc.HankelData.from_stream(pieces(u, y, size), **SIZES)
    assert stream.n_windows == whole.n_g == 1293
    assert relative(gram(stream), gram(whole)) < EXACT


def test_fewer_windows_than_rows():
    u, y = randn(20, 2), randn(20, 3, seed=1)
    with pytest.warns(dpc.ExcitationWarning, match="13 windows for 16 input rows"):
        stream = dpc.HankelData.from_stream([(u, y)], **SIZES)
    with pytest.warns(dpc.ExcitationWarning):
        whole = dpc.HankelData.from_trajectories(u, y, **SIZES)
    assert stream.n_g == stream.rank == whole.rank == 13
    assert relative(gram(stream), gram(whole)) < EXACT


@pytest.mark.parametrize("scales", [(1e6, 1e-6), (1e-4, 1e5)], ids=str)
def test_units_of_the_channels_do_not_matter(scales):
    u, y = masses(200)
    units_y = torch.tensor([1.0, scales[0], 1.0, scales[1]], dtype=torch.float64)
    units_u = torch.tensor([scales[1], 1.0], dtype=torch.float64)
    data = dpc.HankelData.from_stream(pieces(u * units_u, y * units_y, 50), t_ini=4, horizon=8)
    assert data.rank == 4 + 2 * 12


def test_numpy_and_single_precision_recordings():
    u, y = masses(300)
    of_arrays = dpc.HankelData.from_stream([(u.numpy(), y.numpy())], **SIZES)
    assert torch.equal(of_arrays.Yf, dpc.HankelData.from_stream([(u, y)], **SIZES).Yf)
    single = dpc.HankelData.from_stream([(u[:150], y[:150]), (u[150:].float(), y[150:].float())], t_ini=4, horizon=10)
    assert single.rank == 4 + 2 * 14  # the rounding of half the samples to single precision is no signal
    assert single.Up.dtype == torch.float64


def test_the_paper_system_stays_whole_on_compact_data():
    """The compact form in the coordinates of the compact data is the problem, and "full" solves it."""
    u, y = masses(150, noise=1e-2)
    stream = dpc.HankelData.from_stream([(u, y)], **SIZES)
    options = {**SMALL, "u_set": dpc.Box(-0.5, 0.5), "y_set": None}
    layer = dpc.DPCLayer(stream, **options)
    P, q, H, b = layer.compact_form(*(w[0] for w in windows(1, 3)), y_ref=Y_REF)
    assert P.shape[0] == 5 * 6 + stream.n_g and H.shape[1] == q.shape[0] == P.shape[0] and len(b) == H.shape[0]
    assert layer.full_kkt_size == 2 * 30 + 3 * 2 + stream.n_g
    whole = dpc.HankelData.from_trajectories(u, y, **SIZES)
    for ours, theirs in zip(plans(stream, **options, backward="full"), plans(whole, **options), strict=True):
        assert relative(ours, theirs) < 1e-7  # the paper's system, scaled, is right to about 1e-9


def test_g_is_refused_in_words():
    u, y = masses(100, noise=1e-2)
    whole = dpc.HankelData.from_trajectories(u, y, **SIZES)
    assert whole.has_windows and whole.n_windows == whole.n_g == 93
    for data in (dpc.HankelData.from_stream([(u, y)], **SIZES), whole.compressed()):
        assert not data.has_windows
        plan = dpc.DPCLayer(data, **SMALL)(*windows(2, 3))
        with pytest.raises(ValueError, match="of 93 windows only the factor is kept.*from_trajectories"):
            plan.g  # noqa: B018
        with pytest.raises(ValueError, match="compact"):
            plan.sample(1).g  # noqa: B018
    assert dpc.DPCLayer(whole, **SMALL)(*windows(2, 3)).g.shape == (2, 93)


# --- compressed -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_compressed_data_give_the_same_bits(noise):
    data = dpc.HankelData.from_trajectories(*masses(noise=noise), t_ini=6, horizon=25)
    compact = data.compressed()
    assert compact.n_g == compact.rank == data.rank and compact.n_windows == 500
    for ours, theirs in zip(plans(compact), plans(data), strict=True):
        assert torch.equal(ours, theirs)
    assert "compact, of 500 windows" in repr(compact)


def test_compressed_data_pass_gradients_to_the_recording():
    u, y = masses(90, noise=1e-2)
    grads = []
    for compress in (False, True):
        recorded = y.clone().requires_grad_()
        data = dpc.HankelData.from_trajectories(u, recorded, **SIZES)
        layer = dpc.DPCLayer(data.compressed() if compress else data, **SMALL, u_set=dpc.Box(-0.5, 0.5))
        layer(*windows(3, 3), y_ref=Y_REF).u.square().sum().backward()
        grads.append(recorded.grad)
    assert relative(*grads) < SAME


# --- online -----------------------------------------------------------------------------------------------------------


def weighted(u, y, forgetting):
    """The columns of the whole recording times sqrt(weight), as data with windows."""
    data = dpc.HankelData.from_trajectories(u, y, **SIZES)
    w = forgetting ** torch.arange(data.n_g - 1.0, -1.0, -1.0, dtype=torch.float64)
    return dpc.HankelData(*(m * w.sqrt() for m in (data.Up, data.Uf, data.Yp, data.Yf)), 3, 5, data.n_u, data.n_y), w


@pytest.mark.parametrize("size", [1, 10, 2000])
def test_forgetting_weighs_the_columns(size):
    u, y = masses(700, noise=1e-2)
    stream = dpc.HankelStream(**SIZES, forgetting=0.99)
    for chunk in pieces(u, y, size):
        stream.append(*chunk)
    reference, w = weighted(u, y, 0.99)
    assert abs(stream.n_effective - float(w.sum())) < 1e-9
    assert relative(gram(stream.data), gram(reference)) < EXACT
    options = {**SMALL, "u_set": dpc.Box(-0.5, 0.5)}
    for ours, theirs in zip(plans(stream.data, **options), plans(reference, **options), strict=True):
        assert relative(ours, theirs) < SAME


def test_what_lambda_g_charges_under_forgetting():
    """The two readings of the documentation, for the plan of weighted columns."""
    reference, w = weighted(*masses(160, noise=1e-2), 0.98)
    layer = dpc.DPCLayer(reference, **SMALL, u_set=dpc.Box(-0.5, 0.5))
    plan = layer(*(window[0] for window in windows(1, 3)), y_ref=Y_REF)
    charged = (projector(reference) @ plan.g).square().sum()
    # The coefficients of the windows as recorded, and their weighted distance to the rows of W weighted.
    g = w.sqrt() * plan.g
    W = torch.cat([reference.Up, reference.Yp, reference.Uf]) / w.sqrt()
    Yf = reference.Yf / w.sqrt()
    torch.testing.assert_close(Yf @ g, plan.y.reshape(-1))
    h = torch.linalg.lstsq(w.sqrt()[:, None] * W.T, plan.g, driver="gelsd").solution
    distance = ((g - w * (W.T @ h)).square() / w).sum()
    assert abs(distance - charged) < 1e-9 * charged
    # In the outputs: the departure from the weighted least-squares predictor, in the metric of its misses.
    predictor = torch.linalg.lstsq(w.sqrt()[:, None] * W.T, w.sqrt()[:, None] * Yf.T, driver="gelsd").solution.T
    misses = Yf - predictor @ W
    S = (w * misses) @ misses.T
    e = Yf @ g - predictor @ (W @ g)
    assert abs(e @ torch.linalg.solve(S, e) - charged) < 1e-7 * charged


def test_going_on_from_recorded_data():
    u, y = randn(90, 2), randn(90, 3, seed=1)
    parts = [(u[:40], y[:40]), (u[40:], y[40:])]
    both = dpc.HankelData.from_trajectories([u for u, _ in parts], [y for _, y in parts], **SIZES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dpc.ExcitationWarning)
        first = dpc.HankelData.from_trajectories(*parts[0], **SIZES)
    for start in (first, first.compressed()):
        stream = dpc.HankelStream.from_data(start)
        stream.append(*parts[1])
        assert stream.n_windows == both.n_g
        assert relative(gram(stream.data), gram(both)) < EXACT


def test_data_are_snapshots():
    u, y = randn(90, 2), randn(90, 3, seed=1)
    stream = dpc.HankelStream(**SIZES)
    stream.append(u[:60], y[:60])
    before = stream.data
    kept = stacked(before).clone()
    assert stream.data is before
    stream.append(u[60:], y[60:])
    after = stream.data
    assert torch.equal(stacked(before), kept) and not torch.equal(stacked(after), kept)
    stream.append(u[:1], y[:1])
    stream.new_recording()  # folds what waits
    assert stream.data is not after
    after = stream.data
    stream.append(u[:7], y[:7])  # no window yet: nothing new
    assert stream.data is after


def test_a_stream_survives_a_pickle():
    u, y = randn(90, 2), randn(90, 3, seed=1)
    stream = dpc.HankelStream(**SIZES, forgetting=0.9)
    stream.append(u[:50], y[:50])
    stream.data  # noqa: B018  some windows folded, some samples waiting
    stream.append(u[50:55], y[50:55])
    again = pickle.loads(pickle.dumps(stream))
    for held in (stream, again):
        held.append(u[55:], y[55:])
    assert again.n_windows == 83 and torch.equal(stacked(again.data), stacked(stream.data))


def test_a_layer_takes_new_data():
    u, y = masses(300, noise=1e-2)
    stream = dpc.HankelStream(**SIZES)
    stream.append(u[:150], y[:150])
    layer = dpc.DPCLayer(stream.data, **SMALL)
    window = windows(2, 3)
    old = layer(*window, y_ref=Y_REF).u
    stream.append(u[150:], y[150:])
    layer.data = stream.data
    fresh = dpc.DPCLayer(dpc.HankelData.from_trajectories(u, y, **SIZES), **SMALL)
    assert relative(layer(*window, y_ref=Y_REF).u, fresh(*window, y_ref=Y_REF).u) < SAME
    assert relative(layer(*window, y_ref=Y_REF).u, old) > 1e-4


# --- cost -------------------------------------------------------------------------------------------------------------


def test_an_update_at_the_quadrotor_size_is_quick():
    stream = dpc.HankelStream(t_ini=6, horizon=25, forgetting=0.999)
    u, y = randn(400, 3), randn(400, 6, seed=1)
    stream.append(u[:300], y[:300])
    assert len(stacked(stream.data)) == 279
    times = []
    for k in range(300, 400):
        began = time.perf_counter()
        stream.append(u[k], y[k])
        stream.data  # noqa: B018  the fold happens here
        times.append(time.perf_counter() - began)
    # The least of some medians: where other processes use up the machine, all calls of a while stand still.
    assert min(np.median(part) for part in np.split(np.array(times), 10)) < 5e-3


def test_memory_does_not_grow_with_the_stream():
    def samples(steps):
        for seed in range(steps // 1000):
            yield randn(1000, 2, seed=seed), randn(1000, 3, seed=seed + 1000)

    peaks = []
    for steps in (5_000, 50_000):
        tracemalloc.start()
        dpc.HankelData.from_stream(samples(steps), **SIZES)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.05 * peaks[0] + 20_000


# --- excitation and bad input -----------------------------------------------------------------------------------------


def test_too_little_excitation_warns_as_for_a_recording():
    u, y = torch.sin(0.3 * torch.arange(60.0, dtype=torch.float64))[:, None], randn(60, 3)
    said = []
    for make in (
        lambda: dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6),
        lambda: dpc.HankelData.from_stream(pieces(u, y, 7), t_ini=3, horizon=6),
    ):
        with pytest.warns(dpc.ExcitationWarning) as caught:
            make()
        assert caught[0].filename == __file__
        said.append(str(caught[0].message))
    assert said[0] == said[1]
    assert "of order 2, 9" in said[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dpc.HankelData.from_stream([(randn(60, 1), y)], t_ini=3, horizon=6)


def test_excitation_is_forgotten_too():
    stream = dpc.HankelStream(**SIZES, forgetting=0.5)
    assert stream.excitation_order == 0
    stream.append(randn(100, 1), randn(100, 1, seed=1))
    assert stream.excitation_order == 8
    stream.append(torch.ones(200, 1), randn(200, 1, seed=2))  # 0.5^100 of the weight is below the rank tolerance
    assert stream.excitation_order == 1


U, Y = randn(20, 2), randn(20, 3, seed=1)
WITH_NAN = Y.clone()
WITH_NAN[3, 1] = torch.nan


@pytest.mark.parametrize(
    ("chunks", "says"),
    [
        ([], r"t_ini \+ horizon = 8 samples"),
        ([(U[:7], Y[:7])], r"t_ini \+ horizon = 8 samples"),
        ([(U[:7], Y[:7]), None, (U[:7], Y[:7])], "no recording was that long"),
        ([(U, Y), U], r"item 1 of `chunks` must be a pair \(u, y\), or None.*Tensor"),
        ([(U, Y, Y)], "item 0 of `chunks` must be a pair"),
        ([(U, WITH_NAN)], "item 0 of `chunks`: `y` must be finite, got 1 NaN"),
        ([(U, Y), (U[:5], Y[:6])], "item 1 .*as long, got 5 and 6"),
        ([(U, Y), (U[:, :1], Y)], "must have 2 and 3 channels, as before, got 1 and 3"),
        ([(U.long(), Y)], "`u.*floating.*int64"),
        (5, "`chunks` must be an iterable of pairs .u, y., got int"),
        ([(U[None], Y[None])], r"`u` must have shape \(T, n\)"),
    ],
)
def test_bad_streams_are_named(chunks, says):
    with pytest.raises(ValueError, match=says):
        dpc.HankelData.from_stream(chunks, **SIZES)


def test_a_refused_chunk_leaves_the_stream_as_it_was():
    stream = dpc.HankelStream(**SIZES)
    stream.append(U, Y)
    before = stacked(stream.data).clone()
    with pytest.raises(ValueError, match="finite"):
        stream.append(U, WITH_NAN)
    assert stream.n_windows == 13 and torch.equal(stacked(stream.data), before)


@pytest.mark.parametrize("value", [0, 0.0, -0.5, 1.01, True, "1", None, float("nan")], ids=str)
def test_forgetting_must_be_a_share(value):
    with pytest.raises(ValueError, match=r"`forgetting` must be a number in \(0, 1\]"):
        dpc.HankelStream(**SIZES, forgetting=value)


@pytest.mark.parametrize("name", ["t_ini", "horizon"])
def test_lengths_must_be_positive_integers(name):
    with pytest.raises(ValueError, match=f"`{name}` must be a positive integer"):
        dpc.HankelData.from_stream([(U, Y)], **{**SIZES, name: 0})
