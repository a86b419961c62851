"""Data that never stops: the present data of a recording that grows."""

from __future__ import annotations

import numpy as np
import torch

from .hankel import HankelData
from .window_factor import BLOCK, WindowFactor


class HankelStream(WindowFactor):
    """Recorded data that grow, in constant memory, and forget if asked to.

    Every complete window of the samples is folded into a triangular factor of r = (t_ini + horizon)(n_u + n_y) rows, in
    O(r^2), and is then gone. `data` is the present :class:`HankelData`, compact; give it to a layer by
    `layer.data = stream.data`.

    With a forgetting factor f < 1 each new window first multiplies the columns of all older ones by sqrt(f), so that a
    window that k others have followed weighs w = f^k. About 1 / (1 - f) windows then count (`n_effective`). The plan is
    that of the weighted columns D diag(sqrt(w)), and in the coefficients g of the windows as recorded, u = Uf g,

    - `lambda_s` is what it was: the price of |Yp g - y_ini|^2, in the units of the outputs;
    - `lambda_g` charges the distance of g to the rows of W weighted, the least over h of
      sum_j (g_j - w_j W_j'h)^2 / w_j: the older a window, the dearer its use. In the outputs, that is
      lambda_g e' S^+ e, where e is how far the predicted y departs from the weighted least-squares predictor
      of Yf from W, and S = sum_j w_j e_j e_j' is the weighted sum (not the mean) of the squared misses of the windows.
      Without forgetting S grows with the recording and lambda_g loses its grip; with it, lambda_g / n_effective is
      the price in units of their covariance, and stays.

    Forgetting needs an input that goes on exciting: what is not seen again is lost. See `excitation_order`, and stop
    appending while the plant rests.

    Args:
        t_ini: steps that fix the initial condition.
        horizon: steps that are planned.
        forgetting: f, in (0, 1].

    Example:
        >>> stream = HankelStream(t_ini=2, horizon=5, forgetting=0.99)
        >>> source = torch.Generator().manual_seed(0)
        >>> for _ in range(50):                       # sample by sample, as they are measured
        ...     stream.append(torch.rand(1, generator=source), torch.rand(2, generator=source))
        >>> stream.n_windows, round(stream.n_effective, 1), stream.data.Yf.shape
        (44, 35.7, torch.Size([10, 21]))
    """

    def __init__(self, *, t_ini: int, horizon: int, forgetting: float = 1.0):
        super().__init__(t_ini=t_ini, horizon=horizon, forgetting=forgetting)
        self._snapshot: tuple[int, HankelData] | None = None  # the windows in it, and the data

    def __repr__(self) -> str:
        channels = f"n_u={self._n_u}, n_y={self._n_y}" if self._n_u else "no samples"
        return (
            f"HankelStream({channels}, t_ini={self.t_ini}, horizon={self.horizon}, forgetting={self.forgetting:g}: "
            f"{self.n_windows} windows, {self.n_effective:.4g} of them count)"
        )

    @classmethod
    def from_data(cls, data: HankelData, *, forgetting: float = 1.0) -> HankelStream:
        """Go on from recorded data, compact or not, as if its windows weighed 1 each, by a new recording."""
        if not isinstance(data, HankelData):
            raise ValueError(f"`data` must be a HankelData, got {type(data).__name__}.")
        stream = cls(t_ini=data.t_ini, horizon=data.horizon, forgetting=forgetting)
        stream._start(data.n_u, data.n_y)
        stream._dtype = data.recorded_as or data.Up.dtype
        for blocks in zip(*(m.detach().cpu().split(BLOCK, dim=1) for m in data.matrices), strict=True):
            stream._fold(np.asfortranarray(torch.cat(blocks).double().numpy().T))
        stream._folded, stream._weight = data.n_windows, float(data.n_windows)
        return stream

    @property
    def data(self) -> HankelData:
        """The present data, compact: a snapshot, the same object until a new window is complete.

        Raises:
            ValueError: no window is complete yet.
        """
        if self._snapshot is None or self._snapshot[0] != self.n_windows:
            self._snapshot = (self.n_windows, HankelData.from_factor(self))
        return self._snapshot[1]
