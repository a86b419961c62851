"""Picture of tune_regularization.py: every trial before and after, and all points in one plane."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from scripts.experiments.case import Case
from scripts.regularization.report import (
    ATTACKED_TRIAL,
    RIDGE,
    VALIDATED,
    Rows,
    candidates,
    errors,
    has_ridge,
    judged,
    summary,
    twins,
)
from scripts.regularization.search import GUARDED, METHODS, ONLY_LAMBDAS, REFINED, RIDGED, SAMPLED
from scripts.shared.plots import NOTE_SIZE, note, plt, style

# The searches that are told apart in the plane; the others share the last entry.
LOOKS = {
    GUARDED: ("#d55e00", "o", METHODS[GUARDED]),
    RIDGED: ("#35178c", "s", METHODS[RIDGED]),
    SAMPLED: ("#e69f00", "P", METHODS[SAMPLED]),
    REFINED: ("#cc79a7", "X", METHODS[REFINED]),
    ONLY_LAMBDAS: ("#009e73", "^", METHODS[ONLY_LAMBDAS]),
    "": ("#56b4e9", "v", "searches of the plain sum"),
}
FLOOR = 0.005  # [m]: errors below are drawn there
BEFORE, TUNED, RIDGED_PAPER, BOTH = "black", "#d55e00", "#0072b2", "#35178c"
MARKERS = {BEFORE: "*", TUNED: "o", RIDGED_PAPER: "D", BOTH: "s"}


def draw(path: Path, cases: Sequence[Case], points: Rows, runs: Rows) -> None:
    """Draw one row a case: the trials on the left, the plane of all points on the right."""
    style()
    size = (11.0, 4.5 * len(cases) + 0.8)
    figure, panels = plt.subplots(len(cases), 2, figsize=size, squeeze=False, width_ratios=(1.1, 1))
    for (left, right), case in zip(panels, cases, strict=True):
        _draw_trials(left, case, points, runs)
        _draw_plane(right, case, points, runs)
    look: dict[str, Any] = {"ncols": 4, "fontsize": NOTE_SIZE}
    figure.legend(*_labels(panels[:, 0]), loc="outside upper left", **look)
    figure.legend(*_labels(panels[:, 1]), loc="outside lower center", **look)
    figure.savefig(path)
    plt.close(figure)


def _labels(column: Any) -> tuple[list[Any], list[str]]:
    """Return the handles and the names of all that is drawn in some panels, each name once."""
    drawn = [axes.get_legend_handles_labels() for axes in column]
    handles = {label: handle for found in drawn for handle, label in zip(*found, strict=True)}
    return list(handles.values()), list(handles)


def _in_metres(axes: Any, name: str) -> None:
    """Label an axis at 1, 2 and 5 of each decade; less than half a decade is drawn linearly."""
    axis = {"x": axes.xaxis, "y": axes.yaxis}[name]
    low, high = axis.get_view_interval()
    if high < 5 * low:
        axes.set(**{f"{name}scale": "linear"})
        axis.set_major_locator(MaxNLocator(5))
        return
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def _colour(point: str) -> str:
    if point == RIDGE:
        return RIDGED_PAPER
    return BOTH if has_ridge(point) else TUNED


def _draw_trials(axes: Any, case: Case, points: Rows, runs: Rows) -> None:
    """Draw the error of every trial, the paper's weights and each candidate, mean and range over the recordings."""
    labels = candidates(points, runs, case)
    found = judged(runs, case, labels)
    first = next(iter(found.values()))
    series = [("the paper's weights", BEFORE, [verdict.before for verdict in first])]
    series += [(labels[name], _colour(name), [v.after for v in verdicts]) for name, verdicts in found.items()]
    places = np.arange(len(first))
    for (label, colour, values), shift in zip(series, np.linspace(-0.27, 0.27, len(series)), strict=True):
        shown = [np.maximum(v, FLOOR) for v in values]
        look = {"color": colour, "linewidth": 1.2, "alpha": 0.6}
        axes.hlines(places + shift, [v.min() for v in shown], [v.max() for v in shown], **look)
        axes.plot([v.mean() for v in shown], places + shift, MARKERS[colour], color=colour, markersize=5, label=label)
    axes.set_yticks(places, [verdict.trial for verdict in first], fontsize=8)
    axes.set(xscale="log", ylim=(len(first) + 0.4, -0.6), xlabel="mean error [m]", title=case.title)
    _in_metres(axes, "x")
    seeds = len(first[0].before)
    note(axes, f"mean and range of {seeds} recordings; below {FLOOR:g} m drawn there", corner="lower right")


def _draw_plane(axes: Any, case: Case, points: Rows, runs: Rows) -> None:
    """Draw the error without an attack against that under Algorithm 1, one mark for each set of weights."""

    def place(name: str) -> tuple[float, float]:
        nominal, attacked = (max(value, FLOOR) for value in summary(runs, case.name, name))
        return nominal, attacked

    drawn: set[str] = set()
    for row in (row for row in points if row["case"] == case.name):
        method = row["method"] if row["method"] in LOOKS else ""
        colour, marker, label = LOOKS[method]
        look = {"color": colour, "markersize": 7, "markeredgecolor": "white", "linestyle": "None"}
        axes.plot(*place(row["point"]), marker=marker, label=None if method in drawn else label, **look)
        drawn.add(method)
    for i, name in enumerate(twins(points, runs, case)):
        hollow: dict[str, Any] = {
            "markerfacecolor": "white",
            "markeredgecolor": BOTH,
            "markersize": 6,
            "linestyle": "None",
        }
        axes.plot(*place(name), marker="s", label=None if i else "tuned weights and the ridge", **hollow)
    axes.plot(*place("paper"), "*", color=BEFORE, markersize=12, label="the paper's weights")
    axes.plot(*place(RIDGE), "D", color=RIDGED_PAPER, markersize=6, label="the paper's weights, ridge")
    for name in candidates(points, runs, case):
        if name != RIDGE:
            ring = {"markerfacecolor": "none", "markeredgecolor": "black", "markeredgewidth": 1.2}
            axes.plot(*place(name), "o", markersize=14, **ring)
            axes.annotate("chosen", place(name), (9, 8), textcoords="offset points", fontsize=8, weight="bold")
    axes.set(xscale="log", yscale="log", xlabel="error without an attack, five scenarios [m]")
    axes.set_ylabel(f"error under Algorithm 1, $\\rho$ = {100 * case.rho:g} % [m]")
    axes.margins(0.15)
    _in_metres(axes, "x")
    _in_metres(axes, "y")
    seeds = len(errors(runs, case.name, "paper", VALIDATED, ATTACKED_TRIAL))
    note(axes, f"mean of {seeds} validation recordings", corner="lower right")
