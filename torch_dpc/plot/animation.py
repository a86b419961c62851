"""Runs as a film."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter, writers
from matplotlib.figure import Figure

from ..checks import check_has
from .figure import BLUE, GREY, as_array, names_of, panels, styled
from .runs import log as draw_log

FRAMES = 120  # at most; longer runs skip steps


@styled
def animate(
    log: Any,
    path: str | os.PathLike[str],
    *,
    plane: tuple[int, int] | None = None,
    layer: Any = None,
    y_names: Sequence[str] | None = None,
    u_names: Sequence[str] | None = None,
    fps: int = 20,
) -> Path:
    """Write a film of a run: the panels of `log.plot` growing in time, or the path through two outputs.

    Args:
        log: a :class:`torch_dpc.ClosedLoopLog`.
        path: of the film; ".gif" needs nothing else, other kinds (".mp4") need ffmpeg.
        plane: two outputs, such as (0, 1) for x and y, whose path is drawn in their plane, with the reference; of a
            batch every run is a point.
        layer: the controller's layer, whose bounds are drawn in the panels.
        y_names, u_names: of the channels, with units.
        fps: frames a second.

    Returns:
        The path.

    Raises:
        ValueError: outputs that do not exist.
        RuntimeError: a film of this kind needs ffmpeg, which is missing.
    """
    check_has("log", log, "a ClosedLoopLog", "t", "u", "y", "y_ref", "p")
    path, steps = Path(path), len(log.t)
    if path.suffix != ".gif" and not writers.is_available("ffmpeg"):
        raise RuntimeError(f"a film of kind {path.suffix!r} needs ffmpeg, which was not found; use .gif.")
    if plane is None:
        figure, draw = _panels(log, layer, y_names, u_names)
    else:
        figure, draw = _plane(log, plane, y_names)
    frames = np.unique(np.linspace(1, steps, min(steps, FRAMES)).round().astype(int))
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # laid out once, for every frame
    try:
        film = FuncAnimation(figure, draw, frames=list(frames), blit=False)
        film.save(path, writer=PillowWriter(fps=fps) if path.suffix == ".gif" else "ffmpeg", dpi=90)
    finally:
        plt.close(figure)
    return path


def _panels(log: Any, layer: Any, y_names: Sequence[str] | None, u_names: Sequence[str] | None) -> tuple[Figure, Any]:
    """Return the figure of the whole run, and what covers the steps that are still to come."""
    figure = draw_log(log, layer=layer, y_names=y_names, u_names=u_names)
    t = as_array(log.t)
    covers = []
    for axes in figure.axes:
        axes.set_xlim(t[0], t[-1])
        axes.set_ylim(axes.get_ylim())
        covers.append(axes.axvspan(t[0], t[-1], color="white", alpha=0.9, zorder=5, linewidth=0))

    def draw(step: int) -> list[Any]:
        for cover in covers:
            cover.set_x(t[step - 1])
            cover.set_width(t[-1] - t[step - 1])
        return covers

    return figure, draw


def _plane(log: Any, plane: tuple[int, int], y_names: Sequence[str] | None) -> tuple[Figure, Any]:
    """Return a figure with the reference path, and what moves the runs along theirs."""
    y, y_ref, t = as_array(log.y), as_array(log.y_ref), as_array(log.t)
    n_y = y.shape[-1]
    if len(plane) != 2 or not all(0 <= i < n_y for i in plane):
        raise ValueError(f"`plane` must name two of the outputs 0 to {n_y - 1}, got {plane!r}.")
    names = names_of(y_names, n_y, "y")
    runs = y.reshape(-1, *y.shape[-2:])[..., list(plane)]
    reference = y_ref.reshape(-1, *y_ref.shape[-2:])[0][:, list(plane)]
    figure, (axes,) = panels(None, 1, 1, 1, (4.6, 4.6))
    axes.plot(*reference.T, color=GREY, linestyle="--", linewidth=1.0, label="reference")
    everything = np.concatenate([runs.reshape(-1, 2), reference])
    low, high = np.nanmin(everything, 0), np.nanmax(everything, 0)
    margin = 0.08 * max((high - low).max(), 1e-9)
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    axes.set_aspect("equal")
    axes.set(xlabel=names[plane[0]], ylabel=names[plane[1]])
    thin: dict[str, Any] = {"linewidth": 1.2 if len(runs) == 1 else 0.6, "alpha": 1.0 if len(runs) == 1 else 0.5}
    paths = [axes.plot([], [], color=BLUE, **thin)[0] for _ in runs]
    (heads,) = axes.plot([], [], "o", color=BLUE, markersize=6 if len(runs) == 1 else 3, label="run")
    axes.legend(loc="upper right")

    def draw(step: int) -> list[Any]:
        for line, run in zip(paths, runs, strict=True):
            line.set_data(*run[:step].T)
        heads.set_data(runs[:, step - 1, 0], runs[:, step - 1, 1])
        axes.set_title(f"{t[step - 1]:.1f} s")
        return [*paths, heads]

    return figure, draw
