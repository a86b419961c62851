"""The predictor of recorded data: an affine plant is predicted from the data of an affine layer, through a file too."""

import torch

import torch_dpc as dpc
from helpers import generator


def affine_plant(u, y0=2.0):
    """y+ = 0.8 y + u + 1, from y0."""
    y = [torch.full((1,), y0, dtype=torch.float64)]
    for applied in u[:-1]:
        y.append(0.8 * y[-1] + applied + 1.0)
    return torch.stack(y)


def test_the_data_of_an_affine_layer_predict_an_affine_plant(tmp_path):
    u = torch.rand(60, 1, dtype=torch.float64, generator=generator())
    data = dpc.HankelData.from_trajectories(u, affine_plant(u), t_ini=2, horizon=5)
    layer = dpc.DPCLayer(data, 1.0, 0.1, 1.0, 1e4, affine=True)
    layer.save(tmp_path / "layer.safetensors")
    loaded = dpc.DPCLayer.load(tmp_path / "layer.safetensors").data
    assert loaded.has_ones
    fresh = torch.rand(7, 1, dtype=torch.float64, generator=generator(1))
    y = affine_plant(fresh, y0=-3.0)
    predicted = dpc.attacks.Predictor(loaded)(fresh[:2], y[:2], fresh[2:])
    assert (predicted - y[2:]).abs().max() < 1e-9
