"""The DPC problem: data, weights and sets, and its compact form as the paper writes it.

    minimise over u, y, g   1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2 + lambda_g |M g|^2 + lambda_s |Yp g - y_ini|^2
    subject to              Up g = u_ini,  u = Uf g,  y = Yf g,  u in U,  y in Y

    M = I - W^+ W,  W = [Up; Yp; Uf]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .hankel import HankelData
from .reduction import Weights
from .sets import Box

#: Asymmetry of Q or R, relative to its largest entry, up to which it is rounding and is averaged away.
ASYMMETRY = 1e-6
#: An eigenvalue of Q or R below minus this fraction of the largest makes the matrix indefinite.
NEGATIVE_EIGENVALUE = 1e-9


class CompactForm(NamedTuple):
    """minimise 1/2 z'Pz + q'z subject to H z = b, z in U x Y x R^n_g, for z = (u, y, g)."""

    P: Tensor
    q: Tensor
    H: Tensor
    b: Tensor


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
        raise ValueError(
            f"`{name}` must be a number or have shape ({channels}, {channels}) for one step or ({size}, {size}) for "
            f"the whole horizon, got {tuple(matrix.shape)}."
        )
    transposed = matrix.mT
    with torch.no_grad():
        largest = matrix.abs().amax()
        asymmetry = (matrix - transposed).abs().amax()
        if asymmetry > ASYMMETRY * largest:
            raise ValueError(f"`{name}` must be symmetric, got entries that differ by {float(asymmetry):.1e}.")
        smallest = torch.linalg.eigvalsh((matrix + transposed) / 2).amin()
        if smallest < -NEGATIVE_EIGENVALUE * largest:
            raise ValueError(f"`{name}` must be positive semidefinite, got an eigenvalue of {float(smallest):.1e}.")
    matrix = (matrix + transposed) / 2
    if matrix.shape[-1] == size:
        return matrix
    steps = torch.eye(horizon, dtype=matrix.dtype, device=matrix.device)
    return torch.einsum("st,...ij->...sitj", steps, matrix).reshape(*matrix.shape[:-2], size, size)


def penalty(name: str, value: Any) -> Tensor:
    """Return lambda_g or lambda_s as float64, `(...)`; a graph is kept.

    Raises:
        ValueError: a negative value.
    """
    number = as_weight(name, value)
    if bool((number.detach() < 0).any()):
        raise ValueError(f"`{name}` must not be negative, got {float(number.detach().min()):g}.")
    return number


def as_weight(name: str, value: Any) -> Tensor:
    """Return a weight as a finite float64 tensor; a graph is kept."""
    if isinstance(value, bool):
        raise ValueError(f"`{name}` must be a number or a tensor, got {value!r}.")
    if isinstance(value, Tensor):
        if not value.is_floating_point():
            raise ValueError(f"`{name}` must hold floating-point numbers, got {value.dtype}.")
        tensor = value.double()
    else:
        try:
            tensor = torch.as_tensor(value, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"`{name}` must be a number or a tensor, got {value!r}.") from error
    if not bool(torch.isfinite(tensor.detach()).all()):
        raise ValueError(f"`{name}` must be finite, got {tensor.detach().tolist()}.")
    return tensor


def stacked_bounds(u_set: Box, y_set: Box, data: HankelData, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the bounds of v = (u, y), each `(horizon (n_u + n_y),)` in float64; a graph is kept."""
    lower: list[Tensor] = []
    upper: list[Tensor] = []
    for name, box, channels in (("u_set", u_set, data.n_u), ("y_set", y_set, data.n_y)):
        box.check()
        shape = (data.horizon, channels)
        like = torch.empty(0, dtype=torch.float64, device=device)
        for bounds, value in zip((lower, upper), box.bounds(like), strict=True):
            try:
                whole = torch.broadcast_to(value, shape)
            except RuntimeError as error:
                raise ValueError(
                    f"the bounds of `{name}` must be numbers or have shape ({channels},) or {shape}, "
                    f"got {tuple(value.shape)}."
                ) from error
            bounds.append(whole.reshape(-1))
    return torch.cat(lower), torch.cat(upper)


