"""QPLayer of proxsuite (Bambade et al. 2024): an augmented-Lagrangian active-set method in C++, one problem a time.

Its backward fills tensors of torch's *default* dtype, single precision unless a program says otherwise, and so would
lose half of the digits. Here it runs with float64 as the default; the caller's setting is put back after it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torch_dpc import DPCLayer

from ._adapter import Baseline, PeerResult, raise_failures, require
from ._guarded import Guarded, double_default
from ._problem import Call

#: What ProxQP reads as no bound.
_NO_BOUND = 1e20


class QPLayerDPC(Baseline):
    """The layer's problem in proxsuite's QPLayer.

    Args:
        layer: the layer whose problem is solved.
        formulation: "paper" or "reduced".
        solver_args: given to `proxsuite.torch.qplayer.QPFunction` (eps, maxIter, eps_backward, rho_backward,
            mu_backward, omp_parallel).
        accept_unconverged: QPLayer itself returns its last iterate without a word when it stops at maxIter. True does
            the same, with the status in `info.message`; False raises.
    """

    name = "proxsuite QPLayer"

    def __init__(
        self,
        layer: DPCLayer,
        *,
        formulation: str = "reduced",
        solver_args: dict[str, Any] | None = None,
        accept_unconverged: bool = False,
    ):
        peer = require("proxsuite.torch.qplayer", "QPLayer")
        super().__init__(layer, formulation)
        self._function = peer.QPFunction(**(solver_args or {}))
        self._good = ("PROXQP_SOLVED",) + ("PROXQP_MAX_ITER_REACHED",) * accept_unconverged

    @property
    def kkt_size(self) -> int:
        """Unknowns of its backward: variables, equalities, two-sided rows."""
        return len(self.qp.P) + len(self.qp.A) + len(self.qp.C)

    def _solve(self, call: Call) -> PeerResult:
        qp, size = call.qp, len(call.theta)
        lower, upper = call.lower.clamp_min(-_NO_BOUND), call.upper.clamp_max(_NO_BOUND)
        none = qp.A.new_zeros(0)
        P, C = qp.P.expand(size, -1, -1), qp.C.expand(size, -1, -1)
        A, b = (qp.A.expand(size, -1, -1), call.b) if len(qp.A) else (none, none)
        told: list[Any] = []

        def run(q: Tensor, b: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
            z, _, multipliers = self._function(P, q, A, b, C, lower, upper)
            told.extend((multipliers.detach(), z.grad_fn.vector_of_qps))
            return z

        z = Guarded.apply(double_default, run, call.q, b, lower, upper)
        multipliers, solved = told
        infos = [solved.get(i).results.info for i in range(size)]
        names = [str(info.status).rsplit(".", 1)[-1] for info in infos]
        raise_failures(
            self.name,
            [None if name in self._good else f"status {name}" for name in names],
            ["PRIMAL_INFEASIBLE" in name for name in names],
        )
        remarks = sorted({f"status {name}" for name in names if name != "PROXQP_SOLVED"})
        return PeerResult(z, multipliers, torch.tensor([info.iter for info in infos]), "; ".join(remarks))
