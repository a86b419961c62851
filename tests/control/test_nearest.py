"""Plans from the recorded windows nearest to the present one."""

import functools

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import generator, randn, relative, small_layer
from torch_dpc.systems import CartPole

SAME = 1e-9  # a batch of small problems and one of them round differently
DT = 0.05


@functools.cache
def recording():
    """60 short runs from angles up to 1 rad, under a clumsy feedback and random forces."""
    source = generator()
    starts = torch.randn(60, 4, dtype=torch.float64, generator=source) * torch.tensor([0.5, 0.5, 0.0, 1.0])
    starts[:, 2] = 2 * torch.rand(60, dtype=torch.float64, generator=source) - 1
    gain = torch.tensor([1.0, 2.0, 30.0, 6.0], dtype=torch.float64)
    return dpc.collect(
        CartPole(dt=DT), 50, generator=source, amplitude=5.0, reset={"state": starts},
        feedback=lambda y: (y @ gain).clamp(-12.0, 12.0)[:, None],
    )  # fmt: skip


@functools.cache
def layer(**options):
    u, y = recording()
    data = dpc.HankelData.from_trajectories(list(u), list(y), t_ini=2, horizon=15)
    weights = {"Q": torch.diag(torch.tensor([2.0, 0.1, 20.0, 0.1])), "R": 0.005, "lambda_g": 100.0, "lambda_s": 1e4}
    return dpc.DPCLayer(data, **weights, u_set=dpc.Box(-15.0, 15.0), regularizer="identity", affine=True, **options)


def windows(n=3):
    return 0.5 * randn(n, 2, 1), 0.2 * randn(n, 2, 4, seed=1)


def nearest_by_hand(u_ini, y_ini, plan=None):
    """The columns in order of their distance, each channel in units of its deviation over all windows."""
    d = layer().data
    parts = [(d.Up, u_ini, 1), (d.Yp, y_ini, 4)] + ([] if plan is None else [(d.Uf, plan.u, 1), (d.Yf, plan.y, 4)])
    deviation = {
        n: np.concatenate([m.numpy().reshape(-1, n, d.n_g) for m in pair]).transpose(1, 0, 2).reshape(n, -1).std(1)
        for n, pair in ((1, (d.Up, d.Uf)), (4, (d.Yp, d.Yf)))
    }
    distance = np.zeros(d.n_g)
    for matrix, values, n in parts:
        difference = matrix.numpy().reshape(-1, n, d.n_g) - values.numpy()[:, :, None]
        distance += ((difference / deviation[n][None, :, None]) ** 2).sum((0, 1))
    return np.argsort(distance)


def on_columns(columns):
    d = layer().data
    part = dpc.HankelData(*(m[:, columns] for m in (d.Up, d.Uf, d.Yp, d.Yf)), 2, 15, 1, 4)
    return dpc.DPCLayer(part, **layer().config())


def test_the_plan_is_that_of_a_layer_on_the_nearest_windows():
    u_ini, y_ini = (w[0] for w in windows())
    once = on_columns(np.sort(nearest_by_hand(u_ini, y_ini)[:80]))(u_ini, y_ini)
    twice = on_columns(np.sort(nearest_by_hand(u_ini, y_ini, once)[:80]))(u_ini, y_ini)
    for rounds, expected in ((1, once), (2, twice)):
        plan = dpc.NearestWindows(layer(), 80, rounds=rounds)(u_ini, y_ini)
        assert relative(plan.u, expected.u) < SAME and relative(plan.g, expected.g) < SAME
    assert relative(twice.u, once.u) > 1e-3


def test_all_windows_are_the_plan_of_the_layer():
    u_ini, y_ini = windows()
    plan = dpc.NearestWindows(layer(), layer().data.n_g)(u_ini, y_ini)
    assert relative(plan.u, layer()(u_ini, y_ini).u) < SAME


def test_a_batch_is_one_batch_of_small_problems():
    planner, (u_ini, y_ini) = dpc.NearestWindows(layer(), 60), windows()
    y_ref = 0.1 * randn(3, 15, 4, seed=2)
    together = planner(u_ini, y_ini, y_ref=y_ref)
    for i in range(3):
        assert relative(together.u[i], planner(u_ini[i], y_ini[i], y_ref=y_ref[i]).u) < SAME


def test_plans_are_differentiable():
    planner, (u_ini, y_ini) = dpc.NearestWindows(layer(), 60), (w[0] for w in windows())
    y_ini.requires_grad_()
    (gradient,) = torch.autograd.grad(planner(u_ini, y_ini).u[0].sum(), y_ini)
    change = 1e-6 * randn(2, 4, seed=5)
    with torch.no_grad():
        ahead, behind = (planner(u_ini, y_ini + s * change).u[0].sum() for s in (1, -1))
    assert float((gradient * change).sum()) == pytest.approx(float(ahead - behind) / 2, rel=1e-5)


def test_the_pole_stands_where_all_data_let_it_fall():
    """The best of the paper's form is linear, and windows from 1 rad away are not: it lets the pole fall."""
    starts = torch.tensor([[0.0, 0.0, 0.2, 0.0], [0.0, 0.0, 0.5, 0.0], [0.5, 0.0, -0.4, 0.0]], dtype=torch.float64)
    largest, last = {}, {}
    for name, planner in {"all": layer(), "nearest": dpc.NearestWindows(layer(), 100, rounds=1)}.items():
        log = dpc.simulate(
            CartPole(dt=DT), dpc.DPCController(planner, 1), torch.zeros(4), steps=50, reset={"state": starts}
        )
        largest[name], last[name] = log.y[..., 2].abs().amax(-1), log.y[:, -1, 2].abs()
    assert (largest["nearest"] < 0.7).all() and (last["nearest"] < 0.1).all()
    assert (largest["all"] > 3.0).all()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: dpc.NearestWindows(layer(), 0), "`k` must be a positive integer"),
        (lambda: dpc.NearestWindows(layer(), 10**6), "`k` must be at most the number of recorded windows, 2040"),
        (lambda: dpc.NearestWindows(layer(), 5, rounds=0), "`rounds` must be a positive integer"),
        (lambda: dpc.NearestWindows(layer(), 5)(torch.zeros(1, 1), torch.zeros(2, 4)), "`u_ini` must have shape"),
        (
            lambda: dpc.NearestWindows(layer(), 5)(torch.zeros(2, 3, 2, 1), torch.zeros(2, 3, 2, 4)),
            r"at most one batch dimension, got \(2, 3\)",
        ),
        (
            lambda: dpc.NearestWindows(dpc.DPCLayer(small_layer().data.compressed(), 1.0, 1.0, 1.0, 1e3), 5),
            "`layer` must hold the recorded windows",
        ),
        (
            lambda: dpc.DPCController(dpc.NearestWindows(layer(), 50), 1, on_failure="soften"),
            '`on_failure="soften"` needs a DPCLayer, got NearestWindows',
        ),
    ],
    ids=["k", "too many", "rounds", "shape", "batch", "compact", "soften"],
)
def test_what_does_not_fit_is_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()
