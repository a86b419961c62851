"""A case as the reference takes it."""

import numpy as np

from tests.oracles.extended import Array
from tests.oracles.problem import Piece, Problem

from .problems import Case, Spec


def problem_of(case: Case) -> Problem:
    """Return the problem: Hankel matrices of all recordings, weights of the whole horizon, pieces of the sets."""
    window = case.t_ini + case.horizon
    columns_u, columns_y = [], []
    for u, y in case.recordings:
        for k in range(len(u) - window + 1):
            columns_u.append(u[k : k + window])
            columns_y.append(y[k : k + window])
    U, Y = (np.stack(c, axis=-1).reshape(-1, len(c)) for c in (columns_u, columns_y))
    cut_u, cut_y = case.t_ini * case.n_u, case.t_ini * case.n_y
    w = dict(case.weights)
    for name, n in (("Q", case.n_y), ("R", case.n_u), ("R_du", case.n_u)):
        if name in w and len(w[name]) == n:
            w[name] = np.kron(np.eye(case.horizon), w[name])
    offsets = {"u_set": (0, case.n_u), "y_set": (case.horizon * case.n_u, case.n_y),
               "du_set": (case.horizon * (case.n_u + case.n_y), case.n_u)}  # fmt: skip
    pieces = []
    for name, spec in case.sets.items():
        start, n = offsets[name]
        pieces += _pieces(spec, start + np.arange(case.horizon * n).reshape(case.horizon, n))
    return Problem(U[:cut_u], U[cut_u:], Y[:cut_y], Y[cut_y:], case.n_u, case.n_y, case.t_ini, case.horizon,
                   pieces=pieces, **w)  # fmt: skip


def _pieces(spec: Spec, rows: Array) -> list[Piece]:
    """Return the pieces of a set over `rows`, `(horizon, channels)`."""
    kind = spec[0]
    if kind == "product":
        return [piece for part, channels in spec[1] for piece in _pieces(part, rows[:, channels])]
    if kind in ("box", "soft", "nonnegative"):
        lower, upper = (0.0, np.inf) if kind == "nonnegative" else spec[1:3]
        price = spec[3] if kind == "soft" else np.inf
        ends = [np.broadcast_to(np.asarray(x, float), rows.shape).ravel() for x in (lower, upper, price)]
        return [Piece("interval", rows.ravel(), *ends)]
    groups = rows.ravel()[None] if spec[-1] == "trajectory" else rows
    if kind == "cone":
        return [Piece("cone", group) for group in groups]
    center = np.broadcast_to(np.asarray(spec[2], float), rows.shape).reshape(groups.shape)
    return [Piece("ball", g, radius=spec[1], center=c) for g, c in zip(groups, center, strict=True)]
