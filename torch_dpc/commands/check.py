"""Is a recording good enough to control with? Rank, excitation, and the prediction of samples that were held out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..data.hankel import HankelData, excitation_order
from ..data.predictor import Predictor
from ..errors import ExcitationWarning

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HELD_OUT = 0.25  # share of each recording, its end, that predictions are judged on
#: Predictions are useful if their error at the end of the horizon is below this share of that of the last output, held.
USEFUL = 0.5


@dataclass(frozen=True, eq=False)
class Check:
    """The verdict on a recording.

    Attributes:
        data: of all samples.
        excitation: the order up to which the inputs excite.
        errors: root mean square error of the predictions of held-out samples, `(horizon, n_y)`, in units of the
            standard deviation of each output.
        holding: the same for the simplest prediction, the last measured output.
        shorter, longer: mean error at half and at twice t_ini; NaN where the recordings are too short for it.
        n_held_out: windows the errors were taken over.
    """

    data: HankelData
    excitation: int
    errors: Tensor
    holding: Tensor
    shorter: float
    longer: float
    n_held_out: int

    @property
    def is_exciting(self) -> bool:
        """Whether the inputs excite up to order t_ini + horizon."""
        return self.excitation >= self.data.t_ini + self.data.horizon

    @property
    def is_useful(self) -> bool:
        """Whether every output is predicted better than by half the error of holding its last value."""
        return bool((self.errors[-1] < USEFUL * self.holding[-1]).all())

    @property
    def advice(self) -> list[str]:
        """What to do about it, a sentence each; none if the recording is good."""
        found, mean = [], float(self.errors.mean())
        if not self.is_exciting:
            found.append(
                f"The inputs excite up to order {self.excitation} of {self.data.t_ini + self.data.horizon} (t_ini + "
                "horizon): record longer, or vary every input more and independently."
            )
        if self.longer < 0.8 * mean:
            found.append(
                f"Twice the t_ini predicts better, {100 * self.longer:.3g} % in place of {100 * mean:.3g} %: try "
                f"--t-ini {2 * self.data.t_ini}."
            )
        if not self.is_useful:
            found.append(
                "Predictions are hardly better than the last output, held: there is too much noise, the plant is not "
                "near one operating point, or the inputs hardly move the outputs."
            )
        return found

    def plot(self, names: Sequence[str]) -> Figure:
        """Draw the data, and the held-out errors against the step that is predicted."""
        from .check_picture import draw_check

        return draw_check(self.data, self.errors.numpy(), self.holding.numpy(), self.n_held_out, names)


def check(u: Sequence[Tensor], y: Sequence[Tensor], *, t_ini: int, horizon: int) -> Check:
    """Judge recordings.

    Args:
        u, y: inputs and outputs of each recording, `(T, n_u)` and `(T, n_y)`.
        t_ini, horizon: of the planning problem.

    Raises:
        ValueError: no recording is long enough for a window in both of its parts.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExcitationWarning)  # the verdict says so
        data = HankelData.from_trajectories(list(u), list(y), t_ini=t_ini, horizon=horizon)
        errors, holding, count = _held_out(u, y, t_ini, horizon)
        shorter, longer = (_mean_error(u, y, other, horizon) for other in (t_ini // 2, 2 * t_ini))
    return Check(data, excitation_order(list(u)), errors, holding, shorter, longer, count)


def _mean_error(u: Sequence[Tensor], y: Sequence[Tensor], t_ini: int, horizon: int) -> float:
    """Return the mean error with another t_ini; NaN if that is 0 or the recordings are too short for it."""
    if t_ini < 1 or _parts(u, y, t_ini + horizon) is None:
        return math.nan
    return float(_held_out(u, y, t_ini, horizon)[0].mean())


def _parts(u: Sequence[Tensor], y: Sequence[Tensor], depth: int) -> tuple[list[Tensor], ...] | None:
    """Return the inputs and outputs to learn from, then those held out; None if no recording is long enough."""
    learn_u, learn_y, held_u, held_y = [], [], [], []
    for one_u, one_y in zip(u, y, strict=True):
        cut = round((1 - HELD_OUT) * len(one_u))
        if min(cut, len(one_u) - cut) >= depth:
            learn_u.append(one_u[:cut])
            learn_y.append(one_y[:cut])
            held_u.append(one_u[cut:])
            held_y.append(one_y[cut:])
    return (learn_u, learn_y, held_u, held_y) if learn_u else None


def _held_out(u: Sequence[Tensor], y: Sequence[Tensor], t_ini: int, horizon: int) -> tuple[Tensor, Tensor, int]:
    """Return the errors of the predictions, those of the held output, and the number of windows."""
    parts = _parts(u, y, t_ini + horizon)
    if parts is None:
        least = -(-(t_ini + horizon) // HELD_OUT)
        raise ValueError(
            f"a recording must have at least (t_ini + horizon) / {HELD_OUT} = {least:.0f} samples, so that its last "
            f"quarter holds a window; the longest has {max(map(len, u))}."
        )
    learn_u, learn_y, held_u, held_y = parts
    predictor = Predictor(HankelData.from_trajectories(learn_u, learn_y, t_ini=t_ini, horizon=horizon))
    wrong, held = [], []
    for one_u, one_y in zip(held_u, held_y, strict=True):
        windows_u, windows_y = (x.unfold(0, t_ini + horizon, 1).mT for x in (one_u, one_y))
        future = windows_y[:, t_ini:]
        wrong.append(predictor(windows_u[:, :t_ini], windows_y[:, :t_ini], windows_u[:, t_ini:]) - future)
        held.append(windows_y[:, t_ini - 1 : t_ini] - future)
    size = torch.cat(learn_y).std(0)
    size = torch.where(size > 0, size, 1.0)  # an output that never moves
    errors, holding = (torch.cat(part).square().mean(0).sqrt() / size for part in (wrong, held))
    return errors, holding, len(torch.cat(wrong))
