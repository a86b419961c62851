"""cvxpylayers (Agrawal et al. 2019): the problem written in CVXPY, differentiated by diffcp or by Moreau.

DIFFCP takes the problem to a cone program without quadratic costs and differentiates its homogeneous self-dual
embedding: n variables, m cone rows and one more. Each of the four quadratic terms of the paper's cost adds one variable
and a second-order cone two rows larger than the term. MOREAU keeps the quadratic cost.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_dpc import DPCLayer

from ._adapter import Baseline, PeerResult, raise_failures, require
from ._problem import QP, Call


class CvxpyLayersDPC(Baseline):
    """The layer's problem as a CvxpyLayer.

    Args:
        layer: the layer whose problem is solved.
        solver: "DIFFCP" or "MOREAU".
        formulation: "paper" or "reduced".
        solver_args: given to the solver as they are. For DIFFCP `solve_method` ("Clarabel", "SCS", "ECOS"), `mode`
            ("lsqr", "lsmr", "dense"), and the solver's own options; for MOREAU fields of `moreau.Settings`.

    Example:
        >>> CvxpyLayersDPC(layer, solver_args={"solve_method": "Clarabel", "mode": "dense"})  # doctest: +SKIP
    """

    def __init__(
        self,
        layer: DPCLayer,
        solver: str = "DIFFCP",
        *,
        formulation: str = "paper",
        solver_args: dict[str, Any] | None = None,
    ):
        if solver not in ("DIFFCP", "MOREAU"):
            raise ValueError(f"`solver` must be 'DIFFCP' or 'MOREAU', got {solver!r}.")
        cvxpy = require("cvxpy", "cvxpylayers")
        peer = require("cvxpylayers.torch", "cvxpylayers")
        if solver == "MOREAU":
            self._status = require("moreau", "cvxpylayers MOREAU").SolverStatus
        super().__init__(layer, formulation)
        self.solver = solver
        args = dict(solver_args or {})
        self.name = f"cvxpylayers {solver} {args.get('solve_method', '')}".strip()
        problem, self._parameters, outputs = _write(cvxpy, self.qp)
        self.layer_of_peer = peer.CvxpyLayer(problem, self._parameters, outputs, solver=solver, solver_args=args)

    @property
    def kkt_size(self) -> int:
        """DIFFCP: m + n + 1, the homogeneous self-dual embedding. MOREAU: m + n, its cone rows and its variables."""
        context = self.layer_of_peer.ctx.solver_ctx
        if self.solver == "DIFFCP":
            m, n_plus_1 = context.A_shape
            return m + n_plus_1
        return context.A_shape[0] + context.P_shape[0]

    def _solve(self, call: Call) -> PeerResult:
        values = [value for value in (*call.targets, *_right_sides(call)) if value is not None]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                z, *duals = self.layer_of_peer(*values)
            except Exception as error:  # every solver behind cvxpylayers has its own exceptions
                raise_failures(self.name, [f"{type(error).__name__}: {error}"] * len(call.theta))
        iterations, told = self._moreau_status() if self.solver == "MOREAU" else (None, _reservations(caught))
        # diffcp does not look at Clarabel's status: NaN is all that a failure shows.
        finite = torch.isfinite(z.detach()).all(-1).tolist()
        raise_failures(self.name, [None if ok else "the solution is not finite" for ok in finite])
        return PeerResult(z, _multipliers(call.qp, [dual.detach() for dual in duals]), iterations, told)

    def _moreau_status(self) -> tuple[Tensor, str]:
        info = self.layer_of_peer.ctx.solver_ctx.get_torch_solver("cpu").info
        names = [self._status(int(status)).name for status in np.atleast_1d(info.status)]
        good = ("Solved", "AlmostSolved")
        raise_failures(
            self.name,
            [None if name in good else f"status {name}" for name in names],
            ["Infeasible" in name for name in names],
        )
        iterations = torch.as_tensor(np.broadcast_to(info.iterations, (len(names),)).copy())
        return iterations, "status AlmostSolved" if "AlmostSolved" in names else ""


def _write(cvxpy: Any, qp: QP) -> tuple[Any, list[Any], list[Any]]:
    """Return the CVXPY problem, its parameters, and what to return: z, then the multipliers of the bounds."""
    z = cvxpy.Variable(len(qp.P))
    cost, parameters = 0, []
    for F, f in qp.costs:
        # An identity left out spares Moreau a copy of z.
        is_identity = F.shape[0] == F.shape[1] and torch.equal(F, torch.eye(len(F), dtype=F.dtype))
        residual = z if is_identity else F.numpy() @ z
        if f is not None:
            parameters.append(cvxpy.Parameter(len(F)))
            residual = residual - parameters[-1]
        cost = cost + cvxpy.sum_squares(residual)
    constraints = []
    if len(qp.A):
        parameters.append(cvxpy.Parameter(len(qp.A)))
        constraints.append(qp.A.numpy() @ z == parameters[-1])
    shift: Any = 0
    if qp.shift_theta is not None:
        parameters.append(shift := cvxpy.Parameter(len(qp.C)))
    bounded = []
    for bound, sign in ((qp.lower, -1), (qp.upper, 1)):
        rows = bound.isfinite().numpy()
        if rows.any():
            moved = qp.C.numpy()[rows] @ z + (0 if qp.shift_theta is None else shift[rows.nonzero()[0]])
            bounded.append(sign * moved <= sign * bound.numpy()[rows])
    problem = cvxpy.Problem(cvxpy.Minimize(0.5 * cost), constraints + bounded)
    return problem, parameters, [z, *(constraint.dual_variables[0] for constraint in bounded)]


def _reservations(caught: list[warnings.WarningMessage]) -> str:
    """Return what diffcp warned of ("Solved/Inaccurate."), without what NumPy says of its conversions."""
    return "; ".join(sorted({str(w.message) for w in caught if not issubclass(w.category, DeprecationWarning)}))


def _right_sides(call: Call) -> tuple[Tensor | None, Tensor | None]:
    return (call.b if len(call.qp.A) else None), call.shift


def _multipliers(qp: QP, duals: list[Tensor]) -> Tensor:
    lam = duals[0].new_zeros(len(duals[0]), len(qp.C))
    left = list(duals)
    for bound, sign in ((qp.lower, -1), (qp.upper, 1)):
        rows = bound.isfinite()
        if bool(rows.any()):
            lam[:, rows] += sign * left.pop(0)
    return lam
