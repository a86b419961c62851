"""Weights that stay in their domain while an optimiser moves them."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Positive(nn.Module):
    """A positive weight as the exponential of a free one, for `torch.nn.utils.parametrize`.

    Example:
        >>> import torch.nn.utils.parametrize as parametrize
        >>> module = nn.ParameterDict({"lambda_s": nn.Parameter(torch.tensor(1e4, dtype=torch.float64))})
        >>> parametrize.register_parametrization(module, "lambda_s", Positive())
        ParametrizedParameterDict(...
        >>> round(float(module.lambda_s), 6)
        10000.0
    """

    def forward(self, free: Tensor) -> Tensor:
        """Return e^free."""
        return free.exp()

    def right_inverse(self, weight: Tensor) -> Tensor:
        """Return the logarithm of a weight.

        Raises:
            ValueError: a weight that is not positive.
        """
        if not bool((weight > 0).all()):
            raise ValueError(f"`weight` under Positive must be positive, got {weight!r}.")
        return weight.log()


class Semidefinite(nn.Module):
    """A symmetric positive semidefinite weight as L L' of a free matrix L, for `torch.nn.utils.parametrize`.

    Example:
        >>> weight = Semidefinite()
        >>> Q = torch.tensor([[2.0, 1.0], [1.0, 0.5]], dtype=torch.float64)      # singular
        >>> torch.allclose(weight(weight.right_inverse(Q)), Q)
        True
    """

    def forward(self, free: Tensor) -> Tensor:
        """Return L L', `(*batch, n, n)`."""
        return free @ free.mT

    def right_inverse(self, weight: Tensor) -> Tensor:
        """Return a square root of a weight.

        Raises:
            ValueError: a weight that is not symmetric positive semidefinite.
        """
        if weight.ndim < 2 or weight.shape[-1] != weight.shape[-2]:
            raise ValueError(f"`weight` under Semidefinite must have shape (*batch, n, n), got {tuple(weight.shape)}.")
        values, vectors = torch.linalg.eigh(weight)
        largest = values.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
        rounding = weight.shape[-1] * torch.finfo(weight.dtype).eps * largest
        if not torch.allclose(weight, weight.mT) or not bool((values >= -rounding).all()):
            raise ValueError("`weight` under Semidefinite must be symmetric positive semidefinite.")
        return vectors * values.clamp_min(0.0).sqrt()[..., None, :]
