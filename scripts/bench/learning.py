"""Variants of a planning problem, weights that learn or other sets, and a step of training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

import torch_dpc as dpc


def learning(layer: dpc.DPCLayer, **sets: Any) -> dpc.DPCLayer:
    """Return the same problem with Q, R, lambda_g and lambda_s as parameters."""

    def parameter(weight: Any, channels: int | None = None) -> nn.Parameter:
        tensor = torch.as_tensor(weight, dtype=torch.float64)
        whole = tensor * torch.eye(channels, dtype=torch.float64) if channels and tensor.ndim == 0 else tensor
        return nn.Parameter(whole.clone())

    return dpc.DPCLayer(
        layer.data,
        Q=parameter(layer.Q, layer.data.n_y),
        R=parameter(layer.R, layer.data.n_u),
        lambda_g=parameter(layer.lambda_g),
        lambda_s=parameter(layer.lambda_s),
        **{"u_set": layer.u_set, "y_set": layer.y_set, **sets},
    )


def with_sets(layer: dpc.DPCLayer, **sets: Any) -> dpc.DPCLayer:
    """Return the same problem in other sets."""
    weights = {"Q": layer.Q, "R": layer.R, "lambda_g": layer.lambda_g, "lambda_s": layer.lambda_s}
    return dpc.DPCLayer(layer.data, **weights, **{"u_set": layer.u_set, "y_set": layer.y_set, **sets})


def step_of(layer: dpc.DPCLayer, inputs: dict[str, torch.Tensor]) -> Callable[[], None]:
    """Return one step of training."""
    parameters = list(layer.parameters())
    # Weights of zero must not turn negative: the steps are as long as any others, and go nowhere.
    optimiser = torch.optim.Adam(parameters, lr=1e-12) if parameters else None
    y_ini = inputs["y_ini"].clone().requires_grad_()

    def step() -> None:
        layer(**{**inputs, "y_ini": y_ini}).u.square().sum().backward()
        if optimiser is not None:
            optimiser.step()
            optimiser.zero_grad()

    return step
