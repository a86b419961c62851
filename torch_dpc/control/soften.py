"""Plan although the output set excludes every trajectory: widen it by as little as is worth its price.

    minimise  (the cost of the plan) + weight t   subject to   y within its bounds widened by t,  t >= 0

is an exact penalty: where the problem has a solution whose output multipliers sum to at most `weight`, t = 0 and the
plan is the one without softening. The optimal cost is convex in t with slope -sum |lam_y|, so t is where that sum
falls below the weight, and a section search finds it, many widths at once as one batch.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..errors import SolveError, Status
from ..layer import DPCLayer
from ..solution import DPCSolution

#: Widths tried at once, and rounds of narrowing: t is found to (SECTIONS - 1)^-ROUNDS of its scale.
SECTIONS = 16
ROUNDS = 12


def require_boxes(planner: Any) -> None:
    """Raise ValueError unless a planner is a layer whose sets are boxes."""
    if not isinstance(planner, DPCLayer):
        raise ValueError(f'`on_failure="soften"` needs a DPCLayer, got {type(planner).__name__}.')
    if not planner.has_bounds:
        raise ValueError('`on_failure="soften"` widens boxes; give the layer a SoftBox as `y_set` instead.')


def plan_softened(layer: DPCLayer, theta: Tensor, weight: float) -> tuple[DPCSolution, float]:
    """Return the plan of one problem with softened output bounds, and by how much they were widened.

    Args:
        layer: a layer with box constraints.
        theta: (u_ini, y_ini, u_ref, y_ref) flattened, `(n_theta,)`, float64.
        weight: price of one unit of t, in units of the cost.

    Raises:
        SolveError: no width helps; the inputs alone exclude every trajectory.
    """
    low, high = 0.0, _enough(layer, theta, weight)
    for _ in range(ROUNDS):
        widths = torch.linspace(low, high, SECTIONS, dtype=theta.dtype, device=theta.device)
        worth = _is_worth(_plan(layer, theta, widths), layer, weight)
        first = int(worth.int().argmax())
        low, high = float(widths[max(first - 1, 0)]), float(widths[first])
        if first == 0:
            break
    width = torch.tensor([high], dtype=theta.dtype, device=theta.device)
    plan = _plan(layer, theta, width)
    return plan.sample(0), high


def _enough(layer: DPCLayer, theta: Tensor, weight: float) -> float:
    """Return a width that is wide enough, from a geometric ladder."""
    scale = 1.0 + float(theta.abs().max())
    widths = scale * 10.0 ** torch.arange(-8, 9, dtype=theta.dtype, device=theta.device)
    worth = _is_worth(_plan(layer, theta, widths), layer, weight)
    if not bool(worth[-1]):
        raise SolveError("softening the output set does not help: the inputs alone exclude every trajectory.")
    return float(widths[int(worth.int().argmax())])


def _plan(layer: DPCLayer, theta: Tensor, widths: Tensor) -> DPCSolution:
    lower, upper = layer.bounds(theta.device)
    widened = torch.zeros_like(lower)
    widened[_outputs(layer)] = 1.0
    step = widths[:, None] * widened
    return layer.plan(theta.expand(len(widths), -1), lower - step, upper + step, on_failure="nan")


def _is_worth(plan: DPCSolution, layer: DPCLayer, weight: float) -> Tensor:
    price = plan.lam[:, _outputs(layer)].abs().sum(dim=1)
    return (plan.info.status == Status.SOLVED) & (price <= weight)


def _outputs(layer: DPCLayer) -> slice:
    return slice(layer.sizes.u, layer.sizes.u + layer.sizes.y)
