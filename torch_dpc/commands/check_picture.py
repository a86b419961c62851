"""The picture of a check: the data, and the errors of held-out predictions; imports matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from ..data.hankel import HankelData
from ..plot.figure import CYCLE, Array, panels, styled
from ..plot.recordings import data as draw_data


@styled
def draw_check(data: HankelData, errors: Array, holding: Array, windows: int, names: Sequence[str]) -> Figure:
    """Draw data and errors, `(horizon, n_y)` each, of so many held-out windows."""
    figure, axes = panels(None, 4, 1, 4, (14.0, 3.6), width_ratios=(1.5, 1, 1, 1.2))
    draw_data(data, axes[:3])
    steps = range(1, data.horizon + 1)
    for i, name in enumerate(names):
        colour = CYCLE[i % len(CYCLE)]
        axes[3].semilogy(steps, 100 * errors[:, i], color=colour, label=name)
        axes[3].semilogy(steps, 100 * holding[:, i], color=colour, linestyle=":")
    axes[3].plot([], [], color="black", linestyle=":", label="last output, held")
    axes[3].set(xlabel="step ahead", ylabel="error, % of standard deviation")
    axes[3].set_title(f"prediction of {windows}\nheld-out windows")
    axes[3].legend(fontsize="small")
    return figure
