"""Solvers without a gradient: DAQP, Clarabel, ECOS, OSQP, PIQP, one problem after the other.

Each is set up once where it can be (ECOS cannot), so that a call updates vectors alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from torch_dpc import DPCLayer

from ._adapter import Baseline, PeerResult, raise_failures, require
from ._problem import QP, Call

Array = np.ndarray
_NO_BOUND = 1e30


class Found(NamedTuple):
    """One solution: z, multipliers of the rows of C, iterations, and the solver's words (None where content)."""

    z: Array
    lam: Array
    iterations: int
    failure: str | None
    is_infeasible: bool = False
    remark: str = ""


class Engine(Protocol):
    """A solver, set up for the matrices of a program."""

    def solve(self, q: Array, b: Array, lower: Array, upper: Array, targets: list[Array | None]) -> Found:
        """Solve for one set of vectors."""


class ForwardOnlyDPC(Baseline):
    """The layer's problem in a solver that has no gradient.

    Args:
        layer: the layer whose problem is solved.
        solver: "daqp", "clarabel", "ecos", "osqp" or "piqp".
        formulation: "reduced" or "paper".
        solver_args: the solver's own settings.

    Inputs that require a gradient are taken; the solution carries none.
    """

    is_differentiable = False

    def __init__(
        self,
        layer: DPCLayer,
        solver: str = "daqp",
        *,
        formulation: str = "reduced",
        solver_args: dict[str, Any] | None = None,
    ):
        if solver not in ENGINES:
            raise ValueError(f"`solver` must be one of {', '.join(map(repr, ENGINES))}, got {solver!r}.")
        peer = require(solver, solver)
        super().__init__(layer, formulation)
        self.name = solver
        self._engine: Engine = ENGINES[solver](peer, self.qp, dict(solver_args or {}))

    @property
    def kkt_size(self) -> int:
        """0: nothing is differentiated."""
        return 0

    @torch.no_grad()
    def _solve(self, call: Call) -> PeerResult:
        q, b, lower, upper = (x.numpy() for x in (call.q, call.b, call.lower, call.upper))
        targets = [None if f is None else f.numpy() for f in call.targets]
        found = [
            self._engine.solve(q[i], b[i], lower[i], upper[i], [None if f is None else f[i] for f in targets])
            for i in range(len(q))
        ]
        raise_failures(self.name, [f.failure for f in found], [f.is_infeasible for f in found])
        z, lam = (torch.from_numpy(np.stack(x)) for x in ([f.z for f in found], [f.lam for f in found]))
        remark = "; ".join(sorted({f.remark for f in found if f.remark}))
        return PeerResult(z, lam, torch.tensor([f.iterations for f in found]), remark)


class _Daqp:
    """min 1/2 z'Pz + q'z, the rows of C and then those of A as equalities."""

    def __init__(self, daqp: Any, qp: QP, settings: dict[str, Any]):
        self._n_rows = len(qp.C)
        rows = np.ascontiguousarray(np.concatenate([qp.C.numpy(), qp.A.numpy()]))
        self._fixed = np.concatenate([np.zeros(len(qp.C)), np.full(len(qp.A), 5)]).astype(np.int32)
        bound = np.full(len(rows), _NO_BOUND)
        self._model = daqp.Model()
        self._setup = self._model.setup(qp.P.numpy(), np.zeros(len(qp.P)), rows, bound, -bound, self._fixed * 0)[0]
        # DAQP's default, 1e-6, calls slightly infeasible problems solved.
        self._model.settings = {"primal_tol": 1e-10, **settings}

    def solve(self, q: Array, b: Array, lower: Array, upper: Array, targets: list[Array | None]) -> Found:
        nothing = Found(q, lower, 0, f"setup returned flag {self._setup}")
        if self._setup < 0:
            return nothing
        lower, upper = (np.concatenate([x.clip(-_NO_BOUND, _NO_BOUND), b]) for x in (lower, upper))
        # `sense` drops the warm start: the answer does not depend on history.
        flag = self._model.update(f=q, bupper=upper, blower=lower, sense=self._fixed.copy())
        if flag < 0:
            return nothing._replace(failure=f"update returned flag {flag}")
        z, _, flag, info = self._model.solve()
        failure = None if flag == 1 else f"exit flag {flag}"
        lam = np.array(info["lam"])[: self._n_rows]
        return Found(np.array(z), lam, int(info["iterations"]), failure, flag == -1)


class _Osqp:
    def __init__(self, osqp: Any, qp: QP, settings: dict[str, Any]):
        rows = _csc(np.concatenate([qp.C.numpy(), qp.A.numpy()]))
        self._n_rows = len(qp.C)
        self._solver = osqp.OSQP()
        bound = np.full(rows.shape[0], np.inf)
        upper = _csc(np.triu(qp.P.numpy()))
        # Its defaults stop at 1e-3; at 1e-9 it is compared on the accuracy of the others.
        settings = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000, "polishing": True, **settings}
        self._solver.setup(P=upper, q=np.zeros(len(qp.P)), A=rows, l=-bound, u=bound, verbose=False, **settings)

    def solve(self, q: Array, b: Array, lower: Array, upper: Array, targets: list[Array | None]) -> Found:
        self._solver.update(q=q, l=np.concatenate([lower, b]), u=np.concatenate([upper, b]))
        result = self._solver.solve(raise_error=False)
        status = result.info.status
        failure = None if status == "solved" else f"status {status}"
        return Found(result.x, result.y[: self._n_rows], result.info.iter, failure, "primal infeasible" in status)


