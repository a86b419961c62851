"""The second engine: DAQP, a dual active-set solver, on the least-distance form of the reduced problem.

    minimise 1/2 |x|^2   subject to   lower - v0 <= Ct x <= upper - v0,        v = v0 + Ct x,  x = -Ct' lam

H = I and Ct are set up once; a call updates the bounds alone. DAQP (Arnstrom, Bemporad, Axehill 2022) is finite and
exact for boxes, so it also takes the samples on which Newton's sets cycle. It supplies the active set only: the
multipliers come from the same systems as Newton's.
"""

from __future__ import annotations

import threading
from typing import Any

import daqp
import numpy as np
import torch
from torch import Tensor

from .active_set import solve_active
from .outcome import Found

#: DAQP's default, 1e-6, calls slightly infeasible problems solved.
PRIMAL_TOLERANCE = 1e-10
#: DAQP's exit flag for an optimal solution.
SOLVED_FLAG = 1
_EQUALITY = np.int32(5)
#: DAQP's infinity.
_NO_BOUND = 1e30


class Daqp:
    """One workspace a thread for each matrix: a `daqp.Model` shared by threads gives wrong answers.

    Kept by the factors of a layer, which never travel with copies or pickles; a `Model` does neither.

    Args:
        Ct: the rows, `(N, n_x)`.
    """

    def __init__(self, Ct: Tensor):
        self._Ct = np.ascontiguousarray(Ct.detach().cpu().numpy())
        self._local = threading.local()

    def solve(self, lower: np.ndarray, upper: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, int, int]:
        """Return multipliers `(N,)`, exit flag and iterations for lower <= Ct x <= upper, equal where `sense` says."""
        model = getattr(self._local, "model", None)
        if model is None:
            model = self._local.model = self._set_up()
        # `sense` drops the warm start, so that the answer does not depend on history. After a rejected update, `solve`
        # would return the answer of the problem before with a flag that says solved.
        rejected = model.update(bupper=upper, blower=lower, sense=sense)
        if rejected < 0:
            return np.zeros_like(lower), int(rejected), 0
        _, _, flag, info = model.solve()
        return np.asarray(info["lam"]), int(flag), int(info["iterations"])

    def _set_up(self) -> Any:
        model = daqp.Model()
        rows, n = self._Ct.shape
        bound = np.full(rows, _NO_BOUND)
        flag, _ = model.setup(np.eye(n), np.zeros(n), self._Ct, bound, -bound, np.zeros(rows, dtype=np.int32))
        if flag < 0:
            raise RuntimeError(f"DAQP could not set up the reduced problem, exit flag {flag}.")
        model.settings = {"primal_tol": PRIMAL_TOLERANCE}
        return model


def sense_of(tight: np.ndarray) -> np.ndarray:
    """Return DAQP's constraint types: equality where lower and upper bound are equal."""
    return tight * _EQUALITY


def solve_daqp(G: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor, workspace: Daqp | None = None) -> Found:
    """Solve the samples one after the other; arguments and result are those of `solve_newton`.

    Args:
        G, Ct, v0, lower, upper: as there.
        workspace: the one of a shared Ct; made anew for each call and sample by default.
    """
    lower, upper = lower.expand_as(v0), upper.expand_as(v0)
    found, tight = np.zeros(v0.shape), (lower == upper).cpu().numpy()
    iterations, solved = np.zeros(len(v0), dtype=np.int64), np.zeros(len(v0), dtype=bool)
    below, above = ((bound - v0).detach().cpu().numpy() for bound in (lower, upper))
    for i in range(len(v0)):
        daqp_of_sample = workspace or Daqp(Ct if Ct.ndim == 2 else Ct[i])
        found[i], flag, iterations[i] = daqp_of_sample.solve(below[i], above[i], sense_of(tight[i]))
        solved[i] = flag == SOLVED_FLAG
    rough, *rest = (torch.from_numpy(x).to(v0.device) for x in (found, iterations, solved))
    active = (rough != 0) | (lower == upper)
    lam, _ = solve_active(G, Ct, active, v0 - torch.where(rough > 0, upper, lower))
    return Found(lam, *rest)
