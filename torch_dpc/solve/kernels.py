"""The compiled kernels of `_kernels.c`: the small systems of a sample without the dispatch of an array library.

They take float64 on the CPU wherever the extension was built. Elsewhere, or with `TORCH_DPC_NO_KERNELS=1` in the
environment, the operations of torch in :mod:`torch_dpc.solve.newton` and :mod:`torch_dpc.solve.active_set` do the same
work. A kernel marks the samples that it could not solve, and its caller takes those. Each sample is computed by one
thread: its result depends neither on the batch around it nor on how many threads (at most torch's own) share the batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..sets.values import SetValues
from .kernel_settings import KernelSettings, _kernels
from .outcome import Found

SETTINGS = KernelSettings()

#: Sets as the kernels read them.
SetArrays = tuple[np.ndarray | None, ...]
HYSTERESIS, INDEPENDENCE_TOLERANCE = SETTINGS.hysteresis, SETTINGS.independence


def has_kernels(tensor: Tensor) -> bool:
    """Return whether the kernels are built, and take the solves that this tensor is a part of."""
    return _kernels is not None and tensor.device.type == "cpu"


def are_built() -> bool:
    """Return whether there are kernels."""
    return _kernels is not None


def instructions() -> str:
    """Return which vector instructions the kernels use here, "none" if there are no kernels."""
    return "none" if _kernels is None else _kernels.instructions


def solve_boxes(
    G: np.ndarray, v0: np.ndarray, lower: np.ndarray, upper: np.ndarray, threads: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve  v = v0 - G lam = Proj(v + lam)  for every sample.

    Args:
        G: `(N, N)`, or one a sample, `(B, N, N)`.
        v0: `(B, N)`.
        lower, upper: both `(N,)` or both `(B, N)`.
        threads: the most to use.

    Returns:
        lam `(B, N)`, the steps `(B,)`, and which samples were solved `(B,)`.
    """
    lam, steps, converged = np.empty_like(v0), np.empty(len(v0), dtype=np.int64), np.empty(len(v0), dtype=bool)
    _kernels.solve_boxes(G, v0, lower, upper, lam, steps, converged, SETTINGS.compiled, threads)
    return lam, steps, converged


def has_kernel_for(v0: Tensor, values: SetValues | None) -> bool:
    """Return whether the kernels solve these samples.

    Args:
        v0: the unconstrained minimisers.
        values: the sets as numbers; None for a set that only torch knows.
    """
    return has_kernels(v0) and values is not None


def solve_sets(G: Tensor, v0: Tensor, values: SetValues) -> Found:
    """Solve  v = v0 - G lam = P(v + lam)  for every sample, P the proximal map of the sets.

    Args:
        G: `(N, N)`, or one a sample, `(B, N, N)`.
        v0: `(B, N)`.
        values: the sets.
    """
    lam, steps, converged = np.empty(v0.shape), np.empty(len(v0), dtype=np.int64), np.empty(len(v0), dtype=bool)
    options = SETTINGS.compiled, torch.get_num_threads()
    _kernels.solve_sets(as_array(G), as_array(v0), set_arrays(values), lam, steps, converged, *options)
    return Found(*map(torch.from_numpy, (lam, steps, converged)))


class Verdict(NamedTuple):
    """What the sets say of multipliers.

    Attributes:
        v: the projection of v0 - G lam onto the sets, `(B, N)`.
        missed: its distance from v0 - G lam, row by row, relative to 1 + |v|, `(B, N)`.
        weak: the rows whose multiplier counts as zero, `(B, N)`, boolean.
        active: the held rows, `(B, N)`, boolean; of a curved boundary, the first row of its block.
        counts: held directions, and bounds that v touches with a multiplier of zero, `(B, 2)`, int64.
    """

    v: Tensor
    missed: Tensor
    weak: Tensor
    active: Tensor
    counts: Tensor


