"""Report on trained adversaries: tables and a picture, from the rows that `train_adversary.py` leaves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.adversary.judge import AIMED, AIMED_PROJECTED, CLOSED_LOOP, HELD_OUT_WINDOWS, PROJECTED, WINDOWS
from scripts.shared.plots import COLOURS, plt, style
from scripts.shared.rows import Array, Rows
from scripts.shared.statistics import NOMINAL, POISON, RANDOM

TITLES = {
    NOMINAL: "no attack",
    RANDOM: "random noise",
    POISON: "Algorithm 1",
    PROJECTED: "projected gradient, 20 steps",
    AIMED: "Algorithm 1 at the tracking error",
    AIMED_PROJECTED: "projected gradient at the tracking error",
    WINDOWS: "policy trained on windows",
    CLOSED_LOOP: "policy trained in closed loop",
}
LOOKS = {
    RANDOM: {"color": COLOURS[RANDOM], "marker": "o"},
    POISON: {"color": COLOURS[POISON], "marker": "s"},
    PROJECTED: {"color": "#e69f00", "marker": "D"},
    AIMED: {"color": COLOURS[POISON], "marker": "s", "markerfacecolor": "white"},
    AIMED_PROJECTED: {"color": "#e69f00", "marker": "D", "markerfacecolor": "white"},
    WINDOWS: {"color": "#009e73", "marker": "^"},
    CLOSED_LOOP: {"color": "#35178c", "marker": "v"},
}
SHOWN = 400  # iterations of imitation in the picture
HEAD = """# Trained adversaries: {plant}

Decreases of psi are relative to Algorithm 1's on the same windows, recorded in closed loop with seeds of their own: the
ratio of the means at each rho, and the median over the windows of the ratio on each. Times are medians over calls for
{batch} windows, and for one window alone, on one thread. Errors in closed loop are means over runs and seeds [m], with
Algorithm 1's beside them; {failed}."""


def chosen(rows: Rows, column: str, setting: str, attack: str, rho: float) -> Array:
    """Return a column of the rows of one setting, attack and rho, one entry a seed."""
    return rows[column][(rows["setting"] == setting) & (rows["attack"] == attack) & np.isclose(rows["rho"], rho)]


def names_in(rows: Rows, setting: str) -> list[str]:
    """Return the attacks that were made in a setting, in the order of `TITLES`."""
    made = set(rows["attack"][rows["setting"] == setting])
    return [name for name in TITLES if name in made and name != NOMINAL]


