"""Layers on disk: what comes back is what was saved, files are small, and bad files are refused in words."""

import copy
import inspect
import json
import sys

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, PAPER, SMALL, Y_REF, masses_data, paper_layer, randn, small_data, small_layer, windows
from torch_dpc.sets.registry import known_sets

safetensors = pytest.importorskip("safetensors.torch", reason="saving needs safetensors")


def saved(layer, tmp_path, **options):
    layer.save(tmp_path / "layer.safetensors", **options)
    return dpc.DPCLayer.load(tmp_path / "layer.safetensors")


def plan(layer, n=4):
    return layer(*windows(n, layer.data.t_ini), y_ref=Y_REF, u_ref=HOLDING)


# --- what comes back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_plans_come_back_bit_by_bit(noise, tmp_path):
    layer = paper_layer(noise)
    back = saved(layer, tmp_path)
    ours, theirs = plan(back), plan(layer)
    assert int(theirs.info.n_active.sum()) > 0
    for name in ("u", "y", "lam"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name))
    assert (back.data.rank, back.data.n_windows, back.data.has_windows) == (layer.data.rank, 500, False)
    assert back.data.row_space.clear == layer.data.row_space.clear
    with pytest.raises(ValueError, match="of 500 windows only the factor is kept"):
        ours.g  # noqa: B018


def test_windows_come_along_when_asked_for(tmp_path):
    layer = paper_layer(1e-2)
    back = saved(layer, tmp_path, data=True)
    for name in ("Up", "Uf", "Yp", "Yf"):
        assert torch.equal(getattr(back.data, name), getattr(layer.data, name))
    ours, theirs = plan(back), plan(layer)
    for name in ("u", "y", "g"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-12, atol=1e-12)


def test_compact_data_have_no_windows_to_save(tmp_path):
    layer = dpc.DPCLayer(small_data().compressed(), **SMALL)
    with pytest.raises(ValueError, match="compact"):
        layer.save(tmp_path / "layer.safetensors", data=True)
    assert torch.equal(plan(saved(layer, tmp_path)).u, plan(layer).u)


def test_data_of_a_stream(tmp_path):
    stream = dpc.HankelStream(t_ini=3, horizon=6, forgetting=0.99)
    stream.append(randn(200, 2), randn(200, 4, seed=1))
    layer = dpc.DPCLayer(stream.data, **SMALL)
    back = saved(layer, tmp_path)
    assert torch.equal(plan(back).u, plan(layer).u)
    assert back.data.n_windows == 192


def test_single_precision_recordings_keep_their_rank(tmp_path):
    u, y = randn(100, 1).float(), randn(100, 1, seed=1).float()
    data = dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6)
    for whole in (False, True):
        back = saved(dpc.DPCLayer(data, **SMALL), tmp_path, data=whole).data
        assert back.rank_tolerance == data.rank_tolerance == 1e-5
        assert back.rank == data.rank


def test_what_was_a_number_a_tensor_or_a_parameter_is_one_again(tmp_path):
    R = torch.eye(2, dtype=torch.float32)
    layer = dpc.DPCLayer(
        small_data(),
        Q=torch.nn.Parameter(torch.tensor(3.0)),
        R=R,
        lambda_g=2,
        lambda_s=np.float64(1e3),
        u_set=dpc.Box(torch.nn.Parameter(torch.tensor([-0.5, -0.25])), np.array([0.5, np.inf])),
        y_set=dpc.Box(-np.inf, torch.full((6, 4), 9.0, dtype=torch.float64)),
        backward="full",
        solver="newton",
        on_failure="nan",
    )
    back = saved(layer, tmp_path)
    assert isinstance(back.Q, torch.nn.Parameter) and back.Q == 3.0 and back.Q.dtype == torch.float32
    assert type(back.R) is torch.Tensor and torch.equal(back.R, R) and back.R.dtype == R.dtype
    assert type(back.lambda_g) is int and back.lambda_g == 2
    assert type(back.lambda_s) is float and back.lambda_s == 1e3
    assert {name for name, _ in back.named_parameters()} == {name for name, _ in layer.named_parameters()}
    assert torch.equal(back.u_set.lower, layer.u_set.lower) and torch.equal(back.u_set.upper, layer.u_set.upper)
    assert back.y_set.lower == -np.inf and torch.equal(back.y_set.upper, layer.y_set.upper)
    assert (back.backward_system, back.solver, back.on_failure) == ("full", "newton", "nan")
    assert type(saved(dpc.DPCLayer(small_data(), **SMALL), tmp_path).u_set) is dpc.Reals


