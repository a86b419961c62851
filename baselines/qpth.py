"""qpth (Amos, Kolter 2017): a batched primal-dual interior-point method in torch.

qpth returns, for a parameter that the batch shares, the *mean* of the samples' gradients, where the vector-Jacobian
product is their sum. Every parameter is therefore handed over with a batch dimension of its own, as an expanded view:
torch then sums over the view, and no memory is copied.

On the CPU qpth runs on one thread here: with more, torch's batched LU, which it is built on, is wrong or hangs for
matrices of 150 rows and more (PyTorch issues 141358 and 142815).
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

import torch
from torch import Tensor

from torch_dpc import DPCLayer

from ._adapter import Baseline, PeerResult, raise_failures, require
from ._guarded import Guarded, one_thread
from ._problem import Call


class QpthDPC(Baseline):
    """The layer's problem in qpth; on a GPU too.

    Args:
        layer: the layer whose problem is solved.
        formulation: "reduced" or "paper". qpth needs P positive definite, which the paper's is not: it says so.
        solver_args: given to `qpth.qp.QPFunction` (eps, maxIter, notImprovedLim, check_Q_spd).
        accept_unconverged: qpth itself prints a warning and returns its best iterate when a residual is above 1. True
            does the same, with the warning in `info.message`; False raises.
    """

    cpu_only = False
    name = "qpth"

    def __init__(
        self,
        layer: DPCLayer,
        *,
        formulation: str = "reduced",
        solver_args: dict[str, Any] | None = None,
        accept_unconverged: bool = False,
    ):
        peer = require("qpth.qp", "qpth", no_deps=True)
        super().__init__(layer, formulation)
        self._accept_unconverged = accept_unconverged
        self._function = peer.QPFunction(**{"verbose": 0, **(solver_args or {})})
        self._signs = [(sign, bound.isfinite()) for sign, bound in ((-1, self.qp.lower), (1, self.qp.upper))]
        self._G = torch.cat([sign * self.qp.C[rows] for sign, rows in self._signs])

    @property
    def kkt_size(self) -> int:
        """Unknowns (dz, ds, dlam, dnu): variables, slacks and multipliers of the one-sided rows, and equalities."""
        return len(self.qp.P) + 2 * len(self._G) + len(self.qp.A)

    def _solve(self, call: Call) -> PeerResult:
        qp, size, device = call.qp, len(call.theta), call.theta.device
        pairs = zip((call.lower, call.upper), self._signs, strict=True)
        h = torch.cat([sign * bound[:, rows.to(device)] for bound, (sign, rows) in pairs], dim=-1)
        none = h.new_zeros(0)
        P, G = qp.P.expand(size, -1, -1), self._G.to(device).expand(size, -1, -1)
        A, b = (qp.A.expand(size, -1, -1), call.b) if len(qp.A) else (none, none)
        told: list[Tensor] = []

        def run(q: Tensor, h: Tensor, b: Tensor) -> Tensor:
            z = self._function(P, q, G, h, A, b)
            told.append(z.grad_fn.lams.detach())
            return z

        said = io.StringIO()  # qpth prints its warnings
        with contextlib.redirect_stdout(said):
            try:
                z = Guarded.apply(one_thread if device.type == "cpu" else contextlib.nullcontext, run, call.q, h, b)
            except Exception as error:
                raise_failures(self.name, [f"{type(error).__name__}: {error}"] * size)
        words = " ".join(said.getvalue().replace("-", "").split())
        if words and not self._accept_unconverged:
            raise_failures(self.name, [words] * size)
        finite = torch.isfinite(z.detach()).all(-1).tolist()
        raise_failures(self.name, [None if ok else words or "the solution is not finite" for ok in finite])
        multipliers = h.new_zeros(size, len(qp.C))
        parts = told[0].split([int(rows.sum()) for _, rows in self._signs], dim=-1)
        for (sign, rows), part in zip(self._signs, parts, strict=True):
            multipliers[:, rows.to(device)] += sign * part
        return PeerResult(z, multipliers, message=words)
