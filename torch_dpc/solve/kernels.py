"""The compiled kernels of `_kernels.c`: the small systems of a sample without the dispatch of an array library.

They serve float64 on the CPU wherever the extension was built; `serve` is what everybody asks. Elsewhere, or with
`TORCH_DPC_NO_KERNELS=1` in the environment, the operations of torch in :mod:`torch_dpc.solve.newton` and
:mod:`torch_dpc.solve.active_set` do the same work. A kernel flags the samples it cannot vouch for and leaves them to
its caller. Each sample is computed by one thread: its result depends neither on the batch around it nor on how many
threads (at most torch's own) share the batch.
"""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

try:
    if os.environ.get("TORCH_DPC_NO_KERNELS", "0") not in ("", "0"):
        raise ImportError("switched off")
    from . import _kernels
except ImportError:
    _kernels = None  # type: ignore[assignment]

#: Pivoting steps after which the kernel takes its second method; converging samples need 1 to 8.
PIVOTS = 10
#: By how much v + lam must pass a bound (relative to 1 + |bound|) for its row to be active. Without it rounding makes
#: the set flicker at rows that only touch their bound.
HYSTERESIS = 1e-12
#: A Cholesky factor of G[A, A] is trusted where every row of Ct stands out of the span of those before it by this
#: fraction of its length; G cannot tell less.
STANDING_OUT = 1e-5
#: A row that depends on the active ones may pass its bound by this (relative to 1 + |bound|): they hold it there, up to
#: rounding.
TOUCHING = 1e-10


def serve(tensor: Tensor) -> bool:
    """Return whether the kernels take the solves of which this tensor is a part."""
    return _kernels is not None and tensor.device.type == "cpu"


def instructions() -> str:
    """Return which vector instructions the kernels use here, "none" where there are no kernels."""
    return "none" if _kernels is None else _kernels.instructions


def solve_boxes(
    G: np.ndarray, v0: np.ndarray, lower: np.ndarray, upper: np.ndarray, threads: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lam `(B, N)`, the steps and whether it is the solution `(B,)`, of  v = v0 - G lam = Proj(v + lam).

    Args:
        G: `(N, N)`, or one a sample, `(B, N, N)`.
        v0: `(B, N)`.
        lower, upper: both `(N,)` or both `(B, N)`.
        threads: at most so many.
    """
    lam, steps, converged = np.empty_like(v0), np.empty(len(v0), dtype=np.int64), np.empty(len(v0), dtype=bool)
    _kernels.solve_boxes(
        G, v0, lower, upper, lam, steps, converged, HYSTERESIS, STANDING_OUT, TOUCHING, PIVOTS, threads
    )
    return lam, steps, converged


def solve_active(G: Tensor, active: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Return s `(B, N)`, s_A = G_AA^-1 rhs_A and zero elsewhere, and which samples are to be trusted `(B,)`.

    Args:
        G: `(N, N)`, or one a sample, `(B, N, N)`.
        active: the rows A, `(B, N)`, boolean.
        rhs: `(B, N)`.
    """
    out, trusted = np.empty(rhs.shape), np.empty(len(rhs), dtype=bool)
    threads = torch.get_num_threads()
    _kernels.solve_active(as_array(G), as_array(active), as_array(rhs), out, trusted, STANDING_OUT, threads)
    return torch.from_numpy(out), torch.from_numpy(trusted)


def adjoint(G: Tensor, active: Tensor, v_bar: Tensor, lam_bar: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return v_bar + s `(B, N)`, s_A = G_AA^-1 (lam_bar - G v_bar)_A, and which samples are to be trusted `(B,)`."""
    out, trusted = np.empty(v_bar.shape), np.empty(len(v_bar), dtype=bool)
    lam_array = None if lam_bar is None else as_array(lam_bar)
    threads = torch.get_num_threads()
    _kernels.adjoint(as_array(G), as_array(active), as_array(v_bar), lam_array, out, trusted, STANDING_OUT, threads)
    return torch.from_numpy(out), torch.from_numpy(trusted)


def adjoint_of_one(
    G: np.ndarray, active: np.ndarray, v_bar: np.ndarray, lam_bar: np.ndarray | None
) -> np.ndarray | None:
    """Return what `adjoint` does for one sample `(N,)`; None where it is not to be trusted."""
    out, trusted = np.empty((1, len(v_bar))), np.empty(1, dtype=bool)
    lam_row = None if lam_bar is None else lam_bar[None]
    _kernels.adjoint(G, active[None], v_bar[None], lam_row, out, trusted, STANDING_OUT, 1)
    return out[0] if trusted[0] else None


def as_array(tensor: Tensor) -> np.ndarray:
    """Return a tensor's numbers as a kernel reads them."""
    return tensor.detach().contiguous().numpy()
