"""How strongly a plan answers to its measurements."""

from __future__ import annotations

import torch
from torch import Tensor

from ..checks import check_type
from ..layer import DPCLayer


def plan_gain(layer: DPCLayer) -> Tensor:
    """Return max |u(y_ini + p) - u(y_ini)| / |p| of the plan without its bounds, a number with its graph.

    It is the spectral norm of du / dy_ini, and at most the certified bound of
    :func:`torch_dpc.attacks.sensitivity_bound`, which holds with bounds and has no derivative.

    Args:
        layer: one problem; a batch of weights gives one gain each.

    Example:
        >>> from torch_dpc import HankelData, collect, systems
        >>> u, y = collect(systems.OscillatingMasses(), 120, generator=torch.Generator().manual_seed(0))
        >>> data = HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> round(float(plan_gain(DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4))), 3)
        2.961
    """
    check_type("layer", layer, DPCLayer)
    sizes = layer.sizes
    du_dy = layer.reduction.V[..., : sizes.u, sizes.u_ini : sizes.u_ini + sizes.y_ini]
    return torch.linalg.matrix_norm(du_dy, 2)
