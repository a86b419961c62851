"""What the baselines read from a layer: the one module that looks behind the public names of torch_dpc."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_dpc import Box, DPCLayer, HankelData
from torch_dpc.checks import is_finite
from torch_dpc.problem.compact_form import projector
from torch_dpc.problem.reduction import Reduction
from torch_dpc.problem.terms import Sizes, Terms
from torch_dpc.problem.weights import penalty, psd_root, weight_matrix

#: Keeps 0 / 0 at 0.
_TINY = 1e-300


def theta_of(layer: DPCLayer, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any) -> tuple[Tensor, torch.dtype]:
    """Return theta `(*batch, n_theta)` of a call, checked as the layer checks it, and the caller's dtype."""
    theta, dtype = layer.flatten(u_ini, y_ini, y_ref, u_ref)
    if not is_finite(theta):
        raise ValueError("`u_ini`, `y_ini`, `u_ref` and `y_ref` must be finite.")
    return theta, dtype


def parts_of(layer: DPCLayer, theta: Tensor) -> tuple[Tensor, ...]:
    """Return u_ini, y_ini, u_ref, y_ref of theta, `(B, steps, channels)`."""
    data = layer.data
    parts = theta.split(Sizes.of(data).theta, dim=-1)
    channels = (data.n_u, data.n_y, data.n_u, data.n_y)
    return tuple(part.unflatten(-1, (-1, n)) for part, n in zip(parts, channels, strict=True))


def bounds_of(layer: DPCLayer) -> tuple[Tensor, Tensor]:
    """Return the bounds of v = (u, y) on the CPU, `(N,)`.

    Raises:
        ValueError: a set is no box, or the problem is not the paper's.
    """
    if layer.terms != Terms():
        raise ValueError(f"the baselines take the paper's problem, got one with {layer.terms}.")
    if not (isinstance(layer.u_set, Box) and isinstance(layer.y_set, Box)):
        names = f"{type(layer.u_set).__name__} and {type(layer.y_set).__name__}"
        raise ValueError(f"the baselines take boxes as `u_set` and `y_set`, got {names}.")
    with torch.no_grad():
        lower, upper = layer.bounds(torch.device("cpu"))
    return lower, upper


def data_of(layer: DPCLayer) -> HankelData:
    """Return the data of a layer of one problem."""
    if not isinstance(layer.data, HankelData):
        raise ValueError("the baselines take one problem; the layer has a batch of data sets.")
    return layer.data


class CostRows(NamedTuple):
    """The paper's four cost terms as least-squares rows, lambda_g and lambda_s in them."""

    root_R: Tensor
    root_Q: Tensor
    M: Tensor
    Yp: Tensor
    root_s: Tensor


def cost_rows_of(layer: DPCLayer) -> CostRows:
    """Return sqrt(R), sqrt(Q), sqrt(2 lambda_g) M, sqrt(2 lambda_s) Yp and sqrt(2 lambda_s)."""
    data = data_of(layer)
    with torch.no_grad():
        root_g, root_s = (
            (2 * penalty(name, value)).sqrt()
            for name, value in (("lambda_g", layer.lambda_g), ("lambda_s", layer.lambda_s))
        )
        rows = CostRows(
            root_R=psd_root(weight_matrix("R", layer.R, data.n_u, data.horizon), data.n_u),
            root_Q=psd_root(weight_matrix("Q", layer.Q, data.n_y, data.horizon), data.n_y),
            M=root_g * projector(data),
            Yp=root_s * data.Yp.double(),
            root_s=root_s,
        )
    return CostRows(*(x.cpu() for x in rows))


def reduction_of(layer: DPCLayer) -> Reduction:
    """Return the layer's reduced problem on the CPU, without a graph."""
    with torch.no_grad():
        reduction = layer.reduction.detach()
    if reduction.G.ndim != 2:
        raise ValueError("the baselines take one problem; the layer's weights have a batch dimension.")
    values = {f.name: getattr(reduction, f.name) for f in fields(reduction)}
    moved: dict[str, Any] = {name: x.cpu() for name, x in values.items() if isinstance(x, Tensor)}
    return replace(reduction, **moved)


class Judge:
    """The reduced optimality conditions of a layer, for solutions found elsewhere.

        v = Proj(v + lam),     v = V theta - G lam

    Args:
        layer: the layer whose problem it is; read now.
        tolerance: a row touches a bound within tolerance (1 + |v|), and is active if the displacement G_ii lam_i that
            its multiplier makes is larger than that, as in :mod:`torch_dpc.solve.weakness`.
    """

    def __init__(self, layer: DPCLayer, tolerance: float):
        self._lower, self._upper = bounds_of(layer)
        self._reduction, self._tolerance = reduction_of(layer), tolerance

    def residual(self, theta: Tensor, v: Tensor, lam: Tensor) -> Tensor:
        """Return how far v and its multipliers lam, `(B, N)`, are from the conditions, relative to |v| + |V theta|."""
        v0 = theta @ self._reduction.V.mT
        in_set = v - torch.minimum(torch.maximum(v + lam, self._lower), self._upper)
        stationary = v - v0 + lam @ self._reduction.G
        norm = torch.linalg.vector_norm
        scale = norm(v, dim=-1) + norm(v0, dim=-1) + _TINY
        return (norm(in_set, dim=-1) + norm(stationary, dim=-1)) / scale

    def active(self, v: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
        """Return the active and the weakly active rows, `(B, N)`."""
        reach = self._tolerance * (1 + v.abs())
        touching = (self._upper - v <= reach) | (v - self._lower <= reach)
        moved = (lam * self._reduction.G.diagonal()).abs()
        active = touching & ((moved > reach) | (self._lower == self._upper))
        return active, touching & ~active