def test_trained_weights_frozen_ones_and_shared_ones(tmp_path):
    bound = torch.nn.Parameter(torch.tensor(0.5))
    layer = small_layer(
        Q=torch.nn.Parameter(torch.eye(4), requires_grad=False),
        R=torch.eye(2).requires_grad_(),
        lambda_g=torch.tensor(1.0, requires_grad=True) * 2,
        u_set=dpc.Box(-1.0, bound),
        y_set=dpc.Box(-30.0, bound),
    )
    back = saved(layer, tmp_path)
    assert isinstance(back.Q, torch.nn.Parameter) and not back.Q.requires_grad
    assert back.R.is_leaf and back.R.requires_grad
    assert back.lambda_g == 2.0 and not back.lambda_g.requires_grad  # of a graph, the value
    assert back.u_set.upper is back.y_set.upper and back.u_set.upper.requires_grad
    plan(back).u.sum().backward()
    plan(layer).u.sum().backward()
    assert torch.equal(back.R.grad, layer.R.grad)
    with torch.no_grad():
        bound -= 0.2
    assert torch.equal(plan(saved(layer, tmp_path)).u, plan(layer).u)


def test_every_argument_of_the_layer_is_saved():
    arguments = set(inspect.signature(dpc.DPCLayer).parameters) - {"data"}
    assert arguments == set(small_layer().config())


def test_batched_weights(tmp_path):
    layer = small_layer(lambda_g=torch.tensor([1.0, 10.0, 100.0, 0.1], dtype=torch.float64))
    assert torch.equal(plan(saved(layer, tmp_path)).u, plan(layer).u)


def test_files_are_the_same_byte_by_byte(tmp_path):
    layer, files = small_layer(), [tmp_path / "a", tmp_path / "b"]
    layer.save(files[0])
    copy.deepcopy(layer).save(str(files[1]))
    assert files[0].read_bytes() == files[1].read_bytes()


def test_a_file_does_not_grow_with_the_number_of_windows(tmp_path):
    sizes = []
    for n_g in (500, 5000):
        data = masses_data(1e-2, steps=n_g + 30)
        dpc.DPCLayer(data, **PAPER).save(tmp_path / "layer")
        sizes.append((tmp_path / "layer").stat().st_size)
    assert data.n_g == 5000
    assert abs(sizes[1] - sizes[0]) < 64  # digits of n_g and the like
    assert sizes[1] < 186 * 186 * 8 + 4000


# --- sets -------------------------------------------------------------------------------------------------------------


#: One of each set of the package, with every argument given.
PACKAGE_SETS = {
    "Box": lambda: dpc.Box(-0.5, torch.nn.Parameter(torch.tensor([0.5, 1.0]))),
    "Reals": lambda: dpc.Reals(),
    "NonNegative": lambda: dpc.NonNegative(),
    "SoftBox": lambda: dpc.SoftBox(-0.5, torch.tensor([0.5, 1.0]), weight=torch.nn.Parameter(torch.tensor(30.0))),
    "Ball": lambda: dpc.Ball(torch.nn.Parameter(torch.tensor(0.6)), torch.full((6, 2), 0.1), per="trajectory"),
    "SecondOrderCone": lambda: dpc.SecondOrderCone(per="trajectory"),
    "Product": lambda: dpc.Product([(dpc.NonNegative(), 1), (dpc.Box(-0.5, torch.tensor(0.5)), [0])]),
}


@pytest.mark.parametrize(
    "name", sorted(name for name, cls in known_sets().items() if cls.__module__.startswith("torch_dpc."))
)
def test_sets_of_the_package(name, tmp_path):
    layer = small_layer(u_set=PACKAGE_SETS[name]())
    back = saved(layer, tmp_path)
    assert type(back.u_set) is type(layer.u_set)
    assert [n for n, _ in back.named_parameters()] == [n for n, _ in layer.named_parameters()]
    x = 2 * randn(7, 12 if getattr(layer.u_set, "per", "step") == "trajectory" else 2)
    assert torch.equal(back.u_set.project(x), layer.u_set.project(x))
    assert torch.equal(plan(back).u, plan(layer).u)


class Tube(dpc.Box):
    """A user's set: settings and a set within."""

    def __init__(self, inner, names, shrink=1.0):
        super().__init__(shrink * inner.lower, shrink * inner.upper)
        self.inner, self.names, self.shrink = inner, names, shrink


