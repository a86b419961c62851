"""Runs in closed loop: outputs, inputs, bounds, references, plans and perturbations against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..checks import check_has
from .figure import (
    BAND_LABEL,
    BLUE,
    FEW_RUNS,
    GREEN,
    GREY,
    VERMILION,
    Array,
    as_array,
    draw_bounds,
    draw_runs,
    legend_of,
    names_of,
    new_figure,
    panels,
    styled,
)


@styled
def log(
    log: Any,
    axes: Any = None,
    *,
    layer: Any = None,
    y_names: Sequence[str] | None = None,
    u_names: Sequence[str] | None = None,
) -> Figure:
    """Draw a run, or a batch of runs, in closed loop.

    One panel for each output, with its reference; one for each input; and, if the run was attacked, one for |p|. Marks
    on the time axis show the steps at which the controller planned. Of more than eight runs the median and the band
    from the 10th to the 90th percentile are drawn.

    Args:
        log: a :class:`torch_dpc.ClosedLoopLog`.
        axes: n_y + n_u axes, one more if the run was attacked; by default a new figure.
        layer: the :class:`torch_dpc.DPCLayer` of the controller. Its box bounds are drawn where they are
            near the run.
        y_names, u_names: of the channels, with units, such as "height [m]".

    Returns:
        The figure.

    Raises:
        ValueError: names or axes that do not fit.
    """
    check_has("log", log, "a ClosedLoopLog", "t", "u", "y", "y_ref", "p")
    t, u, y, y_ref, p = (as_array(x) for x in (log.t, log.u, log.y, log.y_ref, log.p))
    n_y, n_u = y.shape[-1], u.shape[-1]
    attacked = bool(np.any(p))
    y_names, u_names = names_of(y_names, n_y, "y"), names_of(u_names, n_u, "u")
    count = n_y + n_u + attacked
    figure, all_axes = _two_columns(n_y, count - n_y) if axes is None else panels(axes, count, count, 1, (0.0, 0.0))
    u, y, p = (x.reshape(-1, *x.shape[-k:]) if x.ndim > k else x for x, k in ((u, 2), (y, 2), (p, 3)))
    bounds = _bounds(layer, n_u, n_y)
    for i, one in enumerate(all_axes[:n_y]):
        _draw_reference(one, t, y_ref[..., i])
        draw_runs(one, t, y[..., i], color=BLUE, label="output", zorder=3)
        draw_bounds(one, t, *bounds["y"][i])
        one.set_ylabel(y_names[i])
    for i, one in enumerate(all_axes[n_y : n_y + n_u]):
        draw_runs(one, t, u[..., i], color=GREEN, label="input", drawstyle="steps-post")
        draw_bounds(one, t, *bounds["u"][i])
        one.set_ylabel(u_names[i])
    if attacked:
        size = np.linalg.norm(p.reshape(*p.shape[:-2], -1), axis=-1)
        draw_runs(all_axes[-1], t, size, color=VERMILION, label="perturbation", drawstyle="steps-post")
        all_axes[-1].set_ylabel("|p|")
        all_axes[-1].set_ylim(bottom=0)
    for one in all_axes:
        _mark_plans(one, t, as_array(log.replanned))
    for one in (all_axes[n_y - 1], all_axes[-1]):
        one.set_xlabel("time [s]")
    if axes is None:
        runs = y.shape[0] if y.ndim == 3 else 1
        how = BAND_LABEL if runs > FEW_RUNS else "a line each"
        legend_of(figure, all_axes, f"{runs} runs, {how}" if runs > 1 else None)
    return figure


def _two_columns(left: int, right: int) -> tuple[Figure, list[Axes]]:
    """Return a new figure with so many panels in a left and in a right column of one height."""
    figure = new_figure((9.0, max(1.25 * max(left, right) + 0.8, 2.8)))
    columns = np.asarray(figure.subfigures(1, 2))
    found: list[Axes] = []
    for column, count in zip(columns, (left, right), strict=True):
        found += list(column.subplots(count, 1, sharex=True, squeeze=False)[:, 0])
        column.align_ylabels()
    return figure, found


def _draw_reference(axes: Axes, t: Array, reference: Array) -> None:
    """Draw the reference once if all runs share it."""
    flat = reference.reshape(-1, reference.shape[-1])
    shared = bool((flat == flat[0]).all())
    draw_runs(axes, t, flat[0] if shared else flat, color="black", linestyle="--", linewidth=1.0, label="reference")


def _mark_plans(axes: Axes, t: Array, replanned: Array) -> None:
    """Mark the steps at which plans were made, along the bottom; of a batch those of its first run."""
    at = t[replanned.reshape(-1, len(t))[0] > 0]
    if len(at) < len(t):  # a plan at every step says nothing
        at_the_bottom = axes.get_xaxis_transform()
        axes.plot(at, 0 * at, "^", color=GREY, markersize=4, transform=at_the_bottom, label="plan made", clip_on=False)


def _bounds(layer: Any, n_u: int, n_y: int) -> dict[str, list[tuple[Array, Array]]]:
    """Return lower and upper of each channel; infinite where a set is no box or differs from step to step."""
    found: dict[str, list[tuple[Array, Array]]] = {}
    for name, channels in (("u", n_u), ("y", n_y)):
        owner = getattr(layer, f"{name}_set", None)
        ends = []
        for end, none in (("lower", -np.inf), ("upper", np.inf)):
            bound = as_array(getattr(owner, end, none))
            ends.append(np.broadcast_to(bound if bound.ndim < 2 else np.asarray(none), (channels,)))
        found[name] = list(zip(*ends, strict=True))
    return found
