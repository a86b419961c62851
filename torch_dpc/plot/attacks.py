"""Attacks: damage against the size of the budget, perturbations in time, and proven worst cases."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ..checks import check_has
from .figure import BAND, BLUE, CYCLE, GREY, VERMILION, as_array, panels, styled


@styled
def damage(
    curves: Mapping[str, Mapping[float, Any]],
    axes: Any = None,
    *,
    ylabel: str = "damage",
    xlabel: str = r"size of the attack, $\rho$",
    relative: bool = True,
    unit: str = "runs",
) -> Figure:
    """Draw damage against the size of the attack, a curve for each attack.

    Several values at one size, one a run, are drawn as their median and the band from the 10th to the 90th percentile.

    Args:
        curves: name of the attack -> size -> a number or the values of the runs, such as
            `{"random noise": {0.01: [0.1, 0.2]}}`.
        axes: one axes; by default a new figure.
        ylabel, xlabel: what is drawn, with units.
        relative: sizes are fractions and are shown in percent.
        unit: what the several values at one size are taken over.

    Returns:
        The figure.

    Raises:
        ValueError: no curve, or a curve without sizes.

    Example:
        >>> figure = damage({"random noise": {0.01: [0.1, 0.2], 0.02: [0.2, 0.3]}}, ylabel="mean error [m]")
        >>> [line.get_label() for line in figure.axes[0].lines]
        ['random noise']
    """
    rule = "`curves` must map names to {size: values}"
    if not isinstance(curves, Mapping) or not all(isinstance(curve, Mapping) for curve in curves.values()):
        raise ValueError(f"{rule}, got {curves!r}.")
    if not curves or not all(curves.values()):
        raise ValueError("`curves` must map at least one name to {size: values}, got an empty mapping.")
    figure, (one,) = panels(axes, 1, 1, 1, (5.2, 3.6))
    counts = set()
    for i, (name, curve) in enumerate(curves.items()):
        sizes = sorted(curve)
        runs = [as_array(curve[size]).reshape(-1) for size in sizes]
        counts |= {len(values) for values in runs}
        colour = CYCLE[i % len(CYCLE)]
        one.plot(sizes, [np.nanmedian(values) for values in runs], "o-", color=colour, markersize=4, label=name)
        if any(len(values) > 1 for values in runs):
            low, high = zip(*(np.nanpercentile(values, BAND) for values in runs), strict=True)
            one.fill_between(sizes, low, high, color=colour, alpha=0.15, linewidth=0)
    one.set(xlabel=xlabel, ylabel=ylabel)
    if relative:
        one.xaxis.set_major_formatter(FuncFormatter(lambda size, _: f"{100 * size:.4g} %"))
    if max(counts) > 1:
        number = f"{max(counts)}" if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
        one.set_title(f"median and 10 to 90 % of {number} {unit}")
    one.legend()
    return figure


@styled
def perturbation(log: Any, axes: Any = None) -> Figure:
    """Draw what an attack added to the measured windows of a run: its size, and every entry.

    The picture has one row for each output and each step of the window, the oldest on top, each output in units of its
    own largest perturbation, which is written beside it.

    Args:
        log: a :class:`torch_dpc.ClosedLoopLog` of one run.
        axes: two axes, for the size and for the picture; by default a new figure.

    Returns:
        The figure.

    Raises:
        ValueError: a batch of runs.
    """
    check_has("log", log, "a ClosedLoopLog", "t", "u", "y", "y_ref", "p")
    t, p = as_array(log.t), as_array(log.p)
    if p.ndim != 3:
        raise ValueError(f"`log` must be one run, got a batch of shape {p.shape[:-3]}; draw log[i].")
    steps, t_ini, n_y = p.shape
    figure, (size, picture) = panels(axes, 2, 2, 1, (8.0, 1.6 + 0.55 * n_y + 1.2), sharex=True, height_ratios=(1, 2))
    size.plot(t, np.linalg.norm(p.reshape(steps, -1), axis=1), color=VERMILION, drawstyle="steps-post")
    size.set(ylabel="|p|", title=f"perturbation of the last {t_ini} outputs")
    size.set_ylim(bottom=0)
    largest = np.abs(p).max(axis=(0, 1))
    rows = (p / np.where(largest > 0, largest, 1.0)).transpose(2, 1, 0).reshape(n_y * t_ini, steps)
    dt = t[1] - t[0] if steps > 1 else 1.0
    kind: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -1, "vmax": 1, "aspect": "auto", "interpolation": "nearest"}
    image = picture.imshow(rows, extent=(t[0], t[-1] + dt, n_y * t_ini - 0.5, -0.5), **kind)
    for i in range(1, n_y):
        picture.axhline(i * t_ini - 0.5, color="black", linewidth=0.8)
    labels = [f"y{i} (max {value:.2g})" for i, value in enumerate(largest)]
    picture.set_yticks([i * t_ini + (t_ini - 1) / 2 for i in range(n_y)], labels)
    picture.tick_params(left=False)
    picture.grid(False)
    picture.set_xlabel("time [s]")
    figure.colorbar(image, ax=picture, label="relative to each output's largest", pad=0.02)
    return figure


@styled
def worst_case(result: Any, axes: Any = None) -> Figure:
    """Draw a proven worst case: the perturbation, and its cost between the bound and the cost without an attack.

    Args:
        result: a :class:`torch_dpc.attacks.WorstCase` of one window.
        axes: two axes; by default a new figure.

    Returns:
        The figure.

    Raises:
        ValueError: a batch of windows.
    """
    check_has("result", result, "a WorstCase", "p", "value", "bound")
    p, value, bound = (as_array(x) for x in (result.p, result.value, result.bound))
    if p.ndim != 2:
        raise ValueError(f"`result` must be that of one window, got p of shape {p.shape}.")
    figure, (entries, proof) = panels(axes, 2, 1, 2, (8.0, 3.2), width_ratios=(2, 1))
    age = np.arange(-len(p), 0)
    for i, channel in enumerate(p.T):
        entries.plot(age, channel, "o-", color=CYCLE[i % len(CYCLE)], markersize=4, label=f"y{i}")
    entries.axhline(0.0, color=GREY, linewidth=0.8)
    entries.set(xlabel="step of the window", ylabel="perturbation", title="p, the worst admissible")
    entries.legend(ncols=2, fontsize="small")
    ends = [("no attack", float(result.nominal), GREY)]
    ends += [("found", float(value), BLUE), ("bound", float(bound), VERMILION)]
    if float(value) == float(bound):  # one mark for both
        ends = [ends[0], ("found = bound", float(value), BLUE)]
    proof.plot([0] * len(ends), [end for _, end, _ in ends], color=GREY, linewidth=1.0)
    for name, end, colour in ends:
        proof.plot([0], [end], "o", color=colour)
        proof.annotate(f"{name} {end:.5g}", (0, end), (8, 0), textcoords="offset points", va="center", color=colour)
    proof.set(xlim=(-0.5, 2.5), xticks=[], ylabel=r"cost $\psi$", title=f"gap {float(as_array(result.gap)):.1e}")
    proof.margins(y=0.3)
    return figure
