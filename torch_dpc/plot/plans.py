"""Plans: the past window, the planned future, and what really happened."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..checks import check_has
from .figure import BLUE, GREEN, GREY, Array, as_array, draw_runs, legend_of, names_of, panels, styled


@styled
def plan(
    plan: Any,
    axes: Any = None,
    *,
    past: tuple[Any, Any] | None = None,
    truth: Any = None,
    y_ref: Any = None,
    dt: float | None = None,
    y_names: Sequence[str] | None = None,
    u_names: Sequence[str] | None = None,
) -> Figure:
    """Draw a plan, or a batch of plans: the past, the plan, and the truth where it is known.

    Step 0 is the first planned one. One panel for each output, then one for each input.

    Args:
        plan: a :class:`torch_dpc.DPCSolution`.
        axes: n_y + n_u axes; by default a new figure.
        past: u_ini and y_ini, `(*batch, t_ini, n)`, that the plan was made from.
        truth: outputs that really followed, `(*batch, steps, n_y)`, or the pair of inputs and outputs.
        y_ref: reference, `(n_y,)` or `(horizon, n_y)`.
        dt: sampling time [s]; the axis is in steps without it.
        y_names, u_names: of the channels, with units.

    Returns:
        The figure.

    Raises:
        ValueError: names or axes that do not fit.
    """
    check_has("plan", plan, "a DPCSolution", "u", "y")
    u, y = (_flat(x) for x in (plan.u, plan.y))
    n_u, n_y, horizon = u.shape[-1], y.shape[-1], y.shape[-2]
    names = names_of(y_names, n_y, "y") + names_of(u_names, n_u, "u")
    u_past, y_past = (None, None) if past is None else (_flat(x) for x in past)
    u_true, y_true = truth if isinstance(truth, tuple) else (None, truth)
    reference = None if y_ref is None else np.broadcast_to(as_array(y_ref), (horizon, n_y))
    rows = -(-(n_y + n_u) // 2)
    figure, all_axes = panels(axes, n_y + n_u, rows, 2, (9.0, max(1.35 * rows + 0.8, 2.8)), sharex=True)
    step = 1.0 if dt is None else dt
    for i, one in enumerate(all_axes):
        is_output = i < n_y
        channel = i if is_output else i - n_y
        series = (y_past, y, y_true) if is_output else (u_past, u, u_true)
        before, planned, after = (np.empty(0) if x is None else _flat(x)[..., channel] for x in series)
        style: dict[str, Any] = {} if is_output else {"drawstyle": "steps-post"}
        if before.size:
            draw_runs(one, _times(step, -before.shape[-1], 0), before, color=GREY, label="past", **style)
            one.axvline(0.0, color=GREY, linewidth=0.8, linestyle=":")
        if is_output and reference is not None:
            one.plot(_times(step, 0, horizon), reference[:, channel], "k--", linewidth=1.0, label="reference")
        colour = BLUE if is_output else GREEN
        label = "planned output" if is_output else "planned input"
        draw_runs(one, _times(step, 0, horizon), planned, color=colour, label=label, **style)
        if after.size:
            points: dict[str, Any] = {"linewidth": 1.0, "marker": ".", "markersize": 4}
            draw_runs(one, _times(step, 0, after.shape[-1]), after, color="black", label="truth", **points, **style)
        one.set_ylabel(names[i])
    for i in {rows - 1, len(all_axes) - 1}:
        all_axes[i].set_xlabel("step of the plan" if dt is None else "time from the plan [s]")
        all_axes[i].tick_params(labelbottom=True)
    if axes is None:
        legend_of(figure, all_axes)
    return figure


def _times(step: float, first: int, end: int) -> Array:
    return as_array(step * np.arange(first, end))


def _flat(values: Any) -> Array:
    """Return `(steps, n)` as it is, and batches of any shape as `(runs, steps, n)`."""
    array = as_array(values)
    return array if array.ndim == 2 else array.reshape(-1, *array.shape[-2:])
