"""A `state_dict` makes a layer on another recording plan like the one that was saved, or fails."""

import io

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, small_data, small_layer, windows


def parameter(value):
    return torch.nn.Parameter(torch.as_tensor(value, dtype=torch.float64))


def plan(layer):
    return layer(*windows(3, 3, seed=1, scale=0.5), y_ref=Y_REF).u


MAKE = {
    "constants": lambda data: dpc.DPCLayer(data, **SMALL, u_set=dpc.Box(-0.3, 0.3), y_set=dpc.Ball(0.8)),
    "parameters": lambda data: dpc.DPCLayer(
        data, **{**SMALL, "lambda_g": parameter(2.0)}, u_set=dpc.Box(-0.3, parameter(0.2))
    ),
}


@pytest.mark.parametrize("case", MAKE)
def test_a_layer_on_another_recording_plans_alike_after_loading(case):
    saved, other = MAKE[case](small_data()), MAKE[case](small_data(seed=7))
    with torch.no_grad():
        for p in saved.parameters():
            p.mul_(1.1)
    assert not torch.allclose(plan(saved), plan(other))
    file = io.BytesIO()
    torch.save(torch.nn.Sequential(saved).state_dict(), file)
    file.seek(0)
    model = torch.nn.Sequential(other)
    model.load_state_dict(torch.load(file))
    assert torch.allclose(plan(other), plan(saved), rtol=0, atol=1e-12)
    assert all(isinstance(value, torch.Tensor) for value in model.state_dict().values())


def test_settings_and_sets_are_restored():
    saved = small_layer(u_set=dpc.Ball(0.4), lambda_u=3.0, regularizer="identity", on_failure="nan")
    other = small_layer()
    other.load_state_dict(saved.state_dict())
    assert torch.equal(plan(other), plan(saved))
    assert (other.on_failure, other.regularizer, other.lambda_u) == ("nan", "identity", 3.0)


def test_the_same_recording_keeps_its_windows():
    layer, other = small_layer(), small_layer(lambda_g=3.0)
    other.load_state_dict(layer.state_dict())
    assert other.data.has_windows and torch.equal(plan(other), plan(layer))


def test_what_does_not_fit_is_refused():
    layer = small_layer(u_set=dpc.Box(-1.0, parameter(0.5)))
    with pytest.raises(ValueError, match="`u_set` of the checkpoint is"):
        small_layer().load_state_dict(layer.state_dict())
    with pytest.raises(ValueError, match="`u_set` of the checkpoint is"):
        small_layer(u_set=dpc.Box(-2.0, parameter(0.5))).load_state_dict(layer.state_dict())
    state = layer.state_dict()
    state["_extra_state"] = state["_extra_state"][:100]
    with pytest.raises(ValueError, match="extra state of the layer is damaged"):
        layer.load_state_dict(state)


def test_a_batch_of_data_sets_must_be_the_same():
    batches = [dpc.HankelBatch([small_data(), small_data(seed=s)]) for s in (1, 1, 2)]
    one, same, other = (dpc.DPCLayer(data, **SMALL) for data in batches)
    same.load_state_dict(one.state_dict())
    with pytest.raises(ValueError, match="of a layer on other data"):
        other.load_state_dict(one.state_dict())
