"""Data that never stops: windows folded into a triangular factor, one after another, and forgotten.

With D = [Up; Yp; Uf; Yf], a column each window, the problem depends on D through D D' alone. A QR factorisation of the
windows as rows, D' = B R with B'B = I, therefore keeps all there is to know in R, (t_ini + horizon)(n_u + n_y) square
however long the recording: R'R = D D' and L = R' stands for D. More windows D_2' are folded in by the QR of [R; D_2'],
by orthogonal transformations alone. D D' itself is never formed: that would square the condition.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import lapack

from ..checks import as_data, check_count
from .excitation import has_full_row_rank
from .hankel import HankelData
from .row_space import relative_tolerance

#: Windows folded at once. 256 and more cost the same a window; the memory grows with them.
BLOCK = 512
#: Columns of a panel of LAPACK's blocked QR, the fastest of 8, 16, 32 and 64 at 186 and 279 rows.
PANEL = 16


class HankelStream:
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
        t_ini, horizon = check_count("t_ini", t_ini), check_count("horizon", horizon)
        if isinstance(forgetting, bool) or not isinstance(forgetting, (int, float)) or not 0 < forgetting <= 1:
            raise ValueError(f"`forgetting` must be a number in (0, 1], got {forgetting!r}.")
        self.t_ini, self.horizon, self.forgetting = t_ini, horizon, float(forgetting)
        self._folded = 0
        self._weight = 0.0
        self._dtype = torch.float64  # of the recordings: the least precise so far
        self._n_u = self._n_y = 0  # not known before the first samples
        self._data: HankelData | None = None

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
    def depth(self) -> int:
        """Samples of a window: t_ini + horizon."""
        return self.t_ini + self.horizon

    @property
    def n_windows(self) -> int:
        """Windows seen so far."""
        return self._folded + self._pending

    @property
    def n_effective(self) -> float:
        """The sum of the weights of the windows, forgetting^age each; without forgetting, `n_windows`."""
        left, *own = self._weights(self._pending)
        return float(left * self._weight + sum(own))

    def append(self, u: Any, y: Any) -> None:
        """Take new samples of the recording under way.

        Args:
            u: inputs, `(n_u,)` or `(T, n_u)`, in order; u[k] was applied at y[k].
            y: outputs, `(n_y,)` or `(T, n_y)`.

        Raises:
            ValueError: shapes that do not fit, or samples that are not finite; nothing is then taken.
        """
        samples = self._checked(u, y)
        first = 0
        while first < len(samples):
            taken = samples[first : first + len(self._samples) - self._filled]
            self._samples[self._filled : self._filled + len(taken)] = taken
            self._filled += len(taken)
            first += len(taken)
            if self._filled == len(self._samples):
                self._fold_pending()

    def new_recording(self) -> None:
        """Start a new recording: no window runs across this seam. Windows seen are kept."""
        if self._n_u:
            self._fold_pending()
            self._filled = 0

    def extend(self, chunks: Iterable[Any]) -> None:
        """Append every pair (u, y) of an iterable; None starts a new recording."""
        if not isinstance(chunks, Iterable):
            raise ValueError(f"`chunks` must be an iterable of pairs (u, y), got {type(chunks).__name__}.")
        for i, chunk in enumerate(chunks):
            if chunk is None:
                self.new_recording()
                continue
            if not isinstance(chunk, (tuple, list)) or len(chunk) != 2:
                raise ValueError(
                    f"item {i} of `chunks` must be a pair (u, y), or None to start a new recording, "
                    f"got {type(chunk).__name__}."
                )
            try:
                self.append(*chunk)
            except ValueError as error:
                raise ValueError(f"item {i} of `chunks`: {error}") from error

    @property
    def data(self) -> HankelData:
        """The present data, compact: a snapshot, the same object until a new window is complete.

        Raises:
            ValueError: no window is complete yet.
        """
        if self.n_windows == 0:
            raise ValueError(
                f"a window has t_ini + horizon = {self.depth} samples of one recording, and no recording was that long."
            )
        if self._data is None or self._pending:
            self._fold_pending()
            # Fewer windows than rows leave the last rows of R at rounding.
            L = torch.from_numpy(self._R[: min(len(self._R), self.n_windows)].T.copy())
            Up, Yp, Uf, Yf = L.split(self._rows)
            self._data = HankelData(
                Up, Uf, Yp, Yf, self.t_ini, self.horizon, self._n_u, self._n_y, self.n_windows, self._dtype
            )
        return self._data

    @property
    def excitation_order(self) -> int:
        """The order, up to t_ini + horizon, of which the inputs seen are persistently exciting, weighted.

        Below t_ini + horizon the data do not hold every trajectory of the system.
        """
        if self.n_windows == 0:
            return 0
        data, low, high = self.data, 0, self.depth
        U = torch.cat([data.Up, data.Uf])
        while low < high:  # full row rank at depth L implies it at every smaller depth: bisect
            middle = (low + high + 1) // 2
            full = has_full_row_rank(U[: middle * data.n_u], data.rank_tolerance)
            low, high = (middle, high) if full else (low, middle - 1)
        return low

    @property
    def _pending(self) -> int:
        """Windows in the samples that wait to be folded."""
        return max(self._filled - self.depth + 1, 0) if self._n_u else 0

    @property
    def _rows(self) -> list[int]:
        """Rows of Up, Yp, Uf, Yf."""
        return [steps * n for steps in (self.t_ini, self.horizon) for n in (self._n_u, self._n_y)]

    def _start(self, n_u: int, n_y: int) -> None:
        self._n_u, self._n_y = n_u, n_y
        rows = sum(self._rows)
        self._R = np.zeros((rows, rows), order="F")
        self._samples = np.empty((self.depth - 1 + BLOCK, n_u + n_y))
        self._filled = 0

    def _checked(self, u: Any, y: Any) -> NDArray[np.float64]:
        """Return (u, y) as one array `(T, n_u + n_y)`."""
        pair = [_as_samples("u", u), _as_samples("y", y)]
        steps, channels = zip(*(signal.shape for signal in pair), strict=True)
        if steps[0] != steps[1]:
            raise ValueError(f"`u` and `y` must be as long, got {steps[0]} and {steps[1]} samples.")
        if not self._n_u:
            self._start(*channels)
        if channels != (self._n_u, self._n_y):
            raise ValueError(
                f"`u` and `y` must have {self._n_u} and {self._n_y} channels, as before, got {channels[0]} and "
                f"{channels[1]}."
            )
        self._dtype = max(self._dtype, *(signal.dtype for signal in pair), key=relative_tolerance)
        return np.concatenate([signal.double().cpu().numpy() for signal in pair], axis=1)

    def _weights(self, new: int) -> NDArray[np.float64]:
        """Return what `new` more windows leave of the weight of all older ones, then the weight of each of them."""
        return self.forgetting ** np.concatenate([[new], np.arange(new - 1.0, -1.0, -1.0)])

    def _fold_pending(self) -> None:
        """Fold the windows of the waiting samples, and keep the samples that the next window needs."""
        new = self._pending
        if new == 0:
            return
        windows = np.lib.stride_tricks.sliding_window_view(self._samples[: self._filled], self.depth, axis=0)
        windows = windows.transpose(0, 2, 1)  # (new, depth, n_u + n_y)
        block = np.empty((new, len(self._R)), order="F")
        cuts = np.cumsum(self._rows)[:-1]
        for part, rows in enumerate(np.split(block, cuts, axis=1)):
            steps = slice(None, self.t_ini) if part < 2 else slice(self.t_ini, None)
            channels = slice(None, self._n_u) if part % 2 == 0 else slice(self._n_u, None)
            rows[:] = windows[:, steps, channels].reshape(new, -1)
        if self.forgetting < 1:
            weights = self._weights(new)
            self._R *= np.sqrt(weights[0])
            block *= np.sqrt(weights[1:, None])
        self._weight = self.n_effective
        self._fold(block)
        self._folded += new
        kept = self._samples[self._filled - self.depth + 1 : self._filled].copy()
        self._samples[: len(kept)], self._filled = kept, len(kept)

    def _fold(self, block: NDArray[np.float64]) -> None:
        """Replace R by the triangle of [R; block]; both are overwritten, (rows, rows) and (new, rows) by columns."""
        panel = min(PANEL, len(self._R))
        self._R, _, _, info = lapack.dtpqrt(0, panel, self._R, block, overwrite_a=1, overwrite_b=1)
        assert info == 0, info
        self._data = None


def _as_samples(name: str, value: Any) -> torch.Tensor:
    """Return samples as a recording `(T, n)`; one sample may be `(n,)`."""
    tensor = as_data(name, value).detach()
    if tensor.ndim == 1:
        tensor = tensor[None]
    if tensor.ndim != 2 or tensor.shape[1] == 0:
        raise ValueError(
            f"`{name}` must have shape (T, n), time first, or (n,) for one sample, got {tuple(tensor.shape)}."
        )
    return tensor
