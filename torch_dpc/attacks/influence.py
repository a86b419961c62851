"""Which recorded windows matter: the derivative of an attacker's cost in the weight of each.

The problem depends on the recorded windows D = [d_1 ... d_n] through D D' = sum of d_j d_j' alone. A weight w_j on that
sum scales column j by sqrt(w_j): 1 leaves a window as it is, 0 removes it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..checks import as_numbers, check_type
from ..data.hankel import HankelData
from ..layer import DPCLayer
from .costs import check_cost
from .objective import Objective


def weigh_windows(data: HankelData, weights: Any) -> HankelData:
    """Return the data with a weight on every recorded window; 1 leaves a window as it is, 0 removes it.

    Column j is scaled by sqrt(w_j). The columns are then no recorded windows any more: `sol.g` is not available.

    Args:
        data: recorded windows, not compact.
        weights: `(n_g,)`, not negative, those of a ridge's columns last; a graph is kept.

    Raises:
        ValueError: weights that do not fit, or compact data.

    Example:
        >>> u, y = torch.rand(40, 1, dtype=torch.float64), torch.rand(40, 2, dtype=torch.float64)
        >>> data = HankelData.from_trajectories(u, y, t_ini=2, horizon=5)
        >>> weights = torch.ones(data.n_g, dtype=torch.float64)
        >>> weights[3] = 0.0                                       # the plans of the other windows
        >>> weigh_windows(data, weights)
        HankelData(n_u=1, n_y=2, t_ini=2, horizon=5, n_g=34 (compact, of 34 windows),
            rank=21 of 21 rows, ...
    """
    check_type("data", data, HankelData)
    if not data.has_windows:
        raise ValueError("`data` must hold the recorded windows: these are compact, their windows are gone.")
    weights = as_numbers("weights", weights)
    if weights.shape != (data.n_g,) or not bool((weights >= 0).all()) or not bool(weights.isfinite().all()):
        raise ValueError(
            f"`weights` must be finite and not negative, one a window, ({data.n_g},), got {tuple(weights.shape)}."
        )
    root = weights.sqrt().to(data.device)
    columns = {name: getattr(data, name).double() * root for name in ("Up", "Uf", "Yp", "Yf")}
    return replace(
        data, **columns, windows_seen=data.n_windows, n_ridge=0, recorded_as=data.recorded_as or data.Up.dtype
    )


def window_influence(
    layer: DPCLayer, cost: Any, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None, step: int = 0
) -> Tensor:
    """Return the derivative of mean psi in the weight of every recorded window, at weights of 1, `(n_g,)`, float64.

    With D_bar the derivative in the windows D, d psi / d w_j = 1/2 <D_bar_j, d_j>: one backward pass for all. To first
    order psi falls by the influence of a window that is removed (Koh, Liang, "Understanding black-box predictions via
    influence functions", 2017).

    Args:
        layer: whose data are judged.
        cost: psi, a callable DPCSolution -> `(*batch,)`, as every attack takes it.
        u_ini, y_ini: the windows to plan from, held out of the recording, `(*batch, t_ini, n)`.
        y_ref, u_ref: references, as the layer takes them.
        step: of the run, for costs that move with it.

    Raises:
        ValueError: bad input, named, compact data, or data whose rank is not clear.

    Example:
        >>> import torch_dpc as dpc
        >>> plant = dpc.systems.OscillatingMasses(noise=0.01)
        >>> u, y = dpc.collect(plant, 200, generator=torch.Generator().manual_seed(0))
        >>> data = dpc.HankelData.from_trajectories(u[:150], y[:150], t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> window_influence(layer, dpc.attacks.TargetInput(torch.ones(2)), u[160:164], y[160:164]).shape
        torch.Size([137])
    """
    check_type("layer", layer, DPCLayer)
    check_cost(cost)
    check_type("layer.data", layer.data, HankelData)
    assert isinstance(layer.data, HankelData)
    data = layer.data.with_ones if layer.affine else layer.data
    with torch.inference_mode(False), torch.enable_grad():
        weights = torch.ones(data.n_g, dtype=torch.float64, device=data.device, requires_grad=True)
        weighed = DPCLayer(weigh_windows(data, weights), **layer.config())
        psi = mean_psi(weighed, cost, u_ini, y_ini, y_ref, u_ref, step)
        (influence,) = torch.autograd.grad(psi, weights)
    return influence


def mean_psi(layer: DPCLayer, cost: Any, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any, step: int) -> Tensor:
    """Return the mean over the windows of psi without an attack; infinite where one of them has no plan."""
    objective = Objective(layer, cost, u_ini, y_ini, y_ref, u_ref, step)
    return objective.psi(torch.zeros_like(objective.y_ini)).mean()
