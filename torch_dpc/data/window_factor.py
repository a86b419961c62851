"""Windows of data folded into a triangular factor, one after another, and forgotten.

With D = [Up; Yp; Uf; Yf], a column each window, the problem depends on D through D D' alone. A QR factorisation of the
windows as rows, D' = B R with B'B = I, therefore keeps all there is to know in R, (t_ini + horizon)(n_u + n_y) square
however long the recording: R'R = D D' and L = R' stands for D. More windows D_2' are folded in by the QR of [R; D_2'],
by orthogonal transformations alone. D D' itself is never formed: that would square the condition.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from ..checks import as_data, check_count
from .rank import has_full_row_rank, relative_tolerance

#: Windows folded at once. 256 and more cost the same a window; the memory grows with them.
BLOCK = 512
#: Columns of a panel of LAPACK's blocked QR, the fastest of 8, 16, 32 and 64 at 186 and 279 rows.
PANEL = 16


class WindowFactor:
    """The triangular factor of all complete windows of a recording that grows, in constant memory.

    Every complete window is folded into a triangle of r = (t_ini + horizon)(n_u + n_y) rows, in O(r^2), and is then
    gone. A forgetting factor f < 1 multiplies the columns of all older windows by sqrt(f) at each new one.

    Args:
        t_ini: steps that fix the initial condition.
        horizon: steps that are planned.
        forgetting: f, in (0, 1].
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
    def n_u(self) -> int:
        """Inputs of the system; 0 before the first samples."""
        return self._n_u

    @property
    def n_y(self) -> int:
        """Outputs of the system; 0 before the first samples."""
        return self._n_y

    @property
    def recorded_as(self) -> torch.dtype:
        """The precision of the recordings, the least so far."""
        return self._dtype

    def factor(self) -> tuple[torch.Tensor, ...]:
        """Return Up, Yp, Uf, Yf, the rows of L with L L' = D D', float64.

        Raises:
            ValueError: no window is complete yet.
        """
        if self.n_windows == 0:
            raise ValueError(
                f"a window has t_ini + horizon = {self.depth} samples of one recording, and no recording was that long."
            )
        self._fold_pending()
        # Fewer windows than rows leave the last rows of R at rounding.
        L = torch.from_numpy(self._R[: min(len(self._R), self.n_windows)].T.copy())
        return L.split(self._rows)

    @property
    def excitation_order(self) -> int:
        """The order, up to t_ini + horizon, of which the inputs seen are persistently exciting, weighted.

        Below t_ini + horizon the data do not hold every trajectory of the system.
        """
        if self.n_windows == 0:
            return 0
        Up, _, Uf, _ = self.factor()
        U, low, high = torch.cat([Up, Uf]), 0, self.depth
        while low < high:  # full row rank at depth L implies it at every smaller depth: bisect
            middle = (low + high + 1) // 2
            full = has_full_row_rank(U[: middle * self._n_u], relative_tolerance(self._dtype))
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
        self._R, _, _, info = scipy.linalg.lapack.dtpqrt(0, panel, self._R, block, overwrite_a=1, overwrite_b=1)
        assert info == 0, info


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