class Shy(dpc.Box):
    """Keeps its argument under another name."""

    def __init__(self, radius):
        super().__init__(-radius, radius)


@pytest.fixture
def registry(monkeypatch):
    from torch_dpc.sets import registry

    monkeypatch.setattr(registry, "_registered", {})


def test_a_set_of_ones_own(tmp_path, registry):
    layer = small_layer(u_set=Tube(dpc.Box(-1.0, torch.tensor([1.0, 2.0])), ["left", "right"], shrink=0.5))
    with pytest.raises(ValueError, match=r"`u_set` is a Tube.*torch_dpc.register_set\(Tube\)"):
        layer.save(tmp_path / "layer.safetensors")
    assert dpc.register_set(Tube) is Tube
    back = saved(layer, tmp_path)
    assert type(back.u_set) is Tube and back.u_set.names == ["left", "right"] and back.u_set.shrink == 0.5
    assert torch.equal(back.u_set.inner.upper, torch.tensor([1.0, 2.0]))
    assert torch.equal(plan(back).u, plan(layer).u)


def test_a_set_that_is_not_known_where_it_is_loaded(tmp_path, registry, monkeypatch):
    dpc.register_set(Tube)
    small_layer(u_set=Tube(dpc.Box(-1.0, 1.0), [])).save(tmp_path / "layer")
    monkeypatch.setattr("torch_dpc.sets.registry._registered", {})
    with pytest.raises(ValueError, match="holds a set 'Tube' that is not known: call torch_dpc.register_set"):
        dpc.DPCLayer.load(tmp_path / "layer")


def test_sets_say_how_they_are_written(tmp_path, registry):
    dpc.register_set(Shy)
    with pytest.raises(ValueError, match="Shy cannot be saved: it has no attribute 'radius'.*config"):
        small_layer(u_set=Shy(0.5)).save(tmp_path / "layer")
    Shy.config = lambda self: {"radius": self.upper}
    try:
        assert saved(small_layer(u_set=Shy(0.5)), tmp_path).u_set.lower == -0.5
    finally:
        del Shy.config


def test_what_may_be_registered(registry):
    with pytest.raises(ValueError, match="subclass of ConvexSet"):
        dpc.register_set(dict)
    with pytest.raises(ValueError, match="'Box' is taken by torch_dpc.sets.box.Box"):
        dpc.register_set(type("Box", (dpc.ConvexSet,), {}))
    dpc.register_set(Tube)
    dpc.register_set(Tube)  # a cell of a notebook runs twice


def test_what_cannot_be_written_is_named(tmp_path, registry):
    dpc.register_set(Tube)
    with pytest.raises(ValueError, match=r"`u_set`.names\[1\] is a complex"):
        small_layer(u_set=Tube(dpc.Box(-1.0, 1.0), ["a", 1j])).save(tmp_path / "layer")


@pytest.mark.parametrize("grad", [True, False])
def test_of_what_is_parametrised_the_present_value_is_saved(tmp_path, grad):
    number = lambda value: torch.nn.Parameter(torch.tensor(value, dtype=torch.float64))  # noqa: E731
    layer = small_layer(lambda_g=number(3.0), u_set=dpc.Ball(number(0.4)), y_set=dpc.SoftBox(-9.0, number(9.0), 2.0))
    for owner, name in ((layer, "lambda_g"), (layer.u_set, "radius"), (layer.y_set.box, "upper")):
        torch.nn.utils.parametrize.register_parametrization(owner, name, Exponential())
    with torch.set_grad_enabled(grad):
        back = saved(layer, tmp_path)
    assert type(back) is dpc.DPCLayer and type(back.u_set) is dpc.Ball and not list(back.parameters())
    for found, wanted in ((back.lambda_g, 3.0), (back.u_set.radius, 0.4), (back.y_set.box.upper, 9.0)):
        assert type(found) is torch.Tensor and not found.requires_grad
        torch.testing.assert_close(float(found), wanted)
    assert torch.equal(plan(back).u, plan(layer).u)


class Exponential(torch.nn.Module):
    def forward(self, log):
        return log.exp()

    def right_inverse(self, value):
        return value.log()


def test_a_parametrised_set_of_ones_own_is_named_by_its_class(tmp_path, registry):
    layer = small_layer(u_set=Tube(dpc.Box(-1.0, 1.0), []))
    layer.u_set.upper = torch.nn.Parameter(torch.tensor(0.5))
    torch.nn.utils.parametrize.register_parametrization(layer.u_set, "upper", Exponential())
    with pytest.raises(ValueError, match=r"register_set\(Tube\)"):
        layer.save(tmp_path / "layer")


