"""The film of Figure 4: two recorded flights side by side, seen by PyBullet's camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.animation import PillowWriter
from tqdm import tqdm

from scripts.shared.plots import NAMES, percent, plt, style
from scripts.shared.rows import Array, Rows, grid
from scripts.shared.statistics import NOMINAL, POISON
from torch_dpc.systems import Quadrotor

WIDTH, HEIGHT = 320, 260  # of each picture [pixels]
# [m, degrees]
CAMERA: dict[str, Any] = {"target": (0.0, 0.15, 1.0), "distance": 1.25, "yaw": -60.0, "pitch": -38.0, "fov": 45.0}
TITLE = 24  # height of the line above them [pixels]
MARGINS = {"left": 0, "bottom": 0, "right": 1, "top": HEIGHT / (HEIGHT + TITLE), "wspace": 0.01}
PATH_COLOURS = {NOMINAL: "#0072b2", POISON: "#d55e00"}
EVERY = 5  # steps of 0.04 s between two pictures
SPEED = 2  # times real time


def film(path: Path, rows: Rows, rho: float, reference: Array) -> None:
    """Film the first seed's flight without an attack and under Algorithm 1.

    The recorded poses are set, not flown again; the circle and the path so far are drawn over the camera's picture.
    """
    style()
    flights = ((NOMINAL, 0.0), (POISON, rho))
    poses = [
        np.stack([grid(rows, name, *flight)[0] for name in ("x", "y", "z", "roll", "pitch", "yaw")], axis=1)
        for flight in flights
    ]
    t = grid(rows, "t", *flights[0])[0]
    errors = [grid(rows, "error", *flight)[0] for flight in flights]
    figure = plt.figure(figsize=(2 * WIDTH / 100, (HEIGHT + TITLE) / 100))
    figure.set_layout_engine("none")
    panels = figure.subplots(1, 2, gridspec_kw=MARGINS)
    writer = PillowWriter(fps=round(SPEED / (EVERY * 0.04)))
    with Quadrotor() as plant, writer.saving(figure, str(path), dpi=100):
        for step in tqdm(range(0, len(t), EVERY), desc="Film", unit="frame", mininterval=1.0):
            for axes, (attack, level), pose, error in zip(panels, flights, poses, errors, strict=True):
                axes.clear()
                plant.reset(position=pose[step, :3], rpy=pose[step, 3:])
                axes.imshow(plant.render(WIDTH, HEIGHT, **CAMERA), aspect="auto")
                axes.plot(*project(reference[:, :3]), color="black", linestyle="--", linewidth=1.2)
                axes.plot(*project(pose[: step + 1, :3]), color=PATH_COLOURS[attack], linewidth=2)
                axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
                axes.axis("off")
                axes.set_title(NAMES[attack] + (f", $\\rho$ = {percent(level)}" if level else ""), pad=4)
                label = axes.text(8, HEIGHT - 10, f"t = {t[step]:4.1f} s    error {error[step]:.2f} m", fontsize=10)
                label.set_path_effects([patheffects.withStroke(linewidth=3, foreground="white")])
            writer.grab_frame()
    plt.close(figure)


def project(points: Array) -> tuple[Array, Array]:
    """Return where the camera sees points, `(n, 3)` [m], as pixels from the left and from the top."""
    yaw, pitch = np.radians([CAMERA["yaw"], CAMERA["pitch"]])
    ahead = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    offset = points - (np.array(CAMERA["target"]) - CAMERA["distance"] * ahead)
    focal = HEIGHT / 2 / np.tan(np.radians(CAMERA["fov"]) / 2) / (offset @ ahead)  # pixels a metre at that depth
    return WIDTH / 2 + focal * (offset @ right), HEIGHT / 2 - focal * (offset @ np.cross(right, ahead))
