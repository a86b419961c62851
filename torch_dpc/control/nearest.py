"""Plan from the recorded windows nearest to the present one: predictive control of nonlinear systems."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..checks import check_count, one_batch, window
from ..data.hankel import HankelData
from ..data.hankel_batch import HankelBatch
from ..layer import DPCLayer
from ..solution import DPCSolution


class NearestWindows:
    """A planner that chooses, at every call and for every sample, the k windows nearest to the present one.

    A linear combination of windows describes a nonlinear system only where the windows are near each other: the chosen
    ones linearise it around the present (Naef, Moffat, Eising, Doerfler, "Choose wisely: data-driven predictive control
    for nonlinear systems using online data selection", arXiv:2503.18845, the selection by norm). In the first round
    only the past is compared; each further round compares the past and the plan of the round before. Distances are
    Euclidean, each channel in units of its standard deviation in the recording.

    It is called like its layer and takes its place in a :class:`torch_dpc.DPCController`. A batch of samples is one
    batch of small problems (:class:`torch_dpc.HankelBatch`). Plans are differentiable; the choice of windows counts as
    fixed.

    Args:
        layer: the problem, with the recording to choose from; usually with `affine=True` and
            `regularizer="identity"`, because few windows leave the projection nothing to charge.
        k: windows that are chosen.
        rounds: choices that are made for one plan.

    Raises:
        ValueError: a batch of data sets, compact data, or fewer windows than k.

    Example:
        >>> from torch_dpc import HankelData, collect, simulate, systems
        >>> from torch_dpc.control.controller import DPCController
        >>> plant, generator = systems.CartPole(), torch.Generator().manual_seed(0)
        >>> data = HankelData.from_trajectories(*collect(plant, 120, generator=generator), t_ini=2, horizon=10)
        >>> layer = DPCLayer(data, Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e4, affine=True, regularizer="identity")
        >>> NearestWindows(layer, k=50)(torch.zeros(2, 1), torch.zeros(2, 4)).u.shape
        torch.Size([10, 1])
    """

    def __init__(self, layer: DPCLayer, k: int, *, rounds: int = 2):
        data = layer.data
        if not isinstance(data, HankelData) or not data.has_windows:
            raise ValueError(f"`layer` must hold the recorded windows of one data set, got {data!r}.")
        if check_count("k", k) > data.n_windows:
            raise ValueError(f"`k` must be at most the number of recorded windows, {data.n_windows}, got {k}.")
        self.layer, self.data, self.k = layer, data, k
        self.rounds = check_count("rounds", rounds)
        windows = torch.cat([m.detach().double() for m in (data.Up, data.Yp, data.Uf, data.Yf)])
        windows = windows[:, : data.n_windows]
        self._units = _deviations(data, windows)
        self._windows = windows / self._units[:, None]

    @property
    def u_set(self) -> Any:
        """The input set of the layer."""
        return self.layer.u_set

    def __call__(
        self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None, on_failure: str | None = None
    ) -> DPCSolution:
        """Plan from the last `t_ini` inputs and outputs; arguments, result and errors are those of the layer.

        `g` weighs the k chosen windows.
        """
        data = self.data
        u_past = window("u_ini", u_ini, data.t_ini, data.n_u, "n_u").detach().double().flatten(-2)
        y_past = window("y_ini", y_ini, data.t_ini, data.n_y, "n_y").detach().double().flatten(-2)
        batch = one_batch([("u_ini", u_past.shape[:-1]), ("y_ini", y_past.shape[:-1])])
        if len(batch) > 1:
            raise ValueError(f"`u_ini` and `y_ini` must have at most one batch dimension, got {tuple(batch)}.")
        past = torch.cat([u_past.expand(*batch, -1), y_past.expand(*batch, -1)], dim=-1)
        distance = self._distance(past, slice(0, past.shape[-1]))
        to_choose = distance
        for _ in range(self.rounds - 1):
            plan = self._near(to_choose)(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref, on_failure="nan")
            future = torch.cat([plan.u.detach().flatten(-2), plan.y.detach().flatten(-2)], dim=-1).double()
            further = self._distance(future, slice(past.shape[-1], None))
            to_choose = torch.where(further.isfinite(), distance + further, distance)  # without a plan: by the past
        on_failure = self.layer.on_failure if on_failure is None else on_failure
        planned: DPCSolution = self._near(to_choose)(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref, on_failure=on_failure)
        return planned

    def _distance(self, values: Tensor, rows: slice) -> Tensor:
        """Return the squared distance of some entries of a window, `(*batch, n)`, to each recorded one."""
        scaled = (values / self._units[rows]).reshape(-1, values.shape[-1])
        # By differences: the expanded square loses small distances between large values.
        distance = torch.cdist(scaled, self._windows[rows].mT, compute_mode="donot_use_mm_for_euclid_dist").square()
        return distance[0] if values.ndim == 1 else distance

    def _near(self, distance: Tensor) -> DPCLayer:
        """Return the problem on the k nearest windows of each sample, `(*batch, n_g)` distances."""
        chosen = distance.topk(self.k, largest=False).indices.sort().values
        data: HankelData | HankelBatch
        data = self._part(chosen) if chosen.ndim == 1 else HankelBatch(self._part(one) for one in chosen)
        return DPCLayer(data, **self.layer.config())

    def _part(self, chosen: Tensor) -> HankelData:
        data = self.data
        share = math.sqrt(self.k / data.n_windows)  # a ridge is that of the chosen windows
        matrices = (data.Up, data.Uf, data.Yp, data.Yf)
        Up, Uf, Yp, Yf = (torch.cat([m[:, chosen], share * m[:, data.n_windows :]], dim=1) for m in matrices)
        return replace(data, Up=Up, Uf=Uf, Yp=Yp, Yf=Yf)

    def __repr__(self) -> str:
        return f"NearestWindows(k={self.k} of {self.data.n_windows} windows, rounds={self.rounds})"


def _deviations(data: HankelData, windows: Tensor) -> Tensor:
    """Return the standard deviation of each row's channel, 1 for a channel that stands still, `(rows,)`."""
    past, future = data.t_ini, data.horizon
    parts = windows.split([past * data.n_u, past * data.n_y, future * data.n_u, future * data.n_y])

    def of(n: int, *rows: Tensor) -> Tensor:
        samples = torch.cat([part.reshape(-1, n, part.shape[-1]) for part in rows])
        deviation = samples.transpose(0, 1).flatten(1).std(dim=1, correction=0)
        return torch.where(deviation > 0, deviation, 1.0)

    u, y = of(data.n_u, parts[0], parts[2]), of(data.n_y, parts[1], parts[3])
    return torch.cat([u.repeat(past), y.repeat(past), u.repeat(future), y.repeat(future)])