def windows_table(rows: Rows, rhos: Sequence[float]) -> list[str]:
    """Return the lines of the table of held-out windows."""

    def one(column: str, name: str, rho: float) -> float:
        return float(chosen(rows, column, HELD_OUT_WINDOWS, name, rho)[0])

    lines = [
        header(rhos, "median", "time a sample [us]", "Algorithm 1's / its", "alone [us]"),
        "|---" * (len(rhos) + 5) + "|",
    ]
    for name in names_in(rows, HELD_OUT_WINDOWS):
        share = [f"{100 * one('of_algorithm1', name, rho):.1f} %" for rho in rhos]
        median = [100 * one("median_of_algorithm1", name, rho) for rho in rhos]
        times = {n: one("microseconds", n, rhos[0]) for n in (name, POISON)}
        cells = [TITLES[name], *share, f"{min(median):.1f} to {max(median):.1f} %"]
        cells += [f"{times[name]:.3g}", f"{times[POISON] / times[name]:.2g}"]
        cells += [f"{one('microseconds_alone', name, rhos[0]):.3g}"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def loop_table(rows: Rows, rhos: Sequence[float], setting: str) -> list[str]:
    """Return the lines of the table of one closed-loop setting."""
    nominal = chosen(rows, "mean_error", setting, NOMINAL, 0.0)
    lines = [
        f"No attack: {nominal.mean():.2g} m, {len(nominal)} seeds.",
        "",
        header(rhos, "failed"),
        "|---" * (len(rhos) + 2) + "|",
    ]
    for name in names_in(rows, setting):
        cells, failed = [], 0
        for rho in rhos:
            error, base = (chosen(rows, "mean_error", setting, n, rho) for n in (name, POISON))
            failed += int(chosen(rows, "failed", setting, name, rho).sum())
            more = int((error > base).sum())
            beside = f"; {error.mean() / base.mean():.2f} times, larger on {more} of {len(base)}"
            cells.append(f"{error.mean():.3g}" + (beside if name != POISON else ""))
        lines.append("| " + " | ".join([TITLES[name], *cells, str(failed)]) + " |")
    return lines


def header(rhos: Sequence[float], *more: str) -> str:
    """Return the first line of a table."""
    return "| " + " | ".join(["attack", *(f"rho {100 * rho:g} %" for rho in rhos), *more]) + " |"


def write_report(path: Path, rows: Rows, plant: str, rhos: Sequence[float], note: str, batch: int) -> None:
    """Write the tables of one plant."""
    failed = (
        "a flight has failed when the vehicle is down, and it then lies there" if plant == "quadrotor" else "none fails"
    )
    lines = [HEAD.format(plant=plant, batch=batch, failed=failed), "", f"{note}.", "", "## Held-out windows", ""]
    lines += windows_table(rows, rhos)
    for setting in dict.fromkeys(rows["setting"]):
        if setting != HELD_OUT_WINDOWS:
            lines += ["", f"## Closed loop, {setting}", "", *loop_table(rows, rhos, setting)]
    path.write_text("\n".join(lines) + "\n")


def pictures(stem: Path, rows: Rows, curves: Rows, rhos: Sequence[float]) -> None:
    """Draw the training, the decrease of psi against time, and the error in closed loop, one picture each."""
    style()
    for name, draw in (("training", _training), ("windows", _windows), ("loop", _loop)):
        figure, axes = plt.subplots(figsize=(6.4, 4.4))
        draw(axes, rows if name != "training" else curves, rhos)
        axes.legend(fontsize=8, frameon=True)
        figure.savefig(stem.with_name(f"{stem.name}_{name}.png"))
        plt.close(figure)


def _training(axes: Any, curves: Rows, rhos: Sequence[float]) -> None:
    for mode in dict.fromkeys(curves["mode"]):
        mine = curves["mode"] == mode
        imitated = curves["total"][mine & (curves["stage"] == "imitate")].max()
        look = {**LOOKS[mode], "marker": "None", "label": TITLES[mode]}
        axes.plot(curves["total"][mine] - imitated, curves["of_algorithm1"][mine], **look)
    axes.axhline(1.0, color=COLOURS[POISON], linestyle=(0, (4, 2)), label=TITLES[POISON])
    axes.axvline(0.0, color="grey", linestyle=":")
    axes.set(xlim=(-SHOWN, None), title="training, on held-out data")
    axes.set(xlabel="iteration after the imitation", ylabel="effect relative to Algorithm 1")


def _windows(axes: Any, rows: Rows, rhos: Sequence[float]) -> None:
    for name in names_in(rows, HELD_OUT_WINDOWS):
        points = [
            [float(chosen(rows, column, HELD_OUT_WINDOWS, name, rho)[0]) for rho in rhos]
            for column in ("microseconds", "of_algorithm1")
        ]
        axes.plot(*points, linestyle="None", label=TITLES[name], **LOOKS[name])
    axes.axhline(1.0, color=COLOURS[POISON], linestyle=(0, (4, 2)))
    axes.set(title="held-out windows, one point a rho", xscale="log", xlabel="time a sample in a batch [µs]")
    axes.set_ylabel("decrease of psi / Algorithm 1's")


def _loop(axes: Any, rows: Rows, rhos: Sequence[float]) -> None:
    setting = next(s for s in dict.fromkeys(rows["setting"]) if s != HELD_OUT_WINDOWS)
    percents = [100 * rho for rho in rhos]
    seeds = 0
    for name in names_in(rows, setting):
        if name != RANDOM:  # far below the others
            error, base = (
                np.array([chosen(rows, "mean_error", setting, n, rho) for rho in rhos]) for n in (name, POISON)
            )
            ratio, seeds = error / base, error.shape[1]
            axes.plot(percents, error.mean(axis=1) / base.mean(axis=1), label=TITLES[name], **LOOKS[name])
            axes.fill_between(percents, ratio.min(axis=1), ratio.max(axis=1), color=LOOKS[name]["color"], alpha=0.12)
    axes.set(title=f"closed loop, {setting}: ratio of means over {seeds} seeds, band: smallest to largest seed")
    axes.set(xlabel=r"$\rho$ [%]", ylabel="error / Algorithm 1's")
    axes.set_xticks(percents)
