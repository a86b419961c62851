"""How strongly a plan depends on the measured outputs, and what noise and ridges in the recorded data change."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torch_dpc as dpc
from torch_dpc import tuning

NOISE_SEED = 7000  # the noise of a recording of seed s is drawn from NOISE_SEED + s


def plan_gain(layer: dpc.DPCLayer) -> float:
    """Return max |u(y_ini + p) - u(y_ini)| / |p| of the plan without its bounds, the spectral norm of du / dy_ini."""
    return float(tuning.plan_gain(layer))


def with_noise(y: Tensor, size: float, seed: int) -> Tensor:
    """Return recorded outputs `(T, n_y)` with noise of standard deviation size x that of each output."""
    generator = torch.Generator().manual_seed(NOISE_SEED + seed)
    return y + size * y.std(0) * torch.randn(y.shape, dtype=y.dtype, generator=generator)


def unexplained(data: dpc.HankelData, y: Tensor) -> Tensor:
    """Return the root mean squares of what the inputs do not explain of the past outputs, direction by direction.

    The singular values of Yp, each output divided by its standard deviation, less its projection on the rows of Up and
    Uf, over sqrt(n_g). A direction below the noise of a recording cannot be seen in it.

    Returns:
        `(t_ini n_y,)`, falling.
    """
    inputs = torch.linalg.qr(torch.cat([data.Up, data.Uf]).mT).Q
    outputs = data.Yp / y.std(0).repeat(data.t_ini)[:, None]
    return torch.linalg.svdvals(outputs - (outputs @ inputs) @ inputs.mT) / math.sqrt(data.n_g)
