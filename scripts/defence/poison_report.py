"""Tables and picture of study_poisoned_data.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator

from scripts.defence.poison import CASES, CLEAN, METHODS, NOISE, NOISES, RIDGED, WITH_RIDGE
from scripts.shared import bootstrap
from scripts.shared.plots import draw_band, plt, style
from scripts.shared.rows import Array

Lines = Sequence[Mapping[str, str]]
NAMES = {CLEAN: "clean recording", NOISE: "random noise", **METHODS}
COLOURS = {NOISE: "#0072b2", "random": "#cc79a7", "influence": "#d55e00", "greedy": "#35178c"}


def errors(rows: Lines, plant: str, noise: float, method: str, count: int, column: str = "error") -> Array:
    """Return a column by seed."""
    keys = (plant, noise, method, count)
    found = {
        int(row["seed"]): float(row[column])
        for row in rows
        if (row["plant"], float(row["noise"]), row["method"], int(row["count"])) == keys
    }
    return np.array([found[seed] for seed in sorted(found)])


def counts_of(rows: Lines) -> list[int]:
    """Return how many samples were poisoned."""
    return sorted({int(row["count"]) for row in rows} - {0})


def report(rows: Lines) -> list[str]:
    """Return the lines of study_poisoned_data.md."""
    lines = ["# Poisoned recordings", ""]
    lines += ["Changes are paired differences from the clean recording, with 95 % bootstrap intervals."]
    for plant, case in CASES.items():
        for noise in NOISES:
            clean = errors(rows, plant, noise, CLEAN, 0)
            if len(clean):
                title = case.title[0].upper() + case.title[1:].split(",")[0]
                recorded = f"recorded with noise of {noise:g} of the spread" if noise else "recorded without noise"
                lines += ["", f"## {title}, {recorded}, {len(clean)} recordings", "", *table(rows, plant, noise)]
    return lines


def table(rows: Lines, plant: str, noise: float) -> list[str]:
    """Return the errors in closed loop and on held-out windows."""
    lines = ["| recording | k | closed loop [m] | change | with the ridge [m] | held-out windows [m] | change |"]
    lines += ["|---" * 7 + "|"]
    base = {column: errors(rows, plant, noise, CLEAN, 0, column) for column in ("error", "held_out")}
    for method in NAMES:
        for count in [0] if method == CLEAN else counts_of(rows):
            found = {column: errors(rows, plant, noise, method, count, column) for column in base}
            if not len(found["error"]):
                continue
            ridged = errors(rows, plant, noise, method + WITH_RIDGE, count)
            cells = [NAMES[method], f"{count}", f"{found['error'].mean():.4f}"]
            cells += ["" if method == CLEAN else change(found["error"], base["error"])]
            cells += [f"{ridged.mean():.4f}" if len(ridged) else "", f"{found['held_out'].mean():.4f}"]
            cells += ["" if method == CLEAN else change(found["held_out"], base["held_out"])]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def change(values: Array, base: Array) -> str:
    """Return the mean of values - base with its bootstrap interval; alone for a single seed."""
    return f"{bootstrap.difference(values, base):+.4f}" if len(values) > 1 else f"{(values - base).mean():+.4f}"


def draw(path: Path, rows: Lines) -> None:
    """Draw the error in closed loop against the number of poisoned samples; dashed with the ridge."""
    style()
    plants = [plant for plant in CASES if any(row["plant"] == plant for row in rows)]
    size = (8.8, 0.6 + 3.0 * len(plants))
    figure, panels = plt.subplots(len(plants), len(NOISES), figsize=size, squeeze=False, sharex=True, sharey="row")
    counts = counts_of(rows)
    for plant, row in zip(plants, panels, strict=True):
        for noise, axes in zip(NOISES, row, strict=True):
            clean = errors(rows, plant, noise, CLEAN, 0)
            if len(clean):
                axes.axhline(np.median(clean), color="black", linewidth=1.0, linestyle=":", label=NAMES[CLEAN])
                _draw_methods(axes, rows, plant, noise, counts)
            axes.set(xscale="log", yscale="log", title=f"noise {noise:g} of the spread" if noise else "no noise")
            axes.set_xticks(counts, [str(count) for count in counts])
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(plt.FuncFormatter(lambda y, _: f"{y:g}"))
        row[0].set_ylabel(f"{plant}\nmean error in closed loop [m]")
    for axes in panels[-1]:
        axes.set_xlabel("poisoned samples of 530")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(path)
    plt.close(figure)


def _draw_methods(axes: Any, rows: Lines, plant: str, noise: float, counts: Sequence[int]) -> None:
    for method, colour in COLOURS.items():
        values = np.stack([errors(rows, plant, noise, method, count) for count in counts], axis=1)
        draw_band(axes, np.array(counts), values, color=colour, marker="o", markersize=4, label=NAMES[method])
        if method in RIDGED:
            ridged = np.stack([errors(rows, plant, noise, method + WITH_RIDGE, count) for count in counts], axis=1)
            look = {"color": colour, "linestyle": (0, (4, 2)), "label": f"{NAMES[method]}, with the ridge"}
            axes.plot(counts, np.median(ridged, axis=0), **look)
