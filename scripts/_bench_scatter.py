"""Time against gradient error, one labelled point a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from _bench_cases import OURS
from _common import Array
from _plots import plt, style

# Okabe and Ito's colours, and a marker of its own for each group.
GROUPS = {
    "torch_dpc": ("*", "#d55e00", 260),
    "peers, our reduced form": ("o", "#0072b2", 55),
    "peers, the QP as the paper prints it": ("s", "#999999", 45),
}
FLOOR = 1e-16  # errors below this are drawn here
#: Where a label may stand: distances from the point in points, then directions.
DISTANCES, DIRECTIONS = (8, 16, 28, 42, 58, 76, 96), 16


def scatter(path: Path, lines: list[dict[str, str]]) -> None:
    """Draw the lines that have a time and a gradient error."""
    style()
    figure, axes = plt.subplots(figsize=(9.6, 6.0))
    points = []
    for group, (marker, colour, size) in GROUPS.items():
        chosen = [
            line for line in lines if _group(line["name"]) == group and line["gradient_error"] and line["both_ms"]
        ]
        x = [float(line["both_ms"]) for line in chosen]
        y = [max(float(line["gradient_error"]), FLOOR) for line in chosen]
        axes.scatter(x, y, s=size, marker=marker, color=colour, label=group, edgecolor="white", linewidth=0.6, zorder=3)
        points += [(*xy, _short(line["name"]), colour) for *xy, line in zip(x, y, chosen, strict=True)]
    axes.set(xscale="log", yscale="log", xlabel="forward + backward, one problem [ms]")
    axes.set_ylabel("relative error of the gradient")
    axes.set_title("Oscillating masses, horizon 25: time and gradient error (lower left is better)")
    axes.margins(x=0.14, y=0.12)
    axes.legend(loc="lower right")
    figure.canvas.draw()
    label(figure, axes, points)
    figure.savefig(path)
    plt.close(figure)


def label(figure: Any, axes: Any, points: list[tuple[float, float, str, str]]) -> None:
    """Write a name at each point (x, y, name, colour), the first place that is free, with a line if it is far."""
    renderer = figure.canvas.get_renderer()
    scale = figure.dpi / 72
    at = axes.transData.transform([point[:2] for point in points])
    marks = [np.array([x - 6, y - 6, x + 6, y + 6]) for x, y in at]
    taken = [axes.get_legend().get_window_extent(renderer).extents, *marks]
    frame = axes.get_window_extent(renderer).extents
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    for (x, y, name, colour), centre in zip(points, at, strict=True):
        text = axes.annotate(name, (x, y), (0, 0), textcoords="offset points", fontsize=8.5, color="black", zorder=4)
        width, height = text.get_window_extent(renderer).size
        places = []
        for distance in DISTANCES:
            for angle in angles:
                middle = centre + scale * distance * np.array([np.cos(angle), np.sin(angle)])
                middle[0] += np.cos(angle) * width / 2
                middle[1] += np.sin(angle) * height / 2
                box = np.concatenate([middle - (width / 2, height / 2), middle + (width / 2, height / 2)])
                places.append((_overlap(box, taken, frame), distance, box))
        cost, distance, box = min(places, key=lambda place: place[:2])
        taken.append(box + (-2, -2, 2, 2))
        text.set_position(tuple((box[:2] - centre) / scale))
        if distance > DISTANCES[0]:
            end = np.clip(centre, box[:2], box[2:])
            line = axes.transData.inverted().transform([centre, end])
            axes.plot(*line.T, color=colour, linewidth=0.7, zorder=2)


def _overlap(box: Array, taken: list[Array], frame: Array) -> float:
    """Return the area of a box (left, bottom, right, top) that is on others or outside the frame."""
    others = np.array(taken)
    size = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    inside = (np.minimum(box[2:], frame[2:]) - np.maximum(box[:2], frame[:2])).clip(min=0).prod()
    return float(size.clip(min=0).prod(axis=1).sum() + (box[2:] - box[:2]).prod() - inside)


def _group(name: str) -> str:
    groups = list(GROUPS)
    return groups[0] if name in OURS else groups[1] if name.endswith("(reduced)") else groups[2]


def _short(name: str) -> str:
    """Leave out what the colour says."""
    return name.removesuffix(" (reduced)").removesuffix(" (paper)")
