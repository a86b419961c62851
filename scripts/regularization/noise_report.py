"""Tables and picture of study_noise.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.shared import bootstrap
from scripts.shared.plots import COLOURS, NAMES, draw_band, note, plt, style
from scripts.shared.rows import Array
from scripts.shared.statistics import BAND, NOMINAL, POISON, RANDOM

Lines = Sequence[Mapping[str, str]]

CLEAN = "clean"
ATTACKS = (NOMINAL, RANDOM, POISON)
LIMITS = {"masses": (0.1, 10.0), "quadrotor": (0.1, 1e3)}  # of the sensitivity in the picture
UNITS = {"masses": "N / m", "quadrotor": "(m/s) / m"}
NOISE_COLOURS = {0.0: "#f2a33a", 1e-3: "#c8407a", 1e-2: "#35178c"}
KINDS = {"noise": "noise in the recording", "ridge": "ridge on clean data", "lambda_s": "lambda_s"}


def gains_of(
    rows: Lines, plant: str, kind: str, seeds: Sequence[int], noise: float | None = None
) -> dict[float, Array]:
    """Return the sensitivities of a kind by size, `(seeds,)` each."""
    found: dict[float, dict[int, float]] = {}
    for row in rows:
        if (row["plant"], row["kind"]) == (plant, kind) and noise in (None, float(row["noise"])):
            found.setdefault(float(row["size"]), {})[int(row["seed"])] = float(row["gain"])
    return {size: np.array([of[seed] for seed in seeds]) for size, of in sorted(found.items())}


def errors_of(rows: Lines, plant: str, kind: str, size: float, attack: str, seeds: Sequence[int]) -> Array:
    """Return the mean error of each seed [m]."""
    keys = (plant, kind, size, attack)
    mine = {int(r["seed"]): r for r in rows if (r["plant"], r["kind"], float(r["size"]), r["attack"]) == keys}
    return np.array([float(mine[seed]["error"]) for seed in seeds])


def sizes_of(rows: Lines, plant: str, kind: str) -> list[float]:
    """Return the sizes of a kind in closed loop."""
    return sorted({float(row["size"]) for row in rows if (row["plant"], row["kind"]) == (plant, kind)})


def report(titles: Mapping[str, str], gains: Lines, runs: Lines, seeds: Sequence[int]) -> list[str]:
    """Return the lines of study_noise.md."""
    lines = ["# Why noise in the recording protects", ""]
    lines += [
        "Sensitivity is max |du| / |p| of the plan without its bounds: mean over the recordings, smallest to largest.",
        "Changes in closed loop are paired differences from the clean data, with 95 % bootstrap intervals.",
    ]
    for plant, title in titles.items():
        noise, ridge = (gains_of(gains, plant, kind, seeds) for kind in ("noise", "ridge"))
        clean = gains_of(gains, plant, CLEAN, seeds)[0.0]
        lines += ["", f"## {title}", "", f"| size | noise [{UNITS[plant]}] | ridge [{UNITS[plant]}] |", "|---|---|---|"]
        lines += [f"| 0 | {cell(clean)} | {cell(clean)} |"]
        lines += [f"| {size:g} | {cell(noise[size])} | {cell(ridge[size])} |" for size in noise]
        for name in ("lambda_s", "lambda_g"):
            tables = {level: gains_of(gains, plant, name, seeds, level) for level in NOISE_COLOURS}
            lines += ["", f"| {name} | " + " | ".join(f"noise {level:g}" for level in tables) + " |"]
            lines += ["|---" * (1 + len(tables)) + "|"]
            for value in tables[0.0]:
                lines += [f"| {value:g} | " + " | ".join(cell(found[value]) for found in tables.values()) + " |"]
        lines += ["", *closed_table(runs, plant, seeds)]
    return lines


def closed_table(runs: Lines, plant: str, seeds: Sequence[int]) -> list[str]:
    """Return the lines of the errors in closed loop, with their paired differences from the clean data."""
    lines = ["| change | size | no attack [m] | change of it | random noise [m] | Algorithm 1 [m] | change of it |"]
    lines += ["|---" * 7 + "|"]
    base = {attack: errors_of(runs, plant, CLEAN, 0.0, attack, seeds) for attack in ATTACKS}
    for kind in (CLEAN, *KINDS):
        for size in sizes_of(runs, plant, kind):
            e = {attack: errors_of(runs, plant, kind, size, attack, seeds) for attack in ATTACKS}
            changes = {a: "" if kind == CLEAN else f"{bootstrap.difference(e[a], base[a]):+.4f}" for a in ATTACKS}
            cells = [KINDS.get(kind, "none"), f"{size:g}" if size else ""]
            cells += [f"{e[NOMINAL].mean():.4f}", changes[NOMINAL], f"{e[RANDOM].mean():.4f}"]
            cells += [f"{e[POISON].mean():.4f}", changes[POISON]]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def cell(values: Array) -> str:
    """Return mean (smallest to largest)."""
    return f"{values.mean():.3g} ({values.min():.3g} to {values.max():.3g})"


def draw(path: Path, titles: Mapping[str, str], gains: Lines, runs: Lines, seeds: Sequence[int]) -> None:
    """Draw sensitivity against noise, against both lambdas, and the error in closed loop; one row a plant."""
    style()
    figure, panels = plt.subplots(len(titles), 4, figsize=(13.0, 3.1 * len(titles)), squeeze=False)
    for row, plant in zip(panels, titles, strict=True):
        _draw_noise(row[0], gains, plant, seeds)
        for axes, name in zip(row[1:3], ("lambda_s", "lambda_g"), strict=True):
            _draw_lambda(axes, gains, plant, name, seeds)
        _draw_closed(row[3], runs, plant, seeds)
        for axes in row[:3]:
            axes.set_ylim(LIMITS[plant])
        row[0].set_ylabel(f"{plant}\nsensitivity [{UNITS[plant]}]")
    for axes, title in zip(panels[0], ("noise and ridge", r"$\lambda_s$", r"$\lambda_g$", "closed loop"), strict=True):
        axes.set_title(title)
    note(panels[0, 0], "max |du| / |p| of the plan without its bounds")
    note(panels[0, 1], f"median of {len(seeds)} recordings,\nband: {BAND[0]}th to {BAND[1]}th percentile")
    figure.savefig(path)
    plt.close(figure)


def _line(axes: Any, found: Mapping[float, Array], **look: Any) -> None:
    draw_band(axes, np.array(list(found)), np.stack(list(found.values()), axis=1), **look)


def _draw_noise(axes: Any, gains: Lines, plant: str, seeds: Sequence[int]) -> None:
    _line(axes, gains_of(gains, plant, "noise", seeds), color="#0072b2", marker="o", markersize=4, label="noise")
    ridge = {size: values.mean() for size, values in gains_of(gains, plant, "ridge", seeds).items()}
    axes.plot(list(ridge), list(ridge.values()), color="#d55e00", linestyle=(0, (4, 2)), label="ridge, predicted")
    directions = np.array([values.mean() for values in gains_of(gains, plant, "direction", seeds).values()])
    seen = directions[directions > 1e-9]
    axes.plot(seen, np.full(len(seen), 0.02), "|", color="black", transform=axes.get_xaxis_transform(), markersize=9)
    axes.plot([], [], "|", color="black", label="size of a direction of y_ini")
    axes.set(xscale="log", yscale="log", xlabel="size, relative to the spread", xlim=(5e-7, 5e1))
    axes.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 0.04))


def _draw_lambda(axes: Any, gains: Lines, plant: str, name: str, seeds: Sequence[int]) -> None:
    for level, colour in NOISE_COLOURS.items():
        _line(axes, gains_of(gains, plant, name, seeds, level), color=colour, label=f"noise {level:g}")
    axes.axvline({"lambda_s": 1e6, "lambda_g": 1e2}[name], color="black", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", yscale="log", xlabel=rf"$\{name}$ (dotted: the paper's)")
    axes.legend(fontsize=8, loc="lower right")


def _draw_closed(axes: Any, runs: Lines, plant: str, seeds: Sequence[int]) -> None:
    for kind, line in (("noise", "-"), ("ridge", (0, (4, 2)))):
        sizes = sizes_of(runs, plant, kind)
        for attack in ATTACKS:
            values = np.stack([errors_of(runs, plant, kind, size, attack, seeds) for size in sizes], axis=1)
            median = np.median(values, axis=0)
            label = NAMES[attack] if kind == "noise" else None
            axes.plot(sizes, median, color=COLOURS[attack], linestyle=line, label=label)
            if kind == "noise":
                low, high = np.percentile(values, BAND, axis=0)
                axes.fill_between(sizes, low, high, color=COLOURS[attack], alpha=0.2, linewidth=0)
    axes.set(
        xscale="log", yscale="log", xlabel="noise (solid), ridge (dashed)", ylabel="mean error [m]", ylim=(0.01, 1.0)
    )
    axes.legend(fontsize=8, loc="upper right")
