"""A ridge on the recorded past outputs: what noise in the recording adds on average, without the noise.

The problem depends on the recorded windows D through D D' alone. Independent noise of standard deviation s_i on output
i adds, on average, n_windows s_i^2 to each of its diagonal entries of D D'. The ridge adds exactly that to the part of
the past outputs Yp, by one column more for each of them: sqrt(n_windows) s_i there, 0 elsewhere. The future outputs are
left alone: noise there adds to what only lambda_g charges, and moves no prediction.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..checks import as_numbers


def ridge_deviation(name: str, value: Any, n_y: int) -> Tensor:
    """Return a ridge as `(n_y,)`, float64, with its graph.

    Raises:
        ValueError: another shape, or an entry that is negative or not finite.
    """
    deviation = as_numbers(name, value)
    entries = deviation.detach()
    if entries.shape not in ((), (n_y,)) or not bool(((entries >= 0) & entries.isfinite()).all()):
        came = repr(value) if entries.ndim == 0 else f"shape {tuple(entries.shape)}"
        raise ValueError(f"`{name}` must be a number or have shape ({n_y},), finite and not negative, got {came}.")
    return deviation.expand(n_y)


def with_ridge_columns(data: Any, deviation: Tensor) -> list[Tensor]:
    """Return Up, Uf, Yp, Yf of the data with the columns of a ridge after their own; a graph is kept.

    Args:
        data: a `HankelData`.
        deviation: s, `(n_y,)`, in the units of the outputs.
    """
    entries = math.sqrt(data.n_windows) * deviation.to(data.Yp).repeat(data.t_ini)
    zeros = [matrix.new_zeros(len(matrix), len(entries)) for matrix in (data.Up, data.Uf, data.Yf)]
    columns = (*zeros[:2], torch.diag(entries), zeros[2])
    matrices = (data.Up, data.Uf, data.Yp, data.Yf)
    return [torch.cat([matrix, more], dim=1) for matrix, more in zip(matrices, columns, strict=True)]
