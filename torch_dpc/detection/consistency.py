"""Consistency of a window with the recorded data."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..checks import as_index, check_type, window
from ..data.hankel import HankelData
from ..data.recordings import as_recordings, hankel
from ..reprs import shown
from ..shapes import broadcast_shapes
from .cusum import Cusum, rate

#: The residual of noise-free data is rounding. It is measured in this fraction of the largest singular value.
RESIDUAL_FLOOR = 1e-8
#: Where the residual can judge, so many times the usual energy count as one usual residual. The energy of a run depends
#: on its course: that of an undamped plant grows with time, and differs from recording to recording.
ENERGY_ROOM = 100.0


class WindowStatistic(NamedTuple):
    """How unusual a window is; larger is more unusual.

    - `energy`: T2 = n |W1^+ w|^2, the size of the window in the metric of the recorded windows, `(*batch,)`.
    - `residual`: the squared distance from the recorded windows, whitened by what the data leave there, `(*batch,)`.
    """

    energy: Tensor
    residual: Tensor

    def __repr__(self) -> str:
        return f"WindowStatistic(energy={shown(self.energy)}, residual={shown(self.residual)})"


class ConsistencyDetector:
    """Judge a window w = (u_ini, y_ini) by the recorded windows W = [Up; Yp].

    The channels are brought to one scale, and W / sqrt(n) = U S V' over the n recorded windows. The first `rank` left
    singular vectors span what the system does, the others what noise adds:

        energy   = sum over i <= rank of (u_i'w / s_i)^2,
        residual = sum over i > rank of  (u_i'w / max(s_i, 1e-8 s_1))^2.

    For noise-free data the residual of a window is 0 exactly where it is a trajectory of the system. For noisy data it
    is the Mahalanobis distance of the noise. The score that alarms at 1 is energy / a + residual / b; a, b and the
    level come from clean windows (:meth:`calibrate`). For noisy data the residual decides, and a is wide: the energy
    alarms only far beyond the usual. For noise-free data the energy decides among the trajectories of the system, so
    the stated rate holds for runs like those of the calibration.

    Args:
        data: the recording.
        rank: dimensions of the system's windows, at most t_ini n_u + the order of the system. By default the data's own
            rank where noise-free, else the place of the largest drop of the singular values after t_ini n_u.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 600, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u[:300], y[:300], t_ini=4, horizon=10)
        >>> detector = ConsistencyDetector(data).calibrate(u[300:], y[300:], false_alarms=0.05)
        >>> false_sensor = y[300:304] + 0.1 * torch.randn(4, 4, dtype=torch.float64, generator=generator)
        >>> bool(detector.alarms(u[300:304], false_sensor)), bool(detector.alarms(u[300:304], y[300:304]))
        (True, False)
    """

    def __init__(self, data: HankelData, *, rank: int | None = None):
        check_type("data", data, HankelData)
        rows = data.t_ini * (data.n_u + data.n_y)
        rule = f"`rank` must be an integer from 1 to {rows}"
        if rank is not None and not 1 <= as_index(rule, rank) <= rows:
            raise ValueError(f"{rule}, got {rank!r}.")
        self.t_ini, self.n_u, self.n_y = data.t_ini, data.n_u, data.n_y
        with torch.no_grad():
            W = torch.cat([data.Up, data.Yp]).detach().double()
            by_channel = [part.reshape(self.t_ini, -1, W.shape[1]) for part in W.split([len(data.Up), len(data.Yp)])]
            sizes = [part.square().mean((0, 2)).sqrt().repeat(self.t_ini) for part in by_channel]
            size = torch.cat(sizes) / math.sqrt(data.n_windows / W.shape[1])
            size = torch.where(size > 0, size, 1.0)
            U, S, _ = torch.linalg.svd(W / size[:, None] / math.sqrt(data.n_windows), full_matrices=True)
        singular = torch.zeros(len(W), dtype=torch.float64)
        singular[: len(S)] = S
        self.is_noisy = bool(singular[-1] > data.rank_tolerance * singular[0])
        self.rank = _rank(singular, self.t_ini * self.n_u, data.rank_tolerance) if rank is None else rank
        whitening = U / singular.clamp_min(RESIDUAL_FLOOR * singular[0]) / size[:, None]
        #: Maps of a flattened window to the energy's and the residual's coordinates.
        self.to_energy, self.to_residual = whitening[:, : self.rank].mT, whitening[:, self.rank :].mT
        self.scale: tuple[float, float] | None = None

    def statistic(self, u_ini: Any, y_ini: Any) -> WindowStatistic:
        """Return energy and residual of windows `(*batch, t_ini, n)`, float64."""
        w = self._flat(u_ini, y_ini)
        return WindowStatistic(
            (w @ self.to_energy.mT.to(w.device)).square().sum(-1),
            (w @ self.to_residual.mT.to(w.device)).square().sum(-1),
        )

    def calibrate(self, u: Any, y: Any, *, false_alarms: float = 0.01) -> ConsistencyDetector:
        """Set the level of alarm by clean recordings that the detector has not seen, and return the detector.

        The level is the smallest that at most `false_alarms` of their windows exceed, counted conservatively: with n
        windows the ceil((n + 1)(1 - false_alarms))-th smallest score.

        Args:
            u, y: a recording or a list of recordings, `(T, n)`, of the use that is to be watched.
            false_alarms: rate, between 0 and 1.

        Raises:
            ValueError: too few windows for the rate, or shapes that do not fit.
        """
        false_alarms = rate("false_alarms", false_alarms)
        u_ini, y_ini = self.windows(u, y)
        needed = math.ceil((len(u_ini) + 1) * (1 - false_alarms))
        if needed > len(u_ini):
            raise ValueError(
                f"`false_alarms` = {false_alarms} needs at least {math.ceil(1 / false_alarms) - 1} windows, got "
                f"{len(u_ini)}."
            )
        energy, residual = self.statistic(u_ini, y_ini)
        a = float(energy.kthvalue(needed).values.clamp_min(1e-300)) * (ENERGY_ROOM if self.is_noisy else 1.0)
        b = float(residual.kthvalue(needed).values.clamp_min(1.0))  # rounding is never more than usual
        level = float((energy / a + residual / b).kthvalue(needed).values)
        self.scale = a * level, b * level
        self.clean_scores = self.score(u_ini, y_ini)
        return self

    def score(self, u_ini: Any, y_ini: Any) -> Tensor:
        """Return what alarms above 1, `(*batch,)`, float64.

        Raises:
            ValueError: the detector is not calibrated.
        """
        a, b = self._calibrated()
        energy, residual = self.statistic(u_ini, y_ini)
        return energy / a + residual / b

    def alarms(self, u_ini: Any, y_ini: Any) -> Tensor:
        """Return whether windows alarm, boolean, `(*batch,)`."""
        return self.score(u_ini, y_ini) > 1.0

    def monitor(self) -> Callable[[Tensor, Tensor], Tensor]:
        """Return what :func:`torch_dpc.simulate` asks for an alarm at every plan."""
        self._calibrated()
        return self.alarms

    def cusum(self, drift: float | None = None, *, false_alarms: float = 0.01) -> Cusum:
        """Return a detector of small persistent changes, calibrated on the clean windows of :meth:`calibrate`.

        Args:
            drift: what a usual step subtracts; by default the mean of the clean scores and half their deviation.
            false_alarms: rate of clean steps that alarm.
        """
        self._calibrated()
        return Cusum.calibrated(self.score, self.clean_scores, drift, false_alarms)

    def maps(self) -> tuple[Tensor, Tensor]:
        """Return E_u, E_y of score = |E_u u_ini + E_y y_ini|^2, flattened windows."""
        a, b = self._calibrated()
        E = torch.cat([self.to_energy / math.sqrt(a), self.to_residual / math.sqrt(b)])
        past = self.t_ini * self.n_u
        return E[:, :past], E[:, past:]

    def windows(self, u: Any, y: Any) -> tuple[Tensor, Tensor]:
        """Return all windows of recordings, `(n, t_ini, n_u)` and `(n, t_ini, n_y)`."""
        us, ys = as_recordings(u, y)
        if us[0].shape[1] != self.n_u or ys[0].shape[1] != self.n_y:
            raise ValueError(
                f"`u` and `y` must have {self.n_u} and {self.n_y} channels, got {us[0].shape[1]} and {ys[0].shape[1]}."
            )
        long = [i for i, one in enumerate(us) if len(one) >= self.t_ini]
        if not long:
            raise ValueError(f"`u` must hold a recording of at least t_ini = {self.t_ini} samples.")
        return tuple(  # type: ignore[return-value]
            torch.cat([hankel(many[i].double(), self.t_ini).mT.reshape(-1, self.t_ini, n) for i in long])
            for many, n in ((us, self.n_u), (ys, self.n_y))
        )

    def _flat(self, u_ini: Any, y_ini: Any) -> Tensor:
        u_ini = window("u_ini", u_ini, self.t_ini, self.n_u, "n_u").double()
        y_ini = window("y_ini", y_ini, self.t_ini, self.n_y, "n_y").double()
        batch = broadcast_shapes(u_ini.shape[:-2], y_ini.shape[:-2])
        return torch.cat([x.flatten(-2).expand(*batch, -1) for x in (u_ini, y_ini)], dim=-1)

    def _calibrated(self) -> tuple[float, float]:
        if self.scale is None:
            raise ValueError("the detector has no level of alarm: call calibrate(u, y, false_alarms=...) first.")
        return self.scale

    def __repr__(self) -> str:
        level = "not calibrated" if self.scale is None else "calibrated"
        rows = self.t_ini * (self.n_u + self.n_y)
        return f"ConsistencyDetector(t_ini={self.t_ini}, rank={self.rank} of {rows}, {level})"


def _rank(singular: Tensor, inputs: int, tolerance: float) -> int:
    """Return where the singular values of the windows turn from the system's into the noise's."""
    kept = int((singular > tolerance * singular[0]).sum())
    if kept < len(singular):
        return kept
    first = min(inputs, len(singular) - 1)
    drops = (singular[first - 1 : -1] / singular[first:]).log()
    return first + int(drops.argmax())
