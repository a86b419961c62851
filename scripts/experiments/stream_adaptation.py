"""A plant that changes while it is controlled: recorded data fixed, and updated as measurements come in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

import torch_dpc as dpc
from scripts.shared.plots import draw_band, note, plt, style
from scripts.shared.rows import Array
from scripts.shared.statistics import BAND

T_INI, HORIZON, REPLAN_EVERY = 4, 12, 3
STEPS, CHANGE = 1000, 200  # 100 s; the springs double at 20 s
RECORDED = 300  # samples before the run
NOISE, DITHER = 1e-3, 0.1  # of each output [m, m/s]; of each input, so that it goes on exciting [N]
FORGETTINGS = (0.0, 0.99, 0.98, 0.95)  # 0 stands for fixed data
SEEDS = 5  # of the recording, the noise and the dither
SMOOTH = 11  # steps of the running median in the figure


def track(forgetting: float, seed: int = 0) -> list[float]:
    """Return the distance of the two masses to their reference at every step [m]."""
    source, y_ref = torch.Generator().manual_seed(seed), torch.tensor([0.5, 0.5, 0.0, 0.0], dtype=torch.float64)
    plant = dpc.systems.OscillatingMasses(damping=0.2, noise=NOISE, generator=source)
    data = dpc.HankelData.from_trajectories(
        *dpc.collect(plant, RECORDED, generator=source), t_ini=T_INI, horizon=HORIZON
    )
    stream = dpc.HankelStream.from_data(data, forgetting=forgetting or 1.0)
    layer = dpc.DPCLayer(data, Q=10.0, R=1e-3, lambda_g=10.0, lambda_s=1e5, u_set=dpc.Box(-3.0, 3.0))
    controller = dpc.DPCController(layer, replan_every=REPLAN_EVERY)
    us: list[torch.Tensor] = []
    ys: list[torch.Tensor] = []
    errors: list[float] = []
    y = plant.reset()
    for k in range(STEPS):
        if k == CHANGE:
            stiff = dpc.systems.OscillatingMasses(spring=2.0, damping=0.2)
            plant.A, plant.B = stiff.A, stiff.B
        u = torch.zeros(2, dtype=torch.float64)
        if k >= T_INI:
            u = controller.step(torch.stack(us[-T_INI:]), torch.stack(ys[-T_INI:]), y_ref=y_ref)
        u = u + DITHER * (2 * torch.rand(2, dtype=torch.float64, generator=source) - 1)
        us.append(u)
        ys.append(y)
        stream.append(u, y)
        if forgetting and controller.replans_now:
            layer.data = stream.data
        errors.append(float((y - y_ref)[:2].norm()))
        y = plant.step(u)
    return errors


def plot(path: Path, errors: Mapping[float, Array]) -> None:
    """Draw the error over time, `(seeds, steps)` for each way of keeping data: median and band over the seeds.

    Each run is smoothed first, by the median over `SMOOTH` steps around each step.
    """
    style()
    figure, axes = plt.subplots(figsize=(6.4, 3.6))
    t = 0.1 * np.arange(STEPS)
    colours = ("black", "#f2a33a", "#c8407a", "#35178c")
    for (forgetting, error), colour in zip(errors.items(), colours, strict=True):
        label = f"updated, forgetting {forgetting:g}" if forgetting else "fixed data"
        padded = np.pad(error, ((0, 0), (SMOOTH // 2, SMOOTH // 2)), mode="edge")
        around = np.median(np.lib.stride_tricks.sliding_window_view(padded, SMOOTH, axis=1), axis=2)
        draw_band(axes, t, around, color=colour, linewidth=1.2, label=label)
    axes.axvline(0.1 * CHANGE, color="grey", linewidth=1, linestyle=(0, (4, 2)))
    axes.annotate("the springs double", (0.1 * CHANGE, 6e-4), (4, 0), textcoords="offset points", fontsize=9)
    seeds = len(next(iter(errors.values())))
    text = f"median of {seeds} seeds, band: {BAND[0]}th to {BAND[1]}th percentile; each run smoothed by a median over "
    note(axes, text + f"{0.1 * SMOOTH:.1f} s", "upper right")
    axes.set(xlabel="time [s]", ylabel="distance to the reference [m]", xlim=(0, t[-1]), ylim=(5e-4, 5), yscale="log")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=9)
    figure.savefig(path)
    plt.close(figure)