class _Piqp:
    def __init__(self, piqp: Any, qp: QP, settings: dict[str, Any]):
        self._solved = piqp.PIQP_SOLVED
        self._infeasible = piqp.PIQP_PRIMAL_INFEASIBLE
        self._has_equalities = len(qp.A) > 0
        self._solver = piqp.DenseSolver()
        for name, value in settings.items():
            setattr(self._solver.settings, name, value)
        P, A, C = (np.asfortranarray(m.numpy()) for m in (qp.P, qp.A, qp.C))
        equalities = (A, np.zeros(len(A))) if len(A) else (None, None)
        # With infinite bounds PIQP would drop the rows for good; the bounds at theta = 0 have the right finite ends.
        self._solver.setup(P, np.zeros(len(P)), *equalities, C, *self._clipped(qp.lower.numpy(), qp.upper.numpy()))

    @staticmethod
    def _clipped(lower: Array, upper: Array) -> tuple[Array, Array]:
        return lower.clip(min=-_NO_BOUND), upper.clip(max=_NO_BOUND)

    def solve(self, q: Array, b: Array, lower: Array, upper: Array, targets: list[Array | None]) -> Found:
        more = {"b": b} if self._has_equalities else {}
        lower, upper = self._clipped(lower, upper)
        self._solver.update(c=q, h_l=lower, h_u=upper, **more)
        status = self._solver.solve()
        result = self._solver.result
        failure = None if status == self._solved else f"status {status}"
        lam = np.array(result.z_u) - np.array(result.z_l)
        return Found(np.array(result.x), lam, result.info.iter, failure, status == self._infeasible)


class _Clarabel:
    """Rows in its order: equalities in the zero cone, then the finite upper and lower bounds in the non-negative."""

    def __init__(self, clarabel: Any, qp: QP, settings: dict[str, Any]):
        self._pick = [bound.isfinite().numpy() for bound in (qp.upper, qp.lower)]
        self._n_eq = len(qp.A)
        C = qp.C.numpy()
        rows = np.concatenate([qp.A.numpy(), C[self._pick[0]], -C[self._pick[1]]])
        n_bounds = len(rows) - self._n_eq
        cones = [clarabel.ZeroConeT(self._n_eq)] * (self._n_eq > 0) + [clarabel.NonnegativeConeT(n_bounds)]
        options = clarabel.DefaultSettings()
        options.verbose = False
        options.presolve_enable = False  # needed for updates
        for name, value in settings.items():
            setattr(options, name, value)
        P, n = _csc(np.triu(qp.P.numpy())), len(qp.P)
        right = np.zeros(len(rows))
        self._solver = clarabel.DefaultSolver(P, np.zeros(n), _csc(rows), right, cones, options)

    def solve(self, q: Array, b: Array, lower: Array, upper: Array, targets: list[Array | None]) -> Found:
        up, low = self._pick
        self._solver.update(q=q, b=np.concatenate([b, upper[up], -lower[low]]))
        result = self._solver.solve()
        status = str(result.status)
        failure = None if status in ("Solved", "AlmostSolved") else f"status {status}"
        lam = _two_sided(np.array(result.z)[self._n_eq :], up, low)
        remark = f"status {status}" if status == "AlmostSolved" else ""
        return Found(np.array(result.x), lam, result.iterations, failure, status == "PrimalInfeasible", remark)


class _Ecos:
    """ECOS has no quadratic cost: min t with |(F z - f, t - 1/2)| <= t + 1/2, which says t >= 1/2 |F z - f|^2."""

    def __init__(self, ecos: Any, qp: QP, settings: dict[str, Any]):
        self._ecos, self._settings = ecos, {"verbose": False, **settings}
        self._pick = [bound.isfinite().numpy() for bound in (qp.upper, qp.lower)]
        F, C = np.concatenate([F.numpy() for F, _ in qp.costs]), qp.C.numpy()
        self._sizes = [len(F) for F, _ in qp.costs]
        self._A = _csc(np.pad(qp.A.numpy(), ((0, 0), (0, 1)))) if len(qp.A) else None
        bounds = np.concatenate([C[self._pick[0]], -C[self._pick[1]]])
        t = np.zeros((1, len(qp.P) + 1))
        t[0, -1] = -1.0
        rows = np.concatenate([np.pad(bounds, ((0, 0), (0, 1))), t, np.pad(-F, ((0, 0), (0, 1))), t])
        self._G, self._dims = _csc(rows), {"l": len(bounds), "q": [len(F) + 2]}
        self._c = -t[0]

    def solve(self, q: Array, b: Array, lower: Array, upper: Array, targets: list[Array | None]) -> Found:
        up, low = self._pick
        pairs = zip(targets, self._sizes, strict=True)
        f = np.concatenate([np.zeros(size) if target is None else target for target, size in pairs])
        h = np.concatenate([upper[up], -lower[low], [0.5], -f, [-0.5]])
        equalities = {} if self._A is None else {"A": self._A, "b": b.copy()}
        result = self._ecos.solve(self._c, self._G, h, self._dims, **equalities, **self._settings)
        info = result["info"]
        said = info["infostring"]
        failure = None if info["exitFlag"] in (0, 10) else said
        lam = _two_sided(result["z"][: self._dims["l"]], up, low)
        remark = said if info["exitFlag"] == 10 else ""
        return Found(result["x"][:-1], lam, info["iter"], failure, info["exitFlag"] == 1, remark)


def _two_sided(duals: Array, up: Array, low: Array) -> Array:
    lam = np.zeros(len(up))
    lam[up] += duals[: up.sum()]
    lam[low] -= duals[up.sum() :]
    return lam


def _csc(matrix: Array) -> Any:
    from scipy.sparse import csc_matrix

    return csc_matrix(matrix)


ENGINES: dict[str, Any] = {"daqp": _Daqp, "clarabel": _Clarabel, "ecos": _Ecos, "osqp": _Osqp, "piqp": _Piqp}
