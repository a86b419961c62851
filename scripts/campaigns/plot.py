"""The picture of a campaign: error against rho."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scripts.shared.plots import draw_band, plt, say_band, style

COLOURS = {"random": "#0072b2", "algorithm1": "#d55e00", "projected_gradient": "#009e73", "frank_wolfe": "#cc79a7"}
NAMES = {
    "random": "random noise",
    "algorithm1": "Algorithm 1",
    "projected_gradient": "projected gradient",
    "frank_wolfe": "Frank-Wolfe",
}
LINES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)))
TITLES = {"masses": "oscillating masses", "masses_moving": "masses on a sinusoid", "quadrotor": "quadrotor"}


def plot(path: Path, table: Any) -> None:
    """Draw the median over the seeds and the band around it, one panel a plant."""
    columns = {
        name: np.array(table[name].to_pylist()) for name in ("plant", "weights", "attack", "rho", "seed", "error")
    }
    plants, weights = _unique(columns["plant"]), _unique(columns["weights"])
    style()
    figure, panels = plt.subplots(1, len(plants), figsize=(4.6 * len(plants) + 0.6, 4.0), squeeze=False)
    for axes, plant in zip(panels[0], plants, strict=True):
        for name, line in zip(weights, LINES * len(weights), strict=False):
            of_name = "" if len(weights) == 1 else f", {name}"
            here = (columns["plant"] == plant) & (columns["weights"] == name)
            for attack, colour in COLOURS.items():
                rhos, errors = _by_rho(columns, here & (columns["attack"] == attack))
                if len(rhos):
                    look: dict[str, Any] = {"color": colour, "linestyle": line, "label": NAMES[attack] + of_name}
                    draw_band(axes, 100 * rhos, errors, marker="o", markersize=3.5, **look)
            nominal = columns["error"][here & (columns["attack"] == "none")]
            if len(nominal) and np.median(nominal) > 1e-6:
                look = {"color": "black", "linewidth": 1.0, "linestyle": line, "label": "no attack" + of_name}
                axes.axhline(np.median(nominal), **look)
        axes.set(title=TITLES[plant], xlabel=r"$\rho$ [%]", ylim=(0, None), xlim=(0, None))
    panels[0, 0].set_ylabel("mean tracking error [m]")
    say_band(panels[0, 0], len(set(columns["seed"].tolist())))
    handles = {label: handle for axes in panels[0] for handle, label in zip(*axes.get_legend_handles_labels())}  # noqa: B905
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=2, fontsize=9)
    figure.savefig(path)
    plt.close(figure)


def _by_rho(columns: dict[str, np.ndarray], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of rho and the errors, `(seeds, rho)`."""
    rhos = np.unique(columns["rho"][rows])
    return rhos, np.stack([columns["error"][rows & (columns["rho"] == rho)] for rho in rhos], 1) if len(rhos) else rhos


def _unique(values: np.ndarray) -> list[str]:
    return list(dict.fromkeys(values.tolist()))
