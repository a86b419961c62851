"""Time against gradient error, one numbered point a configuration, with a key."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from scripts.bench.cases import OURS
from scripts.shared.plots import plt, style
from scripts.shared.rows import Array

# Okabe and Ito's colours, and a marker of its own for each group.
GROUPS: dict[str, tuple[str, str, float]] = {
    "torch_dpc": ("*", "#d55e00", 260),
    "peers, our reduced form": ("o", "#0072b2", 55),
    "peers, the QP as the paper prints it": ("s", "#999999", 45),
}
FLOOR = 1e-16  # errors below this are drawn here
#: Where a label may stand: distances from the point in points, then directions.
DISTANCES, DIRECTIONS = (8, 14, 22, 32, 44, 58, 74, 92, 112), 24
MARK = 7.0  # half the size of what a point takes [points]


def scatter(path: Path, lines: list[dict[str, str]], missing: list[str]) -> None:
    """Draw the lines, which have a time and a gradient error, numbered, and name the configurations that have none."""
    style()
    figure, (axes, key) = plt.subplots(1, 2, figsize=(11.0, 6.4), width_ratios=(2.6, 1))
    points: list[tuple[float, float, str, str]] = []
    for group, (marker, colour, size) in GROUPS.items():
        chosen = [line for line in lines if _group(line["name"]) == group]
        x = [float(line["both_ms"]) for line in chosen]
        y = [max(float(line["gradient_error"]), FLOOR) for line in chosen]
        look: dict[str, Any] = {"marker": marker, "color": colour, "edgecolor": "white", "linewidth": 0.6}
        axes.scatter(x, y, s=size, label=group, zorder=4 if marker == "*" else 3, **look)
        points += [(a, b, _short(line["name"]), colour) for a, b, line in zip(x, y, chosen, strict=True)]
    axes.set(xscale="log", yscale="log", xlabel="forward + backward, one problem [ms]")
    axes.set_ylabel("relative error of the gradient")
    axes.set_title("Oscillating masses, horizon 25: time and gradient error (lower left is better)")
    axes.margins(x=0.08, y=0.08)
    points.sort()
    _write_key(key, points)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    if missing:
        note = textwrap.fill("Without a gradient in time: " + ", ".join(missing) + ".", 150)
        figure.supxlabel(note, fontsize=7.5, color="#444444")
    figure.canvas.draw()
    figure.set_layout_engine("none")  # labels are placed in pixels: nothing may move any more
    label(figure, axes, [(x, y, str(i + 1), colour) for i, (x, y, _, colour) in enumerate(points)])
    figure.savefig(path)
    plt.close(figure)


def _write_key(axes: Any, points: list[tuple[float, float, str, str]]) -> None:
    """Write the name of every numbered point, the fastest first, in the colour of its group."""
    axes.axis("off")
    step = 1 / (len(points) + 1)
    for i, (_, _, name, colour) in enumerate(points):
        place = 1 - (i + 0.5) * step
        axes.text(0.06, place, str(i + 1), ha="right", va="center", fontsize=9, weight="bold", color=colour)
        axes.text(0.10, place, name, va="center", fontsize=9)


def label(figure: Any, axes: Any, points: list[tuple[float, float, str, str]]) -> None:
    """Write a name at each point (x, y, name, colour), at the nearest place that is free, with a line to the point."""
    renderer, scale = figure.canvas.get_renderer(), figure.dpi / 72
    at = axes.transData.transform([point[:2] for point in points])
    taken = [np.array([*(centre - scale * MARK), *(centre + scale * MARK)]) for centre in at]
    frame = axes.get_window_extent(renderer).extents
    # Points with near neighbours first: they have the fewest places.
    crowd = [(np.linalg.norm((at - centre) / scale, axis=1) < 60).sum() for centre in at]
    for i in np.argsort(crowd)[::-1]:
        x, y, name, colour = points[i]
        text = axes.annotate(name, (x, y), (0, 0), textcoords="offset points", fontsize=8.5, zorder=5)
        size = np.array(text.get_window_extent(renderer).size)
        others = [box for k, box in enumerate(taken) if k != i]
        places = []
        for distance in DISTANCES:
            for angle in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
                towards = np.array([np.cos(angle), np.sin(angle)])
                middle = at[i] + scale * distance * towards + towards * size / 2
                box = np.concatenate([middle - size / 2, middle + size / 2])
                wire = _wire(at[i], box)
                hidden = _overlap(box, taken, frame) + 4 * sum(_overlap(bit, others, frame) for bit in wire)
                places.append((hidden + scale * distance, distance, box, wire))
        _, distance, box, wire = min(places, key=lambda place: place[:2])
        taken += [box + scale * np.array([-2, -1, 2, 1]), *wire]
        text.set_position(tuple((box[:2] - at[i]) / scale))
        if distance > DISTANCES[0] or crowd[i] > 1:
            ends = [at[i], np.clip(at[i], box[:2], box[2:])]
            axes.plot(*axes.transData.inverted().transform(ends).T, color=colour, linewidth=0.8, zorder=2)


def _wire(centre: Array, box: Array) -> list[Array]:
    """Return small boxes along the line from a point to its label."""
    end = np.clip(centre, box[:2], box[2:])
    bits = [p for p in np.linspace(centre, end, 24)[:-1] if np.linalg.norm(p - centre) > 2 * MARK]
    return [np.array([*(p - 1), *(p + 1)]) for p in bits]


def _overlap(box: Array, taken: list[Array], frame: Array) -> float:
    """Return the area of a box (left, bottom, right, top) that is on others or outside the frame."""
    inside = (np.minimum(box[2:], frame[2:]) - np.maximum(box[:2], frame[:2])).clip(min=0).prod()
    outside = float((box[2:] - box[:2]).prod() - inside)
    if not taken:
        return outside
    others = np.array(taken)
    shared = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    return float(shared.clip(min=0).prod(axis=1).sum()) + outside


def _group(name: str) -> str:
    groups = list(GROUPS)
    return groups[0] if name in OURS else groups[1] if name.endswith("(reduced)") else groups[2]


def _short(name: str) -> str:
    """Leave out what the colour says, and DIFFCP, which the name of its solver implies."""
    return name.removesuffix(" (reduced)").removesuffix(" (paper)").replace("cvxpylayers DIFFCP", "cvxpylayers")
