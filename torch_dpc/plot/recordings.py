"""Recorded data: the Hankel matrix as a picture, its rank, and how exciting the input is."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..checks import check_has
from .figure import BLUE, GREY, VERMILION, Array, as_array, panels, styled

#: Columns of the picture: more windows are thinned out evenly.
SHOWN_WINDOWS = 400
FLOOR = 1e-18  # singular values below this fraction of the largest are drawn here


@styled
def data(data: Any, axes: Any = None) -> Figure:
    """Draw recorded data: the Hankel matrix, the singular values with the cut that decides the rank, and excitation.

    The picture has one column a window and one row for each channel and step, time downwards, each channel in units of
    its own size. The singular values are those of the scaled matrix, relative to the largest; the rank counts those
    above the tolerance. A noise-free linear system leaves a gap there, n_u (t_ini + horizon) + its order values above
    it. The input is persistently exciting of order t_ini + horizon if all singular values of its rows are above.

    Args:
        data: :class:`torch_dpc.HankelData`.
        axes: three axes; by default a new figure.

    Returns:
        The figure.

    Raises:
        ValueError: another number of axes.
    """
    check_has("data", data, "a HankelData", "Up", "Yp", "Uf", "Yf", "row_space")
    figure, (picture, values, inputs) = panels(axes, 3, 1, 3, (11.0, 3.6), width_ratios=(1.5, 1, 1))
    blocks = [as_array(m) for m in (data.Up, data.Yp, data.Uf, data.Yf)]
    units = as_array(data.row_space.units)
    scaled = np.concatenate(blocks) / units[:, None]
    _draw_picture(picture, figure, data, scaled, [len(block) for block in blocks])
    spectrum, tolerance = as_array(np.linalg.svd(scaled, compute_uv=False)), data.rank_tolerance
    _draw_spectrum(values, spectrum, tolerance, data.rank)
    space = data.row_space
    dropped = f"{space.first_dropped:.0e}" if data.rank < len(spectrum) else "none"
    values.set_title(f"all rows: rank {data.rank} of {space.n_rows}\n{space.last_kept:.0e} kept, {dropped} dropped")
    n_past, n_out = len(blocks[0]), len(blocks[1])
    u_rows = np.r_[0:n_past, n_past + n_out : n_past + n_out + len(blocks[2])]
    exciting = as_array(np.linalg.svd(scaled[u_rows], compute_uv=False))
    exciting = np.pad(exciting, (0, len(u_rows) - len(exciting)))  # fewer windows than rows: the others are zero
    rank = int((exciting > tolerance * exciting[0]).sum())
    _draw_spectrum(inputs, exciting, tolerance, rank)
    enough = "exciting" if rank == len(u_rows) else "NOT exciting"
    inputs.set_title(f"input rows: rank {rank} of {len(u_rows)}\n{enough} of order {data.t_ini + data.horizon}")
    return figure


def _draw_picture(axes: Axes, figure: Figure, data: Any, scaled: Array, heights: list[int]) -> None:
    shown = scaled[:, np.linspace(0, scaled.shape[1] - 1, min(scaled.shape[1], SHOWN_WINDOWS)).round().astype(int)]
    limit = float(np.percentile(np.abs(shown), 99)) or 1.0
    extent = (-0.5, scaled.shape[1] - 0.5, len(scaled) - 0.5, -0.5)
    kind: dict[str, Any] = {"cmap": "RdBu_r", "aspect": "auto", "interpolation": "nearest"}
    image = axes.imshow(shown, extent=extent, vmin=-limit, vmax=limit, **kind)
    edges = np.cumsum([0, *heights])
    for edge in edges[1:-1]:
        axes.axhline(edge - 0.5, color="black", linewidth=1.0)
    names = (r"$U_p$", r"$Y_p$", r"$U_f$", r"$Y_f$")
    axes.set_yticks((edges[:-1] + edges[1:] - 1) / 2, names)
    axes.tick_params(left=False)
    axes.grid(False)
    kept = f"{data.n_windows} windows" + ("" if data.has_windows else f", compact in {data.n_g} columns")
    axes.set(xlabel=kept, title=f"Hankel matrix:\n{data.t_ini} past and {data.horizon} future steps")
    figure.colorbar(image, ax=axes, label="relative to the size of the channel", pad=0.02)


def _draw_spectrum(axes: Axes, spectrum: Array, tolerance: float, rank: int) -> None:
    relative = np.maximum(spectrum / (spectrum[0] or 1.0), FLOOR)
    index = np.arange(1, len(relative) + 1)
    axes.semilogy(index[:rank], relative[:rank], ".", color=BLUE, label="kept")
    if rank < len(relative):
        axes.semilogy(index[rank:], relative[rank:], ".", color=VERMILION, label="counted as zero")
    axes.axhline(tolerance, color=GREY, linestyle="--", linewidth=1.0, label=f"tolerance {tolerance:.0e}")
    axes.set(xlabel="singular value", ylabel="relative to the largest")
    axes.legend(loc="best", fontsize="small")