def judge_sets(G: Tensor, raw: Tensor, lam: Tensor, values: SetValues) -> Verdict:
    """Return what the sets say of multipliers lam `(B, N)`, given raw = v0 - G lam `(B, N)`."""
    shape, count = raw.shape, len(raw)
    flags = np.empty(shape, dtype=bool), np.empty(shape, dtype=bool)
    results = np.empty(shape), np.empty(shape), *flags, np.empty((count, 2), dtype=np.int64)
    done, options = np.empty(count, dtype=bool), (SETTINGS.compiled, torch.get_num_threads())
    _kernels.judge_sets(as_array(G), set_arrays(values), as_array(raw), as_array(lam), *results, done, *options)
    if not done.all():
        raise MemoryError("no memory for the judgement of a plan.")
    return Verdict(*map(torch.from_numpy, results))


@dataclass(frozen=True, eq=False)
class Map:
    """The reduced problem  v = V theta - G lam  of all samples, with rows of v in units of their own; arrays.

    Attributes:
        G: `(N, N)`.
        V: `(N, n_theta)`.
        per_theta: 1 / the size of each entry of theta, `(n_theta,)`.
        moved: what an error of the map is relative to for each unit of a multiplier, `(N,)`.
        unit: of the rows of v, powers of two, `(N,)`.
        error_of_theta, error_of_lam: bounds of the errors of the map, relative to both.
        rounding: of each entry of G, relative to it, if multipliers meet no other error; else 0.
    """

    G: np.ndarray
    V: np.ndarray
    per_theta: np.ndarray
    moved: np.ndarray
    unit: np.ndarray
    error_of_theta: float
    error_of_lam: float
    rounding: float = 0.0

    @cached_property
    def arguments(self) -> tuple[Any, ...]:
        """The same, as the kernels read it."""
        arrays = (np.ascontiguousarray(x) for x in (self.G, self.V, self.per_theta, self.moved, self.unit))
        return *arrays, self.error_of_theta, self.error_of_lam, self.rounding


class PlannedArrays(NamedTuple):
    """Plans as `plan` makes them.

    Attributes:
        v, lam: `(B, N)`, in the caller's units.
        active, weak: `(B, N)`, boolean.
        info: as in :class:`torch_dpc.solve.outcome.Solved`, `(B, 5)`.
        convinces: which samples need no second look, `(B,)`, boolean. What is there of others is no plan.
    """

    v: np.ndarray
    lam: np.ndarray
    active: np.ndarray
    weak: np.ndarray
    info: np.ndarray
    convinces: np.ndarray


def plan(of: Map, sets: SetArrays, theta: np.ndarray, v0: np.ndarray | None = None, threads: int = 1) -> PlannedArrays:
    """Solve and judge every sample: everything of a plan but the certificate of one that has no solution.

    Args:
        of: the reduced problem.
        sets: in units, from `set_arrays`.
        theta: `(B, n_theta)`.
        v0: V theta `(B, N)`, if it is known.
        threads: the most to use.
    """
    shape, count = (len(theta), len(of.unit)), len(theta)
    flags = np.empty(shape, dtype=bool), np.empty(shape, dtype=bool)
    convinces = np.empty(count, dtype=bool)
    results = PlannedArrays(np.empty(shape), np.empty(shape), *flags, np.empty((count, 5)), convinces)
    _kernels.plan(of.arguments, sets, theta, v0, *results, SETTINGS.compiled, threads)
    return results


