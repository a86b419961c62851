"""The unknowns of the tuning: logarithms of the factors on a layer's weights."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from ..checks import check_type
from ..layer import DPCLayer
from ..problem.weights import as_weight


class WeightScales(nn.Module):
    """Logarithms of the factors on a layer's weights; at zero they are what they were.

        lambda_g <- lambda_g e^(s_g),  lambda_s <- lambda_s e^(s_s),  Q <- D Q D,  D = diag(e^(s_Q / 2)),  R likewise,

    so a diagonal Q has its entries scaled, one factor a channel, and any Q stays positive semidefinite; what is zero
    stays zero. The mean of s_R over the channels that R charges (of s_Q, if R charges none) is subtracted from all.

    Args:
        layer: whose weights are scaled; one problem, no batch of weights.
    """

    def __init__(self, layer: DPCLayer):
        super().__init__()
        check_type("layer", layer, DPCLayer)
        data = layer.data
        self.lambda_g = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.lambda_s = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.Q = nn.Parameter(torch.zeros(data.n_y, dtype=torch.float64))
        self.R = nn.Parameter(torch.zeros(data.n_u, dtype=torch.float64))

    def forward(self, layer: DPCLayer) -> dict[str, Tensor]:
        """Return Q, R, lambda_g and lambda_s of a layer, scaled, with their graph."""
        Q, R = base_weight("Q", layer.Q, layer.data.n_y), base_weight("R", layer.R, layer.data.n_u)
        charged_R, charged_Q = _charged(R, layer.data.n_u), _charged(Q, layer.data.n_y)
        gauge = self.R[charged_R].mean() if bool(charged_R.any()) else self.Q[charged_Q].mean()
        return {
            "Q": _scaled(Q, self.Q - gauge),
            "R": _scaled(R, self.R - gauge),
            "lambda_g": base_weight("lambda_g", layer.lambda_g) * (self.lambda_g - gauge).exp(),
            "lambda_s": base_weight("lambda_s", layer.lambda_s) * (self.lambda_s - gauge).exp(),
        }

    @torch.no_grad()
    def apply_to(self, layer: DPCLayer) -> DPCLayer:
        """Return a layer with the scaled weights as constants, and everything else as it is."""
        return with_weights(DPCLayer, layer, self(layer))

    @property
    def vector(self) -> Tensor:
        """(s_g, s_s, s_Q, s_R), `(2 + n_y + n_u,)`, detached."""
        return nn.utils.parameters_to_vector(self.parameters()).detach().clone()


Kind = TypeVar("Kind", bound=DPCLayer)


def with_weights(kind: type[Kind], layer: DPCLayer, weights: dict[str, Tensor]) -> Kind:
    """Return a layer of a kind with other weights, and everything else as it is."""
    return kind(layer.data, **{**layer.config(), **weights})


def base_weight(name: str, value: Any, channels: int | None = None) -> Tensor:
    """Return a layer's own weight as a constant float64 tensor: `(n, n)` or `(horizon n, horizon n)`, or a number."""
    weight = as_weight(name, value).detach()
    if weight.ndim > (0 if channels is None else 2):
        raise ValueError(f"`{name}` has a batch dimension, {tuple(weight.shape)}: tune one problem at a time.")
    return weight if channels is None or weight.ndim == 2 else weight * torch.eye(channels, dtype=torch.float64)


def _charged(weight: Tensor, channels: int) -> Tensor:
    """Return which channels have a positive diagonal at some step, `(n,)`."""
    return (weight.diagonal().reshape(-1, channels) > 0).any(dim=0)


def _scaled(weight: Tensor, logarithms: Tensor) -> Tensor:
    """Return D W D, D = diag(e^(logarithms / 2)), repeated over the steps where W spans the horizon."""
    root = (logarithms / 2).exp().repeat(len(weight) // len(logarithms))
    return root[:, None] * weight * root
