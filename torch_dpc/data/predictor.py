"""What the inputs will really do: the output that recorded data predict for a window and an input."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_data
from ..reprs import Described
from ..shapes import broadcast_shapes
from .hankel import HankelData


class Predictor(Described):
    """y = Yf W^+ (u_ini, y_ini, u), W = [Up; Yp; Uf]: the subspace predictor of Favoreel, De Moor, Gevers (1999).

    g = W^+ w is the combination of recorded windows that explains w = (u_ini, y_ini, u), least squares and of minimum
    norm. On noise-free data of a linear system every w of that system is explained, and the prediction is exact; on
    noisy data it is the least-squares fit of the outputs. W^+ is formed on the row space of the data, with the rank
    that was found there, so that the rounding of a noise-free recording is not inverted.

    Args:
        data: the recording.

    Example:
        >>> u = torch.rand(60, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
        >>> data = HankelData.from_trajectories(u, u.cumsum(0) - u, t_ini=2, horizon=3)   # an integrator
        >>> Predictor(data)(torch.zeros(2, 1), torch.ones(2, 1), torch.ones(3, 1))[:, 0]
        tensor([1.0000, 2.0000, 3.0000])
    """

    def __init__(self, data: Any):
        if not isinstance(data, HankelData):
            raise ValueError(f"`data` must be one HankelData, got {type(data).__name__}.")
        self.t_ini, self.horizon, self.n_u, self.n_y = data.t_ini, data.horizon, data.n_u, data.n_y
        space = data.row_space
        with torch.inference_mode(False), torch.no_grad():
            basis = space.basis[:, : space.rank_W]
            W = torch.cat([m.detach().double() for m in (data.Up, data.Yp, data.Uf)]) @ basis
            scale = W.norm(dim=1, keepdim=True)  # so that the fit does not depend on the units of the channels
            W = W / torch.where(scale > 0, scale, 1.0)
            orthogonal, T = torch.linalg.qr(W)  # of full column rank, W^+ = T^-1 orthogonal'
            inverse = torch.linalg.solve_triangular(T, orthogonal.mT, upper=True)
            #: The map (u_ini, y_ini, u) -> y, `(horizon n_y, t_ini (n_u + n_y) + horizon n_u)`, and its constant.
            matrix = data.Yf.detach().double() @ basis @ inverse / torch.where(scale > 0, scale, 1.0).mT
            # Data of an affine layer begin with a row of ones, whose value is 1 in every window.
            self.matrix = matrix[:, int(data.has_ones) :]
            self.constant = matrix[:, 0] if data.has_ones else matrix.new_zeros(len(matrix))

    def __call__(self, u_ini: Any, y_ini: Any, u: Any) -> Tensor:
        """Return the predicted outputs, `(*batch, horizon, n_y)`, in the dtype of u; affine, with its derivative.

        Args:
            u_ini, y_ini: the window, `(*batch, t_ini, n)`.
            u: the inputs to come, `(*batch, horizon, n_u)`.

        Raises:
            ValueError: shapes that do not fit.
        """
        sizes = ((self.t_ini, self.n_u), (self.t_ini, self.n_y), (self.horizon, self.n_u))
        parts = [as_data(name, x, finite=False) for name, x in (("u_ini", u_ini), ("y_ini", y_ini), ("u", u))]
        for name, part, size in zip(("u_ini", "y_ini", "u"), parts, sizes, strict=True):
            if part.shape[-2:] != size:
                raise ValueError(f"`{name}` must have shape (*batch, {size[0]}, {size[1]}), got {tuple(part.shape)}.")
        batch = broadcast_shapes(*(part.shape[:-2] for part in parts))
        flat = [part.double().flatten(-2).expand(*batch, -1) for part in parts]
        device = parts[2].device
        y = torch.cat(flat, dim=-1) @ self.matrix.to(device).mT + self.constant.to(device)
        return y.reshape(*batch, self.horizon, self.n_y).to(parts[2].dtype)
