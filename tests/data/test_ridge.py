"""A ridge on the past outputs: exact in D D', differentiable, and kept wherever data go."""

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, central, generator, randn, relative, windows

ROUNDING = 1e-12
PLANS = 1e-9
SIZE = 0.1


def recording():
    return dpc.collect(dpc.systems.OscillatingMasses(), 80, generator=generator())


def ridged(u, y, **options):
    return dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6, **options)


def inputs():
    u_ini, y_ini = windows(3, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(3, 3, 4, seed=2)


def test_it_adds_the_expectation_of_noise_to_the_past_outputs_alone():
    u, y = recording()
    clean, data = ridged(u, y), ridged(u, y, ridge=SIZE)
    added = data.stacked @ data.stacked.mT - clean.stacked @ clean.stacked.mT
    expected = torch.zeros(len(added), dtype=torch.float64)
    expected[6:18] = clean.n_windows * (SIZE * y.std(0)).square().repeat(3)  # Yp, after 3 x 2 rows of Up
    assert relative(added, torch.diag(expected)) < ROUNDING * 10
    assert (data.n_windows, data.n_g, data.n_ridge) == (clean.n_g, clean.n_g + 12, 12)
    assert "12 of a ridge" in repr(data) and data.rank > clean.rank
    same = clean.with_ridge(SIZE * y.std(0))
    assert all(torch.equal(a, b) for a, b in zip(same.matrices, data.matrices, strict=True))
    assert ridged(u, y, ridge=0.0).n_ridge == 0


def test_noise_in_many_recordings_adds_the_same_on_average():
    u, y = recording()
    clean = ridged(u, y).stacked
    n, deviation = 400, SIZE * y.std(0)
    total = torch.zeros(12, 12, dtype=torch.float64)
    for seed in range(n):
        Yp = ridged(u, y + deviation * randn(*y.shape, seed=seed)).Yp
        total += Yp @ Yp.mT / n
    added = total - clean[6:18] @ clean[6:18].mT
    size = ridged(u, y).n_windows * deviation.square().repeat(3)
    assert float((added / size.sqrt().outer(size.sqrt()) - torch.eye(12)).abs().max()) < 0.3


def test_channels_have_ridges_of_their_own_and_recordings_share_one():
    u, y = recording()
    sizes = torch.tensor([0.1, 0.0, 0.2, 0.3], dtype=torch.float64)
    data = ridged([u, u[:40]], [y, y[:40]], ridge=sizes)
    spread = torch.cat([y, y[:40]]).std(0)
    diagonal = data.Yp[:, data.n_windows :].diagonal()
    assert relative(diagonal, (data.n_windows**0.5 * sizes * spread).repeat(3)) < ROUNDING


@pytest.mark.parametrize("options", [{}, {"affine": True}, {"regularizer": "gamma", "beta_2": 2.0}])
def test_plans_are_those_of_the_columns_written_out(options):
    u, y = recording()
    data, (u_ini, y_ini) = ridged(u, y, ridge=SIZE), inputs()
    plan = dpc.DPCLayer(data, **SMALL, u_set=dpc.Box(-0.4, 0.4), **options)(u_ini, y_ini, y_ref=Y_REF)
    Up, Uf, Yp, Yf = data.Up, data.Uf, data.Yp, data.Yf
    if options.get("affine"):  # the weights of the windows sum to one, those of the ridge are free
        assert float((plan.g[:, : data.n_windows].sum(-1) - 1).abs().max()) < PLANS
    for name, rows, value in (("u", Uf, plan.u), ("y", Yf, plan.y), ("u_ini", Up, u_ini)):
        assert relative(plan.g @ rows.mT, value.flatten(-2)) < PLANS, name
    assert relative((plan.g @ Yp.mT).reshape(3, 3, 4) - y_ini, plan.slack) < 1e-6
    plain = dpc.DPCLayer(ridged(u, y), **SMALL, u_set=dpc.Box(-0.4, 0.4), **options)(u_ini, y_ini, y_ref=Y_REF)
    assert relative(plan.u, plain.u) > 1e-2


@pytest.mark.parametrize("which", ["ridge", "y"])
def test_gradients_are_those_of_differences(which):
    u, y = recording()
    u_ini, y_ini = inputs()
    y = y + 1e-2 * randn(*y.shape, seed=3)  # differences move the rank of noise-free data
    value = torch.full((4,), SIZE, dtype=torch.float64) if which == "ridge" else y

    def scalar(x):
        data = ridged(u, y, ridge=x) if which == "ridge" else ridged(u, x, ridge=SIZE)
        layer = dpc.DPCLayer(data, **SMALL, u_set=dpc.Box(-0.4, 0.4))
        return (layer(u_ini, y_ini, y_ref=Y_REF).u * randn(3, 6, 2, seed=5)).sum()

    x = value.clone().requires_grad_()
    scalar(x).backward()
    assert relative(x.grad, central(scalar, value, 1e-6)) < 1e-5


@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("with_data", [False, True])
def test_it_is_saved_with_the_data(tmp_path, affine, with_data):
    pytest.importorskip("safetensors", reason="files of layers need safetensors: pip install '.[save]'")
    layer = dpc.DPCLayer(ridged(*recording(), ridge=SIZE), **SMALL, affine=affine)
    layer.save(tmp_path / "layer.safetensors", data=with_data)
    other = dpc.DPCLayer(ridged(*recording()), **SMALL, affine=affine)
    other.load_state_dict(layer.state_dict())
    for copy in (dpc.DPCLayer.load(tmp_path / "layer.safetensors"), other):
        assert relative(copy(*inputs(), y_ref=Y_REF).u, layer(*inputs(), y_ref=Y_REF).u) < PLANS
        assert copy.data.n_windows == layer.data.n_windows
    if with_data:
        assert dpc.DPCLayer.load(tmp_path / "layer.safetensors").data.n_ridge == 12


def test_compact_data_and_csv_files_take_it(tmp_path):
    u, y = recording()
    data = ridged(u, y, ridge=SIZE)
    stream = dpc.HankelData.from_stream([(u, y)], t_ini=3, horizon=6).with_ridge(SIZE * y.std(0))
    compact = data.compressed()
    rows = ["u1,u2,y1,y2,y3,y4"] + [",".join(map(repr, row)) for row in torch.cat([u, y], 1).tolist()]
    (tmp_path / "run.csv").write_text("\n".join(rows))
    names = {"inputs": ["u1", "u2"], "outputs": ["y1", "y2", "y3", "y4"]}
    file = dpc.HankelData.from_csv(tmp_path / "run.csv", **names, t_ini=3, horizon=6, ridge=SIZE)
    expected = dpc.DPCLayer(data, **SMALL)(*inputs(), y_ref=Y_REF).u
    for other in (stream, compact, file):
        assert other.n_windows == data.n_windows
        assert relative(dpc.DPCLayer(other, **SMALL)(*inputs(), y_ref=Y_REF).u, expected) < PLANS


def test_nearest_windows_keep_the_ridge_and_choose_windows_alone():
    u, y = recording()
    layer = dpc.DPCLayer(ridged(u, y, ridge=SIZE), **SMALL, affine=True)
    planner = dpc.NearestWindows(layer, k=40, rounds=1)
    plan = planner(*inputs(), y_ref=Y_REF)
    assert plan.g.shape == (3, 40 + 12)
    assert float((plan.g[:, :40].sum(-1) - 1).abs().max()) < PLANS
    all_of_them = dpc.NearestWindows(layer, k=layer.data.n_windows, rounds=1)(*inputs(), y_ref=Y_REF)
    assert relative(all_of_them.u, layer(*inputs(), y_ref=Y_REF).u) < PLANS
    with pytest.raises(ValueError, match="at most the number of recorded windows, 72"):
        dpc.NearestWindows(layer, k=73)


@pytest.mark.parametrize("ridge", [-0.1, float("nan"), torch.ones(3), "large"])
def test_bad_ridges_are_named(ridge):
    with pytest.raises(ValueError, match="`ridge` must be a number or"):
        ridged(*recording(), ridge=ridge)
