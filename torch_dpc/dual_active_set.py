"""The second engine: DAQP, a dual active-set solver, on the least-distance form of the reduced problem.

    minimise 1/2 |x|^2   subject to   lower - v0 <= Ct x <= upper - v0,        v = v0 + Ct x,  x = -Ct' lam

H = I and Ct are set up once; a call updates the bounds alone. DAQP (Arnstrom, Bemporad, Axehill 2022) is finite and
exact for boxes, so it also takes the samples on which Newton's sets cycle. It supplies the active set only: the
multipliers and v come from the same systems as Newton's.
"""

from __future__ import annotations

import threading
from typing import Any
from weakref import WeakKeyDictionary

import daqp
import numpy as np
import torch
from torch import Tensor

from .active_set import solve_active
from .newton import ActiveSetResult

#: DAQP's default, 1e-6, calls slightly infeasible problems solved.
PRIMAL_TOLERANCE = 1e-10
#: What DAQP reads as no bound.
NO_BOUND = 1e30
#: DAQP's exit flag for a problem without a feasible point.
INFEASIBLE_FLAG = -1
SOLVED_FLAG = 1
_FREE, _EQUALITY = 0, 5

# One workspace a thread: a `Model` shared by threads gives wrong answers. It is kept out of every module, because it
# neither copies nor pickles, and goes when the matrix it was set up for goes.
_local = threading.local()


def solve_daqp(G: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> tuple[ActiveSetResult, Tensor]:
    """Solve the samples one after the other; the arguments are those of `solve_newton`.

    Returns:
        The result, and which samples DAQP calls infeasible, `(B,)`.
    """
    active = torch.zeros_like(v0, dtype=torch.bool)
    at_upper = torch.zeros_like(active)
    iterations = torch.zeros(len(v0), dtype=torch.int64)
    flags = np.zeros(len(v0), dtype=np.int64)
    lo = lower.expand_as(v0).cpu().numpy()
    hi = upper.expand_as(v0).cpu().numpy()
    centre = v0.cpu().numpy()
    is_active, is_upper = active.cpu().numpy(), at_upper.cpu().numpy()
    for i in range(len(v0)):
        tight = lo[i] == hi[i]
        sense = np.where(tight, _EQUALITY, _FREE).astype(np.int32)
        model = _model(Ct) if Ct.ndim == 2 else _set_up(Ct[i])
        lam, flags[i], iterations[i] = _solve_one(model, lo[i] - centre[i], hi[i] - centre[i], sense)
        if flags[i] == SOLVED_FLAG:
            is_active[i], is_upper[i] = (lam != 0) | tight, lam > 0
    active, at_upper = torch.from_numpy(is_active).to(v0.device), torch.from_numpy(is_upper).to(v0.device)
    bound = torch.where(at_upper, upper, lower)
    solved = torch.from_numpy(flags == SOLVED_FLAG).to(v0.device)
    multipliers, _ = solve_active(G, Ct, active, v0 - torch.where(active, bound, v0))
    result = ActiveSetResult(multipliers, iterations.to(v0.device), solved)
    return result, torch.from_numpy(flags == INFEASIBLE_FLAG).to(v0.device)


def _solve_one(model: Any, lower: np.ndarray, upper: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Return multipliers, exit flag and iterations of one problem.

    `sense` is passed at every update: it drops the warm start, so that the answer does not depend on history. After
    a rejected update `solve` would return the answer of the problem before, with a flag that says solved.
    """
    rejected = model.update(
        bupper=np.clip(upper, -NO_BOUND, NO_BOUND), blower=np.clip(lower, -NO_BOUND, NO_BOUND), sense=sense
    )
    if rejected < 0:
        return np.zeros_like(lower), int(rejected), 0
    _, _, flag, info = model.solve()
    return np.asarray(info["lam"]), int(flag), int(info["iterations"])


def _model(Ct: Tensor) -> Any:
    """Return this thread's workspace for a matrix."""
    models = getattr(_local, "models", None)
    if models is None:
        models = _local.models = WeakKeyDictionary()
    model = models.get(Ct)
    if model is None:
        model = models[Ct] = _set_up(Ct)
    return model


def _set_up(Ct: Tensor) -> Any:
    model = daqp.Model()
    rows, n = Ct.shape
    bound = np.full(rows, NO_BOUND)
    matrix = np.ascontiguousarray(Ct.cpu().numpy())
    flag, _ = model.setup(np.eye(n), np.zeros(n), matrix, bound, -bound, np.zeros(rows, dtype=np.int32))
    if flag < 0:
        raise RuntimeError(f"DAQP could not set up the reduced problem, exit flag {flag}.")
    model.settings = {"primal_tol": PRIMAL_TOLERANCE}
    return model


def infeasibility_certificate(Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> bool:
    """Return whether one sample `(N,)` is proven to have no v = v0 + Ct x between its bounds.

    By Farkas' lemma a direction d with Ct' d = 0 and d'v0 > max {d'b : lower <= b <= upper} is a proof. The direction
    is the residual of the nearest point, from the same engine on  min 1/2 |x|^2 + 1/(2 eps) |s|^2,
    lower <= v0 + Ct x + s <= upper,  which always has a solution; it is then checked, whoever found it.
    """
    scale = float(torch.linalg.matrix_norm(Ct, ord=2)) if Ct.numel() else 0.0
    for eps in (1e-6, 1e-9, 1e-12):
        soft = eps**0.5 * max(scale, 1e-12) * torch.eye(len(v0), dtype=Ct.dtype)
        model = _set_up(torch.cat([Ct.cpu(), soft], dim=1))
        sense = np.zeros(len(v0), dtype=np.int32)
        lam, flag, _ = _solve_one(model, (lower - v0).cpu().numpy(), (upper - v0).cpu().numpy(), sense)
        if flag == SOLVED_FLAG and _is_certificate(torch.from_numpy(lam).to(Ct), Ct, v0, lower, upper):
            return True
    return False


def _is_certificate(d: Tensor, Ct: Tensor, v0: Tensor, lower: Tensor, upper: Tensor) -> bool:
    d = d / torch.linalg.vector_norm(d).clamp_min(torch.finfo(d.dtype).tiny)
    if Ct.numel():
        left, singular, _ = torch.linalg.svd(Ct, full_matrices=False)
        span = left[:, singular > DEPENDENT * singular[0]]
        d = torch.where(d == 0, d, d - span @ (span.T @ d))  # rows without a bound must stay out of it
        leak = torch.linalg.vector_norm(Ct.T @ d)
    else:
        leak = d.new_zeros(())
    used = d != 0
    support = torch.where(d > 0, d * upper, d * lower)[used].sum()
    margin = (d * v0)[used].sum() - support
    size = torch.linalg.vector_norm(v0) + torch.linalg.vector_norm(torch.where(d > 0, upper, lower)[used])
    # A leak means that a v0 + Ct x with |x| > margin / leak is not excluded: demand it absurdly far away.
    return bool(margin > 1e-9 * size) and bool(leak * 1e6 * (1 + size) < margin)


#: Directions of Ct below this fraction of the largest are none.
DEPENDENT = 1e-10
