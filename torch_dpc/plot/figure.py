"""What the figures share: axes in, figure out; colours, bands over runs, and channels with their names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Okabe and Ito: apart for every kind of colour vision.
BLUE, VERMILION, GREEN, ORANGE, PURPLE = "#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, "#56b4e9", "black")
GREY = "0.45"


@contextmanager
def _in_style() -> Iterator[None]:
    """Draw with the look of the figures. The interactive mode, which a first figure may set, is not undone."""
    look = matplotlib.rc_context(
        {
            "figure.constrained_layout.use": True,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "grid.alpha": 0.25,
            "grid.linewidth": 0.6,
            "axes.axisbelow": True,
            "axes.titlesize": "medium",
            "legend.frameon": False,
            "lines.linewidth": 1.5,
        }
    )
    interactive = matplotlib.is_interactive()
    try:
        with look:
            yield
            interactive = matplotlib.is_interactive()
    finally:
        matplotlib.interactive(interactive)


#: Around every function that draws; the user's own settings stay as they are.
styled = _in_style()

#: Runs of a batch that are drawn line by line; more are drawn as their median and the band that holds most of them.
FEW_RUNS = 8
BAND = (10, 90)  # percentiles
NEAR = 0.5  # bounds within this share of the height of the axes are drawn
BAND_LABEL = "median and 10 to 90 %"


class NotebookFigure(Figure):
    """A figure that a notebook shows once: as the value of a cell, or else after it.

    The inline backend shows and closes every open figure after a cell. One that was the value of the cell would come
    twice, so it is closed as soon as it is shown.
    """

    def _ipython_display_(self) -> None:
        if "inline" in matplotlib.get_backend():
            plt.close(self)
        raise NotImplementedError  # IPython then shows it in its usual way


def new_figure(size: tuple[float, float]) -> Figure:
    """Return an empty figure of a size [inch]."""
    return plt.figure(figsize=size, FigureClass=NotebookFigure)


def panels(
    axes: Any, count: int, rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes: those that were given, or new ones on a grid, read column by column.

    Args:
        axes: one `Axes`, or a sequence or array of as many as are needed; None for a new figure.
        count: how many are needed.
        rows, columns: of the grid of a new figure.
        size: of a new figure [inch].
        options: of `Figure.subplots`.

    Raises:
        ValueError: another number of axes.
    """
    if axes is None:
        figure = new_figure(size)
        grid = figure.subplots(rows, columns, squeeze=False, **options).T.reshape(-1)
        for spare in grid[count:]:
            spare.remove()
        return figure, list(grid[:count])
    given = list(np.atleast_1d(np.asarray(axes, dtype=object)).reshape(-1))
    if len(given) != count or not all(isinstance(one, Axes) for one in given):
        raise ValueError(f"`axes` must be {count} matplotlib axes, got {len(given)} of {type(given[0]).__name__}.")
    root = given[0].figure
    return (root if isinstance(root, Figure) else root.figure), given


def as_array(values: Any) -> Array:
    """Return a tensor, with or without a graph, or an array as float64 NumPy."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=np.float64)


def names_of(given: Sequence[str] | None, count: int, letter: str) -> list[str]:
    """Return the labels of channels: those given, or y0, y1, ...

    Raises:
        ValueError: another number of names.
    """
    if given is None:
        return [f"{letter}{i}" for i in range(count)]
    if len(given) != count:
        raise ValueError(f"`{letter}_names` must have one name for each of the {count} channels, got {list(given)!r}.")
    return list(given)


def draw_runs(axes: Axes, x: Array, values: Array, **line: Any) -> None:
    """Draw one run `(steps,)`, or many `(runs, steps)`: few as lines, more as median and band."""
    if values.ndim == 1:
        axes.plot(x, values, **line)
    elif len(values) <= FEW_RUNS:
        thin = {**line, "alpha": 0.7, "linewidth": 1.0}
        for i, run in enumerate(values):
            axes.plot(x, run, **{**thin, "label": line.get("label") if i == 0 else None})
    else:
        low, high = np.nanpercentile(values, BAND, axis=0)
        step: Any = "post" if line.get("drawstyle") == "steps-post" else None
        axes.fill_between(x, low, high, color=line.get("color"), alpha=0.2, linewidth=0, step=step)
        axes.plot(x, np.nanmedian(values, axis=0), **line)


def draw_bounds(axes: Axes, x: Array, *bounds: Array) -> None:
    """Draw those of a channel's bounds that lie near what the axes show; the others would flatten it."""
    low, high = axes.get_ylim()
    reach = NEAR * (high - low)
    label: str | None = "bound"
    for bound in bounds:
        if low - reach <= float(bound) <= high + reach:
            axes.plot(x[[0, -1]], [bound, bound], color=GREY, linestyle=":", linewidth=1.2, label=label)
            label = None


def legend_of(figure: Figure, axes: Sequence[Axes], title: str | None = None) -> None:
    """Put one legend above all axes, each label once."""
    found: dict[str, Any] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    order = sorted(found, key=lambda label: label in ("plan made", "bound"))
    handles = [found[label] for label in order]
    figure.legend(handles, order, loc="outside upper center", ncols=6, title=title, columnspacing=1.4)