def plan_adjoint(
    of: Map,
    sets: SetArrays,
    at: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    v_bar: np.ndarray,
    lam_bar: np.ndarray | None,
    *,
    of_theta: bool,
    threads: int = 1,
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Return v0_bar = v_bar + S (lam_bar - G v_bar) `(B, N)`, and theta_bar = V' v0_bar `(B, n_theta)` if wanted.

    Args:
        of: the reduced problem.
        sets: in units, from `set_arrays`.
        at: v, lam, active and weak rows of the plan, `(B, N)`; v and weak rows count for balls and cones alone.
        v_bar, lam_bar: cotangents `(B, N)`, in the caller's units like v; lam_bar may be missing.
        of_theta: whether theta_bar is wanted.
        threads: the most to use.

    Returns:
        None if the held directions of a sample are dependent.
    """
    v0_bar, trusted = np.empty(v_bar.shape), np.empty(len(v_bar), dtype=bool)
    theta_bar = np.empty((len(v_bar), len(of.per_theta))) if of_theta else None
    options = SETTINGS.compiled, threads
    _kernels.plan_adjoint(of.arguments, sets, *at, v_bar, lam_bar, v0_bar, theta_bar, trusted, *options)
    return (v0_bar, theta_bar) if trusted.all() else None


def adjoint_sets(
    G: Tensor, v: Tensor, lam: Tensor, weak: Tensor, values: SetValues, rhs: Tensor
) -> tuple[Tensor, Tensor]:
    """Return S rhs `(B, N)`, S = W (W'G W + K)^-1 W', and which samples had independent directions `(B,)`.

    W holds the directions that the sets hold at the solution, K the curvature of their boundaries.

    Args:
        G: `(N, N)`, or one a sample, `(B, N, N)`.
        v, lam: the solution, `(B, N)`.
        weak: the rows whose multiplier counts as zero, `(B, N)`, boolean; a block is free if all of its rows are.
        values: the sets.
        rhs: `(B, N)`.
    """
    out, trusted = np.empty(rhs.shape), np.empty(len(rhs), dtype=bool)
    at = as_array(v), as_array(lam), as_array(weak), as_array(rhs)
    options = SETTINGS.compiled, torch.get_num_threads()
    _kernels.solve_held(as_array(G), set_arrays(values), *at, out, trusted, *options)
    return torch.from_numpy(out), torch.from_numpy(trusted)


def set_arrays(values: SetValues) -> SetArrays:
    """Return sets as the kernels read them: lower, upper, price, kind, start, rows, center, radius."""
    price = None if values.price is None else as_array(values.price)
    rest = values.kind, values.start, values.rows, values.center, values.radius
    return as_array(values.lower), as_array(values.upper), price, *map(as_array, rest)


def solve_active(G: Tensor, active: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Return s `(B, N)`, s_A = G_AA^-1 rhs_A and zero elsewhere, and which samples had independent rows `(B,)`.

    Args:
        G: `(N, N)`, or one a sample, `(B, N, N)`.
        active: the rows A, `(B, N)`, boolean.
        rhs: `(B, N)`.
    """
    out, trusted = np.empty(rhs.shape), np.empty(len(rhs), dtype=bool)
    options = SETTINGS.compiled, torch.get_num_threads()
    _kernels.solve_active(as_array(G), as_array(active), as_array(rhs), out, trusted, *options)
    return torch.from_numpy(out), torch.from_numpy(trusted)


def adjoint(G: Tensor, active: Tensor, v_bar: Tensor, lam_bar: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return v_bar + s `(B, N)`, s_A = G_AA^-1 (lam_bar - G v_bar)_A, and which samples had independent rows `(B,)`."""
    out, trusted = np.empty(v_bar.shape), np.empty(len(v_bar), dtype=bool)
    lam_array = None if lam_bar is None else as_array(lam_bar)
    options = SETTINGS.compiled, torch.get_num_threads()
    _kernels.adjoint(as_array(G), as_array(active), as_array(v_bar), lam_array, out, trusted, *options)
    return torch.from_numpy(out), torch.from_numpy(trusted)


def adjoint_of_one(
    G: np.ndarray, active: np.ndarray, v_bar: np.ndarray, lam_bar: np.ndarray | None
) -> np.ndarray | None:
    """Return what `adjoint` does for one sample `(N,)`; None if its rows are dependent."""
    out, trusted = np.empty((1, len(v_bar))), np.empty(1, dtype=bool)
    lam_row = None if lam_bar is None else lam_bar[None]
    _kernels.adjoint(G, active[None], v_bar[None], lam_row, out, trusted, SETTINGS.compiled, 1)
    return out[0] if trusted[0] else None


def as_array(tensor: Tensor) -> np.ndarray:
    """Return a tensor as the contiguous array that a kernel reads."""
    return tensor.detach().contiguous().numpy()
