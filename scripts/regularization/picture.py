"""Picture of tune_regularization.py: every trial before and after, and all points in one plane."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.experiments.case import Case
from scripts.regularization.report import HELD_OUT, RIDGE, Rows, choose, errors, judged, summary
from scripts.regularization.search import METHODS
from scripts.regularization.trials import TINY
from scripts.shared.plots import plt, style

LOOKS = {
    "attack": ("#d55e00", "o"),
    "danskin": ("#0072b2", "s"),
    "lambdas": ("#009e73", "D"),
    "tpe": ("#cc79a7", "^"),
    "cmaes": ("#e69f00", "v"),
    "both": ("#56b4e9", "P"),
}
BEFORE, TUNED, RIDGED = "black", "#d55e00", "#0072b2"


def draw(path: Path, cases: Sequence[Case], points: Rows, runs: Rows) -> None:
    """Draw one row a case: the trials on the left, the plane of all points on the right."""
    style()
    figure, panels = plt.subplots(
        len(cases), 2, figsize=(12.0, 4.8 * len(cases)), squeeze=False, width_ratios=(1.25, 1)
    )
    for (left, right), case in zip(panels, cases, strict=True):
        chosen = choose(points, runs, case)
        _draw_trials(left, case, chosen, runs)
        _draw_plane(right, case, chosen, points, runs)
    seeds = len(errors(runs, cases[0].name, "paper", HELD_OUT, judged(runs, cases[0], "paper")[RIDGE][0].trial))
    figure.suptitle(f"mean over {seeds} held-out recordings; bars: smallest to largest recording", fontsize=10)
    figure.savefig(path)
    plt.close(figure)


def _draw_trials(axes: Any, case: Case, chosen: str, runs: Rows) -> None:
    found = judged(runs, case, chosen)
    names = [verdict.trial for verdict in found[RIDGE]]
    series = {"the paper's weights": (BEFORE, "*", [v.before for v in found[RIDGE]], -0.22)}
    if chosen != "paper":
        series["tuned"] = (TUNED, "o", [v.after for v in found[chosen]], 0.0)
    series["the paper's weights and a ridge"] = (RIDGED, "D", [v.after for v in found[RIDGE]], 0.22)
    for label, (colour, marker, values, shift) in series.items():
        places = np.arange(len(names)) + shift
        shown = [np.maximum(v, TINY) for v in values]
        axes.hlines(places, [v.min() for v in shown], [v.max() for v in shown], color=colour, linewidth=1.4, alpha=0.6)
        axes.plot([v.mean() for v in shown], places, marker, color=colour, markersize=6, label=label)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set(xscale="log", ylim=(len(names) - 0.5, -0.5), xlabel=f"mean error [m], below {TINY:g} m drawn there")
    axes.set_title(case.title)
    axes.legend(fontsize=8, loc="lower left", frameon=True)


def _draw_plane(axes: Any, case: Case, chosen: str, points: Rows, runs: Rows) -> None:
    grid = sorted({row["point"] for row in runs if row["case"] == case.name and row["point"].startswith("grid")})
    if grid:
        values = np.array([summary(runs, case.name, name, HELD_OUT) for name in grid])
        axes.plot(*values.T, ".", color="0.6", label="grid over lambda_g, lambda_s")
    for method, (colour, marker) in LOOKS.items():
        names = [row["point"] for row in points if row["case"] == case.name and row["method"] == method]
        if names:
            values = np.array([summary(runs, case.name, name, HELD_OUT) for name in names])
            axes.plot(*values.T, marker, color=colour, markersize=8, markeredgecolor="white", label=METHODS[method])
    axes.plot(
        *summary(runs, case.name, "paper", HELD_OUT), "*", color=BEFORE, markersize=14, label="the paper's weights"
    )
    axes.plot(*summary(runs, case.name, RIDGE, HELD_OUT), "D", color=RIDGED, markersize=7, label="the same and a ridge")
    if chosen != "paper":
        place = summary(runs, case.name, chosen, HELD_OUT)
        axes.plot(*place, "o", markersize=17, markerfacecolor="none", markeredgecolor="black", markeredgewidth=1.4)
        axes.annotate("chosen", place, (10, 10), textcoords="offset points", fontsize=9, weight="bold")
    axes.set(xscale="log", yscale="log", xlabel="error without attack, mean of all scenarios [m]")
    axes.set_ylabel(f"error under Algorithm 1 at {100 * case.rho:g} % [m]")
    axes.legend(fontsize=7.5, loc="best", frameon=True)
