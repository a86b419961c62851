"""What the figures share: a colour-blind-safe style, bands over the seeds, and the two panels of Figures 3 and 4."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # files only: no display needed

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.ticker import MultipleLocator  # noqa: E402

from scripts.shared.rows import Array, Rows, grid
from scripts.shared.statistics import BAND, NOMINAL, POISON, RANDOM, band

# Light to dark as rho grows, and apart in hue as well, for every kind of colour vision and in grey.
RHO_COLOURS = ("#f2a33a", "#c8407a", "#35178c")
# Okabe and Ito's blue and vermilion.
COLOURS = {NOMINAL: "black", RANDOM: "#0072b2", POISON: "#d55e00"}
NOTE_SIZE = 8  # [points], of notes inside the axes and of legends there
NAMES = {NOMINAL: "no attack", RANDOM: "random noise", POISON: "Algorithm 1"}


def style() -> None:
    """Set fonts, sizes and spines."""
    plt.rcParams.update(
        {
            "figure.dpi": 100,
            "savefig.dpi": 200,
            "figure.constrained_layout.use": True,
            "figure.constrained_layout.w_pad": 0.1,
            "font.size": 10,
            "axes.titlesize": 11,
            "xtick.major.size": 0,
            "ytick.major.size": 0,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "grid.alpha": 0.25,
            "grid.linewidth": 0.6,
            "legend.frameon": False,
            "lines.linewidth": 1.6,
        }
    )


def draw_band(axes: Axes, x: Array, values: Array, **line: Any) -> None:
    """Draw the median over the seeds, the first axis of values, and the band around it."""
    median, low, high = band(values)
    (drawn,) = axes.plot(x, median, **line)
    axes.fill_between(x, low, high, color=drawn.get_color(), alpha=0.2, linewidth=0)


def note(axes: Axes, text: str, corner: str = "upper left") -> None:
    """Write inside the axes, in a corner, what lines, bands and bars are."""
    vertical, horizontal = corner.split()
    x, y = (0.02 if horizontal == "left" else 0.98), (0.98 if vertical == "upper" else 0.02)
    look: dict[str, Any] = {
        "va": "top" if vertical == "upper" else "bottom",
        "ha": horizontal,
        "fontsize": NOTE_SIZE,
        "color": "0.3",
    }
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.5}
    axes.text(x, y, text, transform=axes.transAxes, bbox=box, zorder=5, **look)


def say_band(axes: Axes, seeds: int, corner: str = "upper left") -> None:
    """Write inside the axes that a line is the median and how wide the band is."""
    note(axes, f"median of {seeds} seeds, band: {BAND[0]}th to {BAND[1]}th percentile", corner)


def percent(rho: float) -> str:
    """Return rho as a percentage with two digits."""
    return f"{float(f'{100 * rho:.2g}'):g} %"


def error_panels(path: Path, rows: Rows, rhos: Sequence[float], ylabel: str) -> None:
    """Draw the tracking error in time, random noise and Algorithm 1 side by side on one scale, with the nominal run."""
    style()
    figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.4), sharex=True, sharey=True)
    t = grid(rows, "t", NOMINAL, 0.0)[0]
    for axes, attack in zip(panels, (RANDOM, POISON), strict=True):
        for rho, colour in zip(rhos, RHO_COLOURS, strict=True):
            errors = grid(rows, "error", attack, rho)
            draw_band(axes, t, errors, color=colour, label=rf"$\rho$ = {percent(rho)}")
            for i, step in crash_steps(rows, attack, rho):
                axes.plot(t[step], errors[i, step], "x", color=colour, markersize=8, markeredgewidth=2)
        nominal = grid(rows, "error", NOMINAL, 0.0)
        draw_band(axes, t, nominal, color=COLOURS[NOMINAL], linestyle=(0, (4, 2)), label=NAMES[NOMINAL])
        axes.set(title=NAMES[attack], xlabel="time [s]", xlim=(0, round(t[-1])))
    panels[0].xaxis.set_major_locator(MultipleLocator(5))
    panels[0].set_ylabel(ylabel)
    panels[0].set_ylim(bottom=-0.02 * panels[0].get_ylim()[1])  # room for a line at zero
    say_band(panels[0], len(np.unique(rows["seed"])))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    figure.savefig(path)
    plt.close(figure)


def crash_steps(rows: Rows, attack: str, rho: float) -> list[tuple[int, int]]:
    """Return the index of each run that ended in a crash, and the step of the crash."""
    if "crashed" not in rows:
        return []
    return [(i, int(down.argmax())) for i, down in enumerate(grid(rows, "crashed", attack, rho) > 0) if down.any()]


def paths_from_above(path: Path, rows: Rows, rho: float, reference: Array) -> None:
    """Draw the paths flown in the xy-plane: no attack, random noise and Algorithm 1, one line a seed."""
    style()
    figure, panels = plt.subplots(1, 3, figsize=(8.4, 3.5), sharex=True, sharey=True)
    seeds = len(np.unique(rows["seed"]))
    for axes, (attack, level) in zip(panels, ((NOMINAL, 0.0), (RANDOM, rho), (POISON, rho)), strict=True):
        x, y = grid(rows, "x", attack, level), grid(rows, "y", attack, level)
        axes.plot(x.T, y.T, color="#0072b2", linewidth=0.8, alpha=0.6)
        axes.plot([], [], color="#0072b2", label=f"flown, one line for each of {seeds} seeds")
        axes.plot(reference[:, 0], reference[:, 1], "k--", linewidth=1.2, label="reference")
        for i, step in crash_steps(rows, attack, level):
            axes.plot(x[i, step], y[i, step], "x", color="#d55e00", markersize=8, markeredgewidth=2)
        axes.set_title(NAMES[attack] + (f", $\\rho$ = {percent(level)}" if level else ""))
        axes.set_xlabel("x [m]")
        axes.set_aspect("equal")
        axes.xaxis.set_major_locator(MultipleLocator(0.5))
        axes.yaxis.set_major_locator(MultipleLocator(0.5))
    panels[0].set_ylabel("y [m]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    figure.savefig(path)
    plt.close(figure)
