"""Tables and pictures of study_detection.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.defence.detection import CASES, GRID, NOISES, NONE, POISON, RANDOM, RATES, STEALTHY, WATCHED
from scripts.shared import bootstrap
from scripts.shared.plots import draw_band, percent, plt, style
from scripts.shared.rows import Array
from scripts.shared.statistics import BAND

Lines = Sequence[Mapping[str, str]]
COLOURS = {NONE: "black", RANDOM: "#0072b2", POISON: "#d55e00", STEALTHY: "#009e73"}
MARKS = {RANDOM: "o", POISON: "s", STEALTHY: "^"}
LINEAR = 1e-3  # [m]: added errors below it are drawn on a linear scale
#: The stated false alarms are held where the measured ones lie between these multiples of it.
HELD = (0.5, 2.0)


def unique(rows: Lines, keys: Sequence[str]) -> list[Mapping[str, str]]:
    """Return one row for each set of keys, the last: a run that was stopped may have written some twice."""
    return list({tuple(row[key] for key in keys): row for row in rows}.values())


def of_seeds(rows: Lines, column: str, **keys: Any) -> Array:
    """Return a column by seed, of the rows with these keys; numbers are compared as numbers."""

    def fits(row: Mapping[str, str]) -> bool:
        return all(row[k] == v if isinstance(v, str) else float(row[k]) == v for k, v in keys.items())

    found = {int(row["seed"]): float(row[column]) for row in rows if fits(row)}
    return np.array([found[seed] for seed in sorted(found)])


def alarm_rate(loops: Lines, **keys: Any) -> Array:
    """Return the share of plans that alarmed, by seed."""
    return of_seeds(loops, "alarms", **keys) / of_seeds(loops, "plans", **keys)


def named(noise: float) -> str:
    """Return a noise level for titles."""
    return f"noise {noise:g} of the spread" if noise else "no noise"


def report(loops: Lines, roc: Lines, rates: Lines, seeds: int) -> list[str]:
    """Return the lines of study_detection.md."""
    loops = unique(loops, ("plant", "noise", "seed", "attack", "rho", "rate"))
    lines = ["# Who is seen", "", *rate_table(rates)]
    raised = sum(int(row["raised"]) for row in loops if row["attack"] == STEALTHY)
    watched = sum(int(row["plans"]) for row in loops if row["attack"] == STEALTHY)
    lines += ["", f"Windows that alarm under the stealthy attack and not without it: {raised} of {watched}."]
    for plant, case in CASES.items():
        if any(row["plant"] == plant for row in loops):
            lines += ["", f"## {case.title[0].upper()}{case.title[1:].split(',')[0]}", "", *loop_table(loops, plant)]
            lines += ["", *roc_table(roc, plant)]
    return lines


def rate_table(rates: Lines) -> list[str]:
    """Return the table of measured false alarms, and whether they are held."""
    lines = ["| plant | noise | " + " | ".join(f"stated {rate:.0%}" for rate in RATES) + " | windows |"]
    lines += ["|---" * (3 + len(RATES)) + "|"]
    held = settings = 0
    for plant in CASES:
        for noise in NOISES:
            cells, total = [], 0.0
            for rate in RATES:
                keys = {"plant": plant, "noise": noise, "rate": rate}
                alarms, windows = of_seeds(rates, "alarms", **keys), of_seeds(rates, "windows", **keys)
                if not len(alarms):
                    continue
                share, total = alarms.sum() / windows.sum(), float(windows.sum())
                each = alarms / windows
                held += HELD[0] * rate <= share <= HELD[1] * rate
                settings += 1
                cells.append(f"{share:.2%} ({each.min():.2%} to {each.max():.2%})")
            if cells:
                lines.append(f"| {plant} | {noise:g} | " + " | ".join(cells) + f" | {total:.0f} |")
    low, high = HELD
    says = f"False alarms lie within [{low:g}, {high:g}] of the stated rate in {held} of {settings} settings."
    return [*lines, "", f"False alarms on fresh clean runs: of all recordings, smallest and largest of one. {says}"]


def loop_table(loops: Lines, plant: str) -> list[str]:
    """Return the errors in closed loop and the alarms at the largest rho."""
    rho = CASES[plant].rho
    lines = [
        f"Closed loop at rho {percent(rho)}, watched at {WATCHED:.0%}: mean error, what the attack adds to it (paired, "
        "with a 95 % bootstrap interval), and the share of plans that alarm.",
        "",
    ]
    lines += ["| attack | " + " | ".join(f"{named(n)}: error [m] | added | alarms" for n in NOISES) + " |"]
    lines += ["|---" * (1 + 3 * len(NOISES)) + "|"]
    for attack in (NONE, RANDOM, POISON, STEALTHY):
        cells = []
        for noise in NOISES:
            keys = {"plant": plant, "noise": noise, "attack": attack, "rate": WATCHED}
            keys["rho"] = 0.0 if attack == NONE else rho
            error, alarms = of_seeds(loops, "error", **keys), alarm_rate(loops, **keys)
            base = of_seeds(loops, "error", **{**keys, "attack": NONE, "rho": 0.0})
            if len(error):
                cells += [f"{error.mean():.4f}", "" if attack == NONE else added(error, base), f"{alarms.mean():.0%}"]
        lines.append(f"| {attack} | " + " | ".join(cells) + " |")
    return lines


def added(values: Array, base: Array) -> str:
    """Return the mean of values - base with its bootstrap interval; alone for a single seed."""
    return f"{bootstrap.difference(values, base):+.4f}" if len(values) > 1 else f"{(values - base).mean():+.4f}"


def roc_table(roc: Lines, plant: str) -> list[str]:
    """Return the detection at some false alarms."""
    at = (0.01, 0.05, 0.2)
    head = [f"{named(noise)}: {f:.0%}" for noise in NOISES for f in at]
    lines = ["Windows detected at 1 %, 5 % and 20 % false alarms, mean over the recordings.", ""]
    lines += ["| attack | " + " | ".join(head) + " |", "|---" * (1 + len(head)) + "|"]
    for attack in (RANDOM, POISON, STEALTHY):
        cells = []
        for noise in NOISES:
            for f in at:
                seen = of_seeds(roc, "detected", plant=plant, noise=noise, attack=attack, false_alarms=f)
                cells.append(f"{seen.mean():.0%}" if len(seen) else "")
        lines.append(f"| {attack} | " + " | ".join(cells) + " |")
    return lines


def _grid(plants: Sequence[str]) -> tuple[Any, Any]:
    style()
    size = (10.5, 0.6 + 2.9 * len(plants))
    return plt.subplots(len(plants), len(NOISES), figsize=size, squeeze=False, sharex=True)


def draw_roc(path: Path, roc: Lines) -> None:
    """Draw detection against false alarms, a row for each plant, a column for each noise level."""
    plants = [plant for plant in CASES if any(row["plant"] == plant for row in roc)]
    figure, panels = _grid(plants)
    for plant, row in zip(plants, panels, strict=True):
        for noise, axes in zip(NOISES, row, strict=True):
            axes.plot(GRID, GRID, color="0.6", linewidth=1.0, linestyle=":", label="chance")
            for attack, width in zip(MARKS, (4.5, 2.8, 1.4), strict=True):  # where lines meet, all are seen
                keys = {"plant": plant, "noise": noise, "attack": attack}
                values = [of_seeds(roc, "detected", **keys, false_alarms=f) for f in GRID]
                if len(values[0]):
                    look = {"color": COLOURS[attack], "linewidth": width, "label": attack}
                    draw_band(axes, np.array(GRID), np.stack(values, axis=1), **look)
            axes.axvline(WATCHED, color="0.6", linewidth=0.8, linestyle=(0, (4, 2)))
            axes.set(xscale="log", xlim=(GRID[0], 1.0), ylim=(-0.03, 1.03))
            axes.set_title(named(noise))
        row[0].set_ylabel(f"{plant}, rho {percent(CASES[plant].rho)}\nattacked windows that alarm")
    for axes in panels[-1]:
        axes.set_xlabel("false alarms")
    _finish(figure, panels, path)


def draw_damage(path: Path, loops: Lines) -> None:
    """Draw what an attack adds to the error against the alarms, a point for each rho, joined from small to large."""
    loops = unique(loops, ("plant", "noise", "seed", "attack", "rho", "rate"))
    plants = [plant for plant in CASES if any(row["plant"] == plant for row in loops)]
    figure, panels = _grid(plants)
    for plant, row in zip(plants, panels, strict=True):
        for noise, axes in zip(NOISES, row, strict=True):
            keys = {"plant": plant, "noise": noise, "rate": WATCHED}
            axes.axhline(0.0, color=COLOURS[NONE], linewidth=1.0, linestyle="--", label=NONE)
            for attack, mark in MARKS.items():
                _draw_curve(axes, loops, attack, mark, CASES[plant].rhos, keys)
            axes.axvline(WATCHED, color="0.6", linewidth=0.8, linestyle=(0, (4, 2)))
            axes.set(xlim=(-0.04, 1.04), title=named(noise))
            axes.set_yscale("symlog", linthresh=LINEAR)
            axes.yaxis.set_major_formatter(plt.FuncFormatter(lambda y, _: f"{y:g}"))
        low, high = zip(*(axes.dataLim.intervaly for axes in row), strict=True)
        for axes in row:
            axes.set_ylim(min(-LINEAR / 2, 1.5 * min(low)), 1.5 * max(high))
        row[0].set_ylabel(f"{plant}\nerror added by the attack [m]")
    for axes in panels[-1]:
        axes.set_xlabel(f"plans that alarm, watched at {WATCHED:.0%}")
    _finish(figure, panels, path)


def _draw_curve(axes: Any, loops: Lines, attack: str, mark: str, rhos: Sequence[float], keys: dict[str, Any]) -> None:
    alarms = [alarm_rate(loops, attack=attack, rho=rho, **keys) for rho in rhos]
    nominal = of_seeds(loops, "error", attack=NONE, rho=0.0, **keys)
    errors = [of_seeds(loops, "error", attack=attack, rho=rho, **keys) - nominal for rho in rhos]
    if not len(alarms[0]):
        return
    x, y = (np.array([np.median(v) for v in values]) for values in (alarms, errors))
    spread = [
        np.abs(np.stack([np.percentile(v, BAND) for v in values]).T - middle)
        for values, middle in ((alarms, x), (errors, y))
    ]
    look = {"color": COLOURS[attack], "marker": mark, "linewidth": 1.2, "elinewidth": 0.8, "capsize": 0}
    axes.errorbar(x, y, xerr=spread[0], yerr=spread[1], label=attack, markersize=5, **look)


def _finish(figure: Any, panels: Any, path: Path) -> None:
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    figure.savefig(path)
    plt.close(figure)
