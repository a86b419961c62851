"""The weights of the problem: what a caller may give, checked, as tensors of the whole horizon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..autodiff import is_mapped
from ..shapes import broadcast_shapes

#: Asymmetry of Q or R, relative to its largest entry, up to which it is rounding and is averaged away.
ASYMMETRY = 1e-6
#: An eigenvalue of Q or R below minus this fraction of the largest makes the matrix indefinite.
NEGATIVE_EIGENVALUE = 1e-9
#: An eigenvalue of a weight with unit diagonal at or below this, times its size, is rounding.
EIGENVALUE_ROUNDING = 1e-15


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights as tensors; leading dimensions, if any, are one problem each.

    Attributes:
        Q: output weight, `(..., horizon n_y, horizon n_y)`.
        R: input weight, `(..., horizon n_u, horizon n_u)`.
        lambda_g, lambda_s: regularisation of g and of the initial output, `(...)`.
        lambda_u: penalty on the mismatch of the initial input, `(...)`; None where that is exact.
        R_du: weight of the changes of the input, like R; None where they are not charged.
        beta_2: regularisation of gamma_2, `(...)`; None where it is not charged.
    """

    Q: Tensor
    R: Tensor
    lambda_g: Tensor
    lambda_s: Tensor
    lambda_u: Tensor | None = None
    R_du: Tensor | None = None
    beta_2: Tensor | None = None

    #: Dimensions of each weight that are its own; those before them are the batch.
    TAILS = {"Q": 2, "R": 2, "lambda_g": 0, "lambda_s": 0, "lambda_u": 0, "R_du": 2, "beta_2": 0}

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The weights that there are, by name."""
        return {name: getattr(self, name) for name in self.TAILS if getattr(self, name) is not None}

    @property
    def are_batched(self) -> bool:
        """Whether one of them has a batch dimension."""
        return any(tensor.ndim > self.TAILS[name] for name, tensor in self.tensors.items())

    def map(self, change: Any) -> Weights:
        """Return the weights with `change(tensor, own dimensions)` in place of each."""
        return Weights(**{name: change(tensor, self.TAILS[name]) for name, tensor in self.tensors.items()})


def weight_matrix(name: str, value: Any, channels: int, horizon: int) -> Tensor:
    """Return Q or R of the whole horizon, `(..., horizon n, horizon n)` in float64, symmetric; a graph is kept.

    Args:
        name: "Q" or "R", for messages.
        value: a number, one step's `(..., n, n)`, or the whole horizon's `(..., horizon n, horizon n)`.
        channels: n.
        horizon: steps of the plan.

    Raises:
        ValueError: another shape, asymmetry above rounding, or a negative eigenvalue.
    """
    matrix = as_weight(name, value)
    if matrix.ndim == 0:
        matrix = matrix * torch.eye(channels, dtype=matrix.dtype, device=matrix.device)
    size = channels * horizon
    if matrix.ndim < 2 or matrix.shape[-2:] not in {(channels, channels), (size, size)}:
        hint = f" For a diagonal weight give torch.diag({name})." if matrix.shape in {(channels,), (size,)} else ""
        raise ValueError(
            f"`{name}` must be a number or have shape ({channels}, {channels}) for one step or ({size}, {size}) for "
            f"the whole horizon, got {tuple(matrix.shape)}.{hint}"
        )
    transposed = matrix.mT
    with torch.no_grad():
        largest = matrix.abs().amax()
        asymmetry = (matrix - transposed).abs().amax()
        if asymmetry > ASYMMETRY * largest:
            raise ValueError(f"`{name}` must be symmetric, got entries that differ by {float(asymmetry):.1e}.")
        smallest = _smallest_eigenvalue((matrix + transposed) / 2)
        if smallest < -NEGATIVE_EIGENVALUE:
            raise ValueError(
                f"`{name}` must be positive semidefinite, got an eigenvalue of {float(smallest):.1e} (channels brought "
                f"to a unit diagonal).{_hint('Semidefinite', matrix)}"
            )
    matrix = (matrix + transposed) / 2
    if matrix.shape[-1] == size:
        return matrix
    steps = torch.eye(horizon, dtype=matrix.dtype, device=matrix.device)
    return torch.einsum("st,...ij->...sitj", steps, matrix).reshape(*matrix.shape[:-2], size, size)


def output_weight(Q: Any, Q_terminal: Any, n_y: int, horizon: int) -> Tensor:
    """Return Q of the whole horizon, with Q_terminal, `(..., n_y, n_y)`, in place of that of the last step if given.

    Raises:
        ValueError: as :func:`weight_matrix`.
    """
    whole = weight_matrix("Q", Q, n_y, horizon)
    if Q_terminal is None:
        return whole
    last = weight_matrix("Q_terminal", Q_terminal, n_y, 1)
    before = (horizon - 1) * n_y
    batch = broadcast_shapes(whole.shape[:-2], last.shape[:-2])
    rest, last = whole[..., :before, :before].expand(*batch, -1, -1), last.expand(*batch, -1, -1)
    side = whole.new_zeros(*batch, before, n_y)
    return torch.cat([torch.cat([rest, side], -1), torch.cat([side.mT, last.to(whole)], -1)], -2)


def _smallest_eigenvalue(matrix: Tensor) -> Tensor:
    """Return the smallest eigenvalue of a symmetric matrix of any batch, brought to a unit diagonal."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    # A zero on the diagonal of a semidefinite matrix has a zero row: one that is not stays, and shows.
    size = torch.where(diagonal == 0, matrix.abs().amax(-1), diagonal.abs()).sqrt()
    inverse = torch.where(size > 0, 1 / size, 0.0)
    return torch.linalg.eigvalsh(matrix * inverse[..., :, None] * inverse[..., None, :]).amin()