@dataclass(frozen=True)
class Sizes:
    """How many entries each part of theta = (u_ini, y_ini, u_ref, y_ref) and of v = (u, y) has, and how many steps."""

    u_ini: int
    y_ini: int
    u: int
    y: int
    horizon: int

    @staticmethod
    def of(data: HankelData) -> Sizes:
        """Read the sizes off the data."""
        past, future = data.t_ini, data.horizon
        return Sizes(past * data.n_u, past * data.n_y, future * data.n_u, future * data.n_y, future)

    @property
    def theta(self) -> tuple[int, int, int, int]:
        """The sizes of the four parts of theta."""
        return self.u_ini, self.y_ini, self.u, self.y

    def split(self, v: Any) -> tuple[Any, Any]:
        """Return u `(..., horizon, n_u)` and y `(..., horizon, n_y)` of v, a tensor or an array `(..., N)`."""
        batch = v.shape[:-1]
        u, y = v[..., : self.u], v[..., self.u :]
        return (
            u.reshape((*batch, self.horizon, self.u // self.horizon)),
            y.reshape((*batch, self.horizon, self.y // self.horizon)),
        )

    def join(self, u: Tensor | None, y: Tensor | None, like: Tensor) -> Tensor:
        """Return v `(*batch, N)` of u and y, `(*batch, horizon, n)`, zero where they are None and shaped as `like`."""
        batch = like.shape[:-1]
        u = like.new_zeros(*batch, self.u) if u is None else u.reshape((*batch, self.u))
        y = like.new_zeros(*batch, self.y) if y is None else y.reshape((*batch, self.y))
        return torch.cat([u, y], dim=-1)


def projector(data: HankelData) -> Tensor:
    """Return M = I - W^+ W, `(n_g, n_g)`, with the rank of W as the row space of the data decided it."""
    space = data.row_space
    in_W = space.basis[:, : space.rank_W]
    return torch.eye(data.n_g, dtype=in_W.dtype, device=in_W.device) - in_W @ in_W.T


def compact_form(data: HankelData, weights: Weights, theta: Tensor) -> CompactForm:
    """Return P, q, H, b as the paper writes them.

    Args:
        data: the recorded data.
        weights: Q, R of the whole horizon, lambda_g, lambda_s; one problem.
        theta: (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)`.

    Returns:
        P `(n, n)`, q `(*batch, n)`, H `(m, n)`, b `(*batch, m)` with n = horizon (n_u + n_y) + n_g and
        m = horizon (n_u + n_y) + t_ini n_u.
    """
    sizes = Sizes.of(data)
    Up, Yp, Uf, Yf = (m.detach().to(theta) for m in data.matrices)
    Q, R = weights.Q.to(theta), weights.R.to(theta)
    M = projector(data).to(theta)
    of_g = 2 * weights.lambda_g * (M.T @ M) + 2 * weights.lambda_s * (Yp.T @ Yp)
    P = torch.block_diag(R, Q, of_g)
    u_ini, y_ini, u_ref, y_ref = theta.split(sizes.theta, dim=-1)
    q = -torch.cat([u_ref @ R, y_ref @ Q, 2 * weights.lambda_s * (y_ini @ Yp)], dim=-1)
    minus_I = -torch.eye(sizes.u + sizes.y, dtype=theta.dtype, device=theta.device)
    past = torch.cat([Up.new_zeros(sizes.u_ini, sizes.u + sizes.y), Up], dim=1)
    future = torch.cat([minus_I, torch.cat([Uf, Yf])], dim=1)
    b = torch.cat([u_ini, theta.new_zeros(*theta.shape[:-1], sizes.u + sizes.y)], dim=-1)
    return CompactForm(P, q, torch.cat([past, future]), b)