@pytest.mark.parametrize("where", ["nowhere/layer", "."])
def test_a_place_that_cannot_be_written_is_named(tmp_path, where):
    with pytest.raises(OSError, match="cannot be written"):
        small_layer().save(tmp_path / where)


def test_settings_that_do_not_go_together_are_not_written(tmp_path):
    layer = small_layer(solver="daqp")
    layer.u_set = dpc.Ball(1.0)
    with pytest.raises(ValueError, match="sets that are boxes"):
        layer.save(tmp_path / "layer")
    assert not (tmp_path / "layer").exists()


def test_counts_of_numpy_are_saved(tmp_path):
    u, y = randn(60, 1), randn(60, 1, seed=1)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=np.int64(2), horizon=np.int32(4))
    back = saved(dpc.DPCLayer(data, **SMALL, terminal_steps=np.int64(1)), tmp_path)
    assert (back.data.t_ini, back.data.horizon, back.terminal_steps) == (2, 4, 1)
    stream = dpc.HankelStream(t_ini=np.int64(2), horizon=np.int64(4))
    stream.append(u, y)
    assert saved(dpc.DPCLayer(stream.data, **SMALL), tmp_path).data.t_ini == 2


# --- bad files --------------------------------------------------------------------------------------------------------


def rewritten(path, change_text=lambda text: text, change_tensors=lambda tensors: tensors):
    """Write a file anew with other contents, without a checksum, as files of earlier versions are."""
    with safetensors.safe_open(path, framework="pt") as file:
        text = json.loads(file.metadata()["torch_dpc"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    text, tensors = change_text(without("sha256")(text)), change_tensors(tensors)
    safetensors.save_file(tensors, path, metadata={"torch_dpc": json.dumps(text)})


def without(name):
    return lambda entries: {key: value for key, value in entries.items() if key != name}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"change_text": lambda t: {**t, "version": 2}}, "version 2 of the format, this torch_dpc reads version 1"),
        ({"change_text": without("version")}, "version None"),
        ({"change_text": without("data")}, "not a whole torch_dpc file: KeyError.'data'"),
        ({"change_text": lambda t: []}, "not one that `DPCLayer.save` wrote"),
        ({"change_text": lambda t: {**t, "arguments": {**t["arguments"], "new": 1}}}, "not a whole.*'new'"),
        ({"change_text": lambda t: {**t, "data": {**t["data"], "horizon": 7}}}, r"damaged: Uf has shape \(12, 54\)"),
        ({"change_text": lambda t: {**t, "data": {**t["data"], "recorded_as": "load"}}}, "'load' is no precision"),
        ({"change_tensors": without("data.Yf")}, "not a whole.*data.Yf"),
        ({"change_tensors": lambda t: {**t, "data.Yp": t["data.Yp"][:, 1:].clone()}}, "damaged: Yp"),
        ({"change_text": lambda t: {**t, "arguments": {**t["arguments"], "Q": -1.0}}}, "`Q` must be positive semidef"),
    ],
)
def test_damaged_files_are_refused(change, says, tmp_path):
    path = tmp_path / "layer"
    small_layer().save(path)
    rewritten(path, **change)
    with pytest.raises(ValueError, match=says):
        dpc.DPCLayer.load(path)


def test_files_that_are_something_else(tmp_path):
    path = tmp_path / "layer"
    small_layer().save(path)
    whole = path.read_bytes()
    for content in (whole[:-8], whole[:100], b"", b"not a tensor in sight"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="not a whole safetensors file"):
            dpc.DPCLayer.load(path)
    safetensors.save_file({"x": torch.ones(2)}, path)
    with pytest.raises(ValueError, match="not one that `DPCLayer.save` wrote"):
        dpc.DPCLayer.load(path)
    safetensors.save_file({"x": torch.ones(2)}, path, metadata={"torch_dpc": "{"})
    with pytest.raises(ValueError, match="damaged header"):
        dpc.DPCLayer.load(path)
    with pytest.raises(FileNotFoundError):
        dpc.DPCLayer.load(tmp_path / "nowhere")


def test_without_safetensors_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors.torch", None)
    with pytest.raises(ImportError, match="torch_dpc.save."):
        small_layer().save(tmp_path / "layer")
