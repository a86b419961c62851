"""What inputs truly lead to, and what that costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..data.hankel import HankelData

#: What inputs do from a window on: (u_ini, y_ini, u) -> y, all `(*batch, steps, n)`.
Predictor = Callable[[Tensor, Tensor, Tensor], Tensor]
#: What a stretch of a run costs: (u, y, u_ref, y_ref), `(*batch, steps, n)` each, -> `(*batch,)`.
RunCost = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


class DataPredictor:
    """Predict from recorded data, y = Yf W^+ [u_ini; y_ini; u], W = [Up; Yp; Uf]: exact where the data are.

    The data had better not be those of the layer: a layer with a large lambda_g plans with this very predictor, and
    would be judged by its own opinion.

    Example:
        >>> from torch_dpc import HankelData, collect, systems
        >>> u, y = collect(systems.OscillatingMasses(), 120, generator=torch.Generator().manual_seed(0))
        >>> predict = DataPredictor(HankelData.from_trajectories(u, y, t_ini=4, horizon=10))
        >>> bool((predict(u[:4], y[:4], u[4:14]) - y[4:14]).abs().max() < 1e-9)
        True
    """

    def __init__(self, data: Any):
        if not isinstance(data, HankelData):
            raise ValueError(f"`data` must be one HankelData, got {type(data).__name__}.")
        basis = data.row_space.basis[:, : data.row_space.rank_W]
        Up, Yp, Uf, Yf = (m.detach().double() @ basis for m in data.matrices)
        self.matrix = Yf @ torch.linalg.pinv(torch.cat([Up, Yp, Uf]))
        self.n_y = data.n_y

    def __call__(self, u_ini: Tensor, y_ini: Tensor, u: Tensor) -> Tensor:
        """Return y `(*batch, horizon, n_y)`; u is `(*batch, horizon, n_u)`."""
        known = torch.cat([u_ini.flatten(-2), y_ini.flatten(-2), u.flatten(-2)], dim=-1)
        return (known @ self.matrix.mT).unflatten(-1, (-1, self.n_y))


class MeanError:
    """The mean over the steps of |(y - y_ref)[channels]|, in the units of the outputs.

    Example:
        >>> y = torch.tensor([[3.0, 4.0, 9.0], [0.0, 0.0, 9.0]])
        >>> MeanError([0, 1])(None, y, None, torch.zeros(2, 3))
        tensor(2.5000)
    """

    #: Below this an error is rounded off, so that the derivative at zero exists [units of the outputs].
    SMOOTH = 1e-6

    def __init__(self, channels: Sequence[int]):
        self.channels = list(channels)

    def __call__(self, u: Any, y: Tensor, u_ref: Any, y_ref: Tensor) -> Tensor:
        """Return the error, `(*batch,)`."""
        square = (y - y_ref)[..., self.channels].square().sum(-1)
        return ((square + self.SMOOTH**2).sqrt() - self.SMOOTH).mean(-1)


class QuadraticCost:
    """The mean over the steps of 1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2.

    Args:
        Q, R: fixed weights of one step, `(n_y, n_y)` and `(n_u, n_u)`.
    """

    def __init__(self, Q: Tensor, R: Tensor):
        self.Q, self.R = Q, R

    def __call__(self, u: Tensor, y: Tensor, u_ref: Tensor, y_ref: Tensor) -> Tensor:
        """Return the cost, `(*batch,)`."""
        of_y = (((y - y_ref) @ self.Q) * (y - y_ref)).sum(-1)
        of_u = (((u - u_ref) @ self.R) * (u - u_ref)).sum(-1)
        return 0.5 * (of_y + of_u).mean(-1)
