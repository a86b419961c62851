"""Data: Hankel matrices, recordings, streams, files."""

import numpy as np
import torch

import torch_dpc as dpc
from helpers import randn, small_data

from .entry import INF, NAN, NO_COUNT, Call, each, one

U, Y = randn(60, 2), randn(60, 3, seed=1)
DATA = small_data()
SIZES = {"t_ini": 2, "horizon": 4}


def record(u=U, y=Y, **sizes):
    return dpc.HankelData.from_trajectories(u, y, **{**SIZES, **sizes})


def matrices(**changes):
    """Return data made from matrices as they are."""
    parts = {name: getattr(DATA, name) for name in ("Up", "Uf", "Yp", "Yf", "t_ini", "horizon", "n_u", "n_y")}
    return dpc.HankelData(**{**parts, **changes})


NO_RECORDING = (
    None,
    3,
    1.5,
    "a",
    {},
    [],
    torch.zeros(60, 2, dtype=torch.int64),
    torch.zeros(60, 2, dtype=torch.bool),
    torch.zeros(60, 2, dtype=torch.complex128),
    np.full((60, 2), NAN),
    np.full((60, 2), INF),
    torch.zeros(()),
    torch.zeros(60, dtype=torch.float64),
    torch.zeros(2, 60, 2, dtype=torch.float64),
    [[1.0], [1.0, 2.0]],
    [[1, 2]] * 60,
    np.array([["a", "b"]] * 60),
    torch.zeros(60, 0),
    object(),
)
NO_MATRIX = (None, "a", 3.0, [[1.0]], DATA.Up[:3], DATA.Up.long(), DATA.Up * NAN, DATA.Up[0])


def calls() -> list[Call]:
    """Return the table."""
    stream = lambda **options: dpc.HankelStream(**{**SIZES, **options})  # noqa: E731
    return [
        *each("u", "from_trajectories u", NO_RECORDING, lambda u: record(u=u)),
        *each("y", "from_trajectories y", NO_RECORDING, lambda y: record(y=y)),
        *each("t_ini", "from_trajectories t_ini", NO_COUNT, lambda n: record(t_ini=n)),
        *each("horizon", "from_trajectories horizon", NO_COUNT, lambda n: record(horizon=n)),
        *one("u", "strings", lambda: record(u="a", y="b")),
        *one("`u` and `y`", "lengths differ", lambda: record(u=U[:50])),
        *one("`u` and `y`", "counts differ", lambda: record(u=[U, U], y=[Y])),
        *one("u", "channels differ", lambda: record(u=[U, U[:, :1]], y=[Y, Y])),
        *one("one window", "too short", lambda: record(u=U[:5], y=Y[:5])),
        *each("Up", "HankelData Up", NO_MATRIX, lambda m: matrices(Up=m)),
        *each("Uf", "HankelData Uf", NO_MATRIX[:4], lambda m: matrices(Uf=m)),
        *each("Yp", "HankelData Yp", NO_MATRIX[:4], lambda m: matrices(Yp=m)),
        *each("Yf", "HankelData Yf", NO_MATRIX[:4], lambda m: matrices(Yf=m)),
        *each("t_ini", "HankelData t_ini", NO_COUNT, lambda n: matrices(t_ini=n)),
        *each("horizon", "HankelData horizon", NO_COUNT, lambda n: matrices(horizon=n)),
        *each("n_u", "HankelData n_u", NO_COUNT, lambda n: matrices(n_u=n)),
        *each("n_y", "HankelData n_y", NO_COUNT, lambda n: matrices(n_y=n)),
        *one("Uf", "HankelData of another horizon", lambda: matrices(horizon=7)),
        *one("Up", "HankelData of other inputs", lambda: matrices(n_u=7)),
        *one("Yp", "HankelData of other outputs", lambda: matrices(n_y=7)),
        *one("Uf", "HankelData of other windows", lambda: matrices(Up=DATA.Up[:, :5])),
        *one("w", "hankel deeper than the signal", lambda: dpc.hankel(U, 61)),
        *each("windows_seen", "HankelData windows_seen", (-1, 1.5, "a"), lambda n: matrices(windows_seen=n)),
        *each("members", "HankelBatch", ([], [1], None, 3, DATA), dpc.HankelBatch),
        *one("be alike", "HankelBatch of other sizes", lambda: dpc.HankelBatch([DATA, record()])),
        *each("t_ini", "HankelStream t_ini", NO_COUNT, lambda n: stream(t_ini=n)),
        *each("horizon", "HankelStream horizon", NO_COUNT, lambda n: stream(horizon=n)),
        *each(
            "forgetting",
            "HankelStream forgetting",
            (0.0, -1.0, 1.5, NAN, INF, "a", None, True),
            lambda f: stream(forgetting=f),
        ),
        *each("data", "HankelStream.from_data", (None, 3, "a", U), dpc.HankelStream.from_data),
        *each("u", "append u", NO_RECORDING[:7], lambda u: stream().append(u, Y)),
        *each("y", "append y", NO_RECORDING[:7], lambda y: stream().append(U, y)),
        *one("`u` and `y`", "append lengths", lambda: stream().append(U[:5], Y)),
        *one("a window", "no window yet", lambda: stream().data),
        *each(
            "chunks",
            "from_stream",
            (None, 3, "ab", [1, 2], [(U,)], [(U, Y, Y)]),
            lambda c: dpc.HankelData.from_stream(c, **SIZES),
        ),
        *each("depth", "hankel depth", NO_COUNT, lambda n: dpc.hankel(U, n)),
        *each("w", "hankel w", (None, 3, "a", torch.zeros(()), U[:, 0].long()), lambda w: dpc.hankel(w, 3)),
        *each("recordings", "excitation_order", (None, [], 3, "a", ["a"], [torch.zeros(())]), dpc.excitation_order),
    ]