def penalty(name: str, value: Any) -> Tensor:
    """Return lambda_g or lambda_s as float64, `(...)`; a graph is kept.

    Raises:
        ValueError: a negative value.
    """
    number = as_weight(name, value)
    if bool((number.detach() < 0).any()):
        least = float(number.detach().min())
        raise ValueError(f"`{name}` must not be negative, got {least:g}.{_hint('Positive', number)}")
    return number


def _hint(parametrisation: str, weight: Tensor) -> str:
    """Return how a weight that learns is kept in its domain; nothing for one that does not learn."""
    if not weight.requires_grad:
        return ""
    return f" A weight that learns stays in its domain with tuning.{parametrisation}, by torch.nn.utils.parametrize."


def as_weight(name: str, value: Any) -> Tensor:
    """Return a weight as a finite float64 tensor; a graph is kept."""
    if is_mapped(value):
        raise NotImplementedError(
            f"vmap over weights is not supported: give `{name}` a leading batch dimension, of which the "
            "layer makes one batched factorisation."
        )
    if isinstance(value, Tensor):
        if not value.is_floating_point():
            raise ValueError(f"`{name}` must hold floating-point numbers, got {value.dtype}.")
        tensor = value.double()
    else:
        try:
            tensor = torch.as_tensor(value, dtype=torch.float64)
            is_bool = torch.as_tensor(value).dtype == torch.bool
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"`{name}` must be a number or a tensor, got {value!r}.") from error
        if is_bool:
            raise ValueError(f"`{name}` must be a number or a tensor, got {value!r}.")
    if tensor.numel() == 0:
        raise ValueError(f"`{name}` must hold one problem's weight or more, got shape {tuple(tensor.shape)}.")
    if not bool(torch.isfinite(tensor.detach()).all()):
        raise ValueError(f"`{name}` must be finite, got {tensor.detach().tolist()}.")
    return tensor


def psd_root(matrix: Tensor, channels: int) -> Tensor:
    """Return S with S'S = matrix, for a symmetric positive semidefinite matrix `(..., horizon n, horizon n)`.

    Steps that no entry couples have a root each, which is n^3 in place of (horizon n)^3.

    Args:
        matrix: the weight of the whole horizon.
        channels: n.
    """
    batch, size = matrix.shape[:-2], matrix.shape[-1]
    horizon = size // channels
    if horizon < 2:
        return _root(matrix, size)
    steps = matrix.reshape(*batch, horizon, channels, horizon, channels)
    own = steps.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)  # (..., horizon, n, n)
    if int(own.count_nonzero()) < int(matrix.count_nonzero()):
        return _root(matrix, size)
    whole = torch.zeros_like(matrix)
    first = own[..., :1, :, :]
    roots = _root(first if bool((own == first).all()) else own, size)
    places = whole.reshape(steps.shape).diagonal(dim1=-4, dim2=-2).movedim(-1, -3)
    places.copy_(roots.expand_as(own))
    return whole


def _root(matrix: Tensor, size: int) -> Tensor:
    """Return S with S'S = matrix, for a symmetric positive semidefinite matrix `(..., n, n)`; size, for its rounding.

    The matrix is brought to a unit diagonal first, so that S is accurate column by column whatever the units of the
    channels, and an eigenvalue at rounding level is zero: a weight that is not there must not charge anything.
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    inverse = torch.where(diagonal > 0, 1 / diagonal, 0.0)
    values, vectors = torch.linalg.eigh(matrix * inverse[..., :, None] * inverse[..., None, :])
    rounding = EIGENVALUE_ROUNDING * size * values.amax(-1, keepdim=True)
    roots = torch.where(values > rounding, values, 0.0).sqrt()
    return roots[..., None] * vectors.mT * diagonal[..., None, :]
