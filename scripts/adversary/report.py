"""Report on trained adversaries: tables and a picture, from the rows that `train_adversary.py` leaves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.adversary.judge import AIMED, AIMED_PROJECTED, CLOSED_LOOP, HELD_OUT_WINDOWS, PROJECTED, WINDOWS
from scripts.shared import bootstrap
from scripts.shared.plots import COLOURS, note, plt, style
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
LOOKS: dict[str, dict[str, Any]] = {
    RANDOM: {"color": COLOURS[RANDOM], "marker": "o"},
    POISON: {"color": COLOURS[POISON], "marker": "s"},
    PROJECTED: {"color": "#e69f00", "marker": "D"},
    AIMED: {"color": COLOURS[POISON], "marker": "s", "markerfacecolor": "white"},
    AIMED_PROJECTED: {"color": "#e69f00", "marker": "D", "markerfacecolor": "white"},
    WINDOWS: {"color": "#009e73", "marker": "^"},
    CLOSED_LOOP: {"color": "#35178c", "marker": "v"},
}
CURVES = {WINDOWS: r"trained on windows: decrease of $\psi$", CLOSED_LOOP: "trained in closed loop: error of the run"}
SIZE = (6.4, 4.0)  # of a picture with one panel [inches]
SHOWN = 400  # iterations of imitation in the picture
HEAD = """# Trained adversaries: {plant}

Decreases of psi are relative to Algorithm 1's on the same windows, recorded in closed loop with seeds of their own: the
ratio of the means at each rho, and the median over the windows of the ratio on each. Times are medians over calls for
{batch} windows, and for one window alone, on one thread. Errors in closed loop are means over runs and seeds [m];
beside them their ratio to Algorithm 1's with the 95 % paired bootstrap interval over the held-out seeds. A policy's
numbers are means over its training seeds, and [a to b] is the range over them; {failed}."""


def chosen(rows: Rows, column: str, setting: str, attack: str, rho: float) -> Array:
    """Return a column of the rows of one setting, attack and rho, `(training seeds, seeds)`."""
    mine = (rows["setting"] == setting) & (rows["attack"] == attack) & np.isclose(rows["rho"], rho)
    order = np.lexsort((rows["seed"][mine], rows["trained"][mine]))
    return rows[column][mine][order].reshape(len(np.unique(rows["trained"][mine])), -1)


def trainings(values: Array, spec: str) -> str:
    """Return the range over the training seeds in brackets, nothing for one; `values` are `(training seeds,)`."""
    return f" [{values.min():{spec}} to {values.max():{spec}}]" if len(values) > 1 else ""


def names_in(rows: Rows, setting: str) -> list[str]:
    """Return the attacks that were made in a setting, in the order of `TITLES`."""
    made = set(rows["attack"][rows["setting"] == setting])
    return [name for name in TITLES if name in made and name != NOMINAL]


def windows_table(rows: Rows, rhos: Sequence[float]) -> list[str]:
    """Return the lines of the table of held-out windows."""

    def of(column: str, name: str, rho: float) -> Array:
        return chosen(rows, column, HELD_OUT_WINDOWS, name, rho)[:, 0]

    lines = [
        header(rhos, "median", "time a sample [us]", "Algorithm 1's / its", "alone [us]"),
        "|---" * (len(rhos) + 5) + "|",
    ]
    for name in names_in(rows, HELD_OUT_WINDOWS):
        shares = [100 * of("of_algorithm1", name, rho) for rho in rhos]
        median = [100 * of("median_of_algorithm1", name, rho).mean() for rho in rhos]
        times = {n: of("microseconds", n, rhos[0])[0] for n in (name, POISON)}
        cells = [TITLES[name], *(f"{share.mean():.1f} %{trainings(share, '.1f')}" for share in shares)]
        cells += [f"{min(median):.1f} to {max(median):.1f} %"]
        cells += [f"{times[name]:.3g}", f"{times[POISON] / times[name]:.2g}"]
        cells += [f"{of('microseconds_alone', name, rhos[0])[0]:.3g}"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def loop_ratio(rows: Rows, setting: str, name: str, rho: float) -> tuple[bootstrap.Interval, Array]:
    """Return an attack's error over Algorithm 1's with its interval, and the ratio of each training seed."""
    error, base = (chosen(rows, "mean_error", setting, n, rho) for n in (name, POISON))
    if base.shape[1] < 2:  # no interval of a single seed
        value = float(error.mean() / base.mean())
        return bootstrap.Interval(value, value, value, 1), error.mean(1) / base.mean()
    return bootstrap.ratio(error.mean(0), base[0]), error.mean(1) / base.mean()


def loop_table(rows: Rows, rhos: Sequence[float], setting: str) -> list[str]:
    """Return the lines of the table of one closed-loop setting."""
    nominal = chosen(rows, "mean_error", setting, NOMINAL, 0.0)
    lines = [
        f"No attack: {nominal.mean():.2g} m, {nominal.shape[1]} seeds.",
        "",
        header(rhos, "failed"),
        "|---" * (len(rhos) + 2) + "|",
    ]
    for name in names_in(rows, setting):
        cells, failed = [], 0
        for rho in rhos:
            error = chosen(rows, "mean_error", setting, name, rho)
            failed += int(chosen(rows, "failed", setting, name, rho).sum())
            ratio, each = loop_ratio(rows, setting, name, rho)
            beside = f"; {ratio:.2f}{trainings(each, '.2f')}"
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
    _training(stem.with_name(f"{stem.name}_training.png"), curves)
    _windows(stem.with_name(f"{stem.name}_windows.png"), rows, rhos)
    _loop(stem.with_name(f"{stem.name}_loop.png"), rows, rhos)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path)
    plt.close(figure)


def _training(path: Path, curves: Rows) -> None:
    """Draw the effect on held-out data against the iteration, one line a training seed."""
    figure, axes = plt.subplots(figsize=SIZE)
    seeds = np.unique(curves["trained"])
    for mode, label in CURVES.items():
        if mode not in curves["mode"]:
            continue
        for i, seed in enumerate(seeds):
            mine = (curves["mode"] == mode) & (curves["trained"] == seed)
            imitated = curves["total"][mine & (curves["stage"] == "imitate")].max()
            place, effect = curves["total"][mine] - imitated, curves["of_algorithm1"][mine]
            look: dict[str, Any] = {"color": LOOKS[mode]["color"], "linewidth": 1.2, "label": label if i == 0 else None}
            axes.plot(place, effect, **look)
    axes.axhline(1.0, color=COLOURS[POISON], linestyle=(0, (4, 2)), label=TITLES[POISON])
    axes.axvline(0.0, color="grey", linestyle=":")
    axes.set(xlim=(-SHOWN, None), xlabel="iteration after the imitation of Algorithm 1")
    axes.set_ylabel("effect / Algorithm 1's")
    axes.margins(y=0.15)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=9)
    note(axes, f"held-out data, mean over three sizes of the attack; one line for each of {len(seeds)} training seeds")
    _save(figure, path)


def _windows(path: Path, rows: Rows, rhos: Sequence[float]) -> None:
    """Draw the decrease of psi against the time of a sample, at the largest rho."""
    figure, axes = plt.subplots(figsize=SIZE)
    seeds = 0
    for name in names_in(rows, HELD_OUT_WINDOWS):
        share = chosen(rows, "of_algorithm1", HELD_OUT_WINDOWS, name, rhos[-1])[:, 0]
        time = chosen(rows, "microseconds", HELD_OUT_WINDOWS, name, rhos[-1])[0, 0]
        axes.plot(time, share.mean(), linestyle="None", markersize=8, **LOOKS[name])
        axes.vlines(time, share.min(), share.max(), color=LOOKS[name]["color"])
        above = name == WINDOWS  # a policy trained in closed loop takes the same time
        look: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9, "va": "bottom" if above else "center"}
        axes.annotate(TITLES[name], (time, share.mean()), (9, 3 if above else 0), **look)
        seeds = max(seeds, len(share))
    axes.set(xscale="log", xlabel="time a sample in a batch of 1024 [µs]", ylabel="decrease of $\\psi$ / Algorithm 1's")
    low, high = axes.get_xlim()
    axes.set_xlim(low, high * (high / low) ** 0.55)  # room for the names
    axes.margins(y=0.15)
    text = f"held-out windows, $\\rho$ = {100 * rhos[-1]:g} %; bars: range of {seeds} training seeds"
    note(axes, text, corner="lower right")
    _save(figure, path)


def _loop(path: Path, rows: Rows, rhos: Sequence[float]) -> None:
    """Draw the error in closed loop over Algorithm 1's, with its interval; one panel a setting."""
    settings = [s for s in dict.fromkeys(rows["setting"]) if s != HELD_OUT_WINDOWS]
    figure, panels = plt.subplots(1, len(settings), figsize=(8.4, 4.2), sharey=True, squeeze=False)
    highest = 1.0
    for axes, setting in zip(panels[0], settings, strict=True):
        names = [name for name in names_in(rows, setting) if name != POISON]
        for i, name in enumerate(names):
            found = [loop_ratio(rows, setting, name, rho)[0] for rho in rhos]
            places = np.arange(len(rhos)) + 0.09 * (i - (len(names) - 1) / 2)
            colour, highest = LOOKS[name]["color"], max(highest, *(f.high for f in found))
            axes.vlines(places, [f.low for f in found], [f.high for f in found], color=colour, linewidth=1.4)
            axes.plot(places, [f.value for f in found], linestyle="None", label=TITLES[name], **LOOKS[name])
        axes.axhline(1.0, color=COLOURS[POISON], linestyle=(0, (4, 2)), linewidth=1.2, label=TITLES[POISON])
        axes.set(title=setting, xlabel=r"$\rho$ [%]", xlim=(-0.5, len(rhos) - 0.5), ylim=(0, None))
        axes.set_xticks(range(len(rhos)), [f"{100 * rho:g}" for rho in rhos])
        axes.grid(axis="x", visible=False)
    panels[0, 0].set_ylabel("mean error / Algorithm 1's")
    panels[0, 0].set_ylim(0, 1.15 * highest)  # room for the notes
    seeds = chosen(rows, "mean_error", settings[0], POISON, rhos[0]).shape[1]
    trained = len(np.unique(rows["trained"][rows["trained"] >= 0]))
    note(panels[0, 0], f"{seeds} held-out seeds, bars: 95 % paired bootstrap interval")
    note(panels[0, 1], f"policies: mean of {trained} training seeds")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=9)
    _save(figure, path)
