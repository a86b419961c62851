"""Robust predictive control: the best input against the worst measurement error, as a second-order cone program.

The plan believes that the window it is given is the true one plus p, |p| <= r, and predicts by the recording,
y = K_u u + K_0 - K_y p (:class:`torch_dpc.attacks.Predictor`). With a = Q^(1/2) (K_u u + K_0 - y_ref), K = Q^(1/2) K_y:

    minimise over u in U   1/2 |u - u_ref|_R^2 + max over |p| <= r of 1/2 |a - K p|^2.

The maximum of a quadratic over a ball has no gap to its dual (the S-lemma). In the left singular vectors of K, with
singular values s_i, coordinates a_i of a and lambda the multiplier of the ball,

    max = |a|^2 + min over lambda >= s_1^2 of   r^2 lambda + sum over i of s_i^2 a_i^2 / (lambda - s_i^2),

and each term of the sum is a second-order cone. So the whole is one cone program, and exact. The bounds of the outputs
are tightened by the most that p can move each of them, r |row of K_y|, and cost `SLACK` where that cannot be met.

Huang, Zhen, Lygeros, Doerfler, "Robust data-enabled predictive control: tractable formulations and performance
guarantees" (2021) pose the min-max problem for data and window at once, and bound it; here only the window is
uncertain, which is what a sensor attack is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_dpc import DPCLayer, DPCSolution, HankelData, SolveError, SolveInfo, Status
from torch_dpc.attacks import BallBudget, Predictor
from torch_dpc.problem.weights import psd_root
from torch_dpc.solve.recovery import Thunks

from ._adapter import require

Array = np.ndarray
SLACK = 1e3  # cost of an output beyond its tightened bound, a unit of the output
RANK = 1e-9  # singular values of K below this fraction of the largest are zero
SMALLEST = 1e-4  # r s_1 is at least this: for less the program has no scale, and the plan is the nominal one


@dataclass(frozen=True)
class _Maps:
    """The prediction y = K_u u + K_past (u_ini, y_ini), weighted and not."""

    K_u: Array
    K_past: Array
    K_y: Array
    root_Q: Array
    root_R: Array

    @staticmethod
    def of(layer: DPCLayer) -> _Maps:
        data = layer.data
        assert isinstance(data, HankelData)
        matrix = Predictor(data).matrix
        past_u, past_y = data.t_ini * data.n_u, data.t_ini * data.n_y
        weights = layer.factored(data.device).problem.weights
        roots = (psd_root(weights.Q, data.n_y), psd_root(weights.R, data.n_u))
        parts = (matrix[:, past_u + past_y :], matrix[:, : past_u + past_y], matrix[:, past_u : past_u + past_y])
        return _Maps(*(x.detach().double().numpy(force=True) for x in (*parts, *roots)))


class RobustDPC(DPCLayer):
    """Plan for the worst measurement error in a ball, with the layer's call and result.

    It predicts by the recording alone: the limit of large lambda_g and lambda_s. Its plans have no derivative, and
    attacks by gradient are refused: attack it by `attacks.FiniteDifferenceAttack` or `attacks.RandomSearchAttack`. A
    plan that Clarabel reaches to its reduced tolerance alone (5e-5) is taken, and cvxpy warns of it.

    Args:
        layer: whose data, Q, R and boxes are taken; only these: no other terms.
        budget: of the error that is planned for, `BallBudget` or `RelativeBallBudget` (of the window as measured).

    Raises:
        ImportError: without cvxpy.
        ValueError: a layer with other sets than boxes or other terms, or another budget.
    """

    def __init__(self, layer: DPCLayer, budget: BallBudget):
        if not isinstance(layer, DPCLayer) or not layer.has_bounds or not isinstance(layer.data, HankelData):
            raise ValueError("`layer` must be a DPCLayer of one recording whose sets are boxes.")
        if layer.terms.rates or layer.terms.terminal_steps or layer.terms.slack or layer.affine:
            raise ValueError("`layer` must have the paper's terms alone.")
        if type(budget) not in (BallBudget, *BallBudget.__subclasses__()) or not budget.convex:
            raise ValueError(f"`budget` must be a BallBudget or RelativeBallBudget, got {type(budget).__name__}.")
        super().__init__(layer.data, **layer.config())
        self.error = budget
        self._cvxpy: Any = require("cvxpy", "robust")
        self._program = self._posed(_Maps.of(layer))

    def _posed(self, maps: _Maps) -> dict[str, Any]:
        """Pose the program once; references, window and radius are its parameters."""
        cp, data = self._cvxpy, self.data
        n_u, n_y = data.horizon * data.n_u, data.horizon * data.n_y
        U, s, _ = np.linalg.svd(maps.root_Q @ maps.K_y, full_matrices=False)
        self._largest = max(float(s[0]), np.finfo(float).tiny)
        U, d = U[:, s > RANK * s[0]], np.square(s[s > RANK * s[0]] / self._largest)
        u, slack, excess = cp.Variable(n_u), cp.Variable(n_y, nonneg=True), cp.Variable(nonneg=True)
        A = maps.root_Q @ maps.K_u
        orthogonal, triangle = np.linalg.qr(np.concatenate([maps.root_R, A]))  # both squares as one, n_u rows
        of_cost, of_along = cp.Parameter(len(triangle)), cp.Parameter(len(d))
        free, reach, tighten = cp.Parameter(n_y), cp.Parameter(nonneg=True), cp.Parameter(n_y, nonneg=True)
        along = U.T @ A @ u + of_along
        # lambda = s_1^2 (1 + excess): every term in units of s_1
        worst = reach * (1 + excess) + sum(d[i] * cp.quad_over_lin(along[i], 1 + excess - d[i]) for i in range(len(d)))
        cost = cp.sum_squares(triangle @ u + of_cost) + worst
        y = maps.K_u @ u + free
        lower, upper = (x.detach().numpy(force=True)[: n_u + n_y] for x in self.bounds(data.device))
        rows: list[Any] = []
        for end, sign in ((lower, -1), (upper, 1)):
            in_u, in_y = np.isfinite(end[:n_u]), np.isfinite(end[n_u:])
            if in_u.any():
                rows.append(sign * u[in_u] <= sign * end[:n_u][in_u])
            if in_y.any():
                rows.append(sign * y[in_y] <= sign * end[n_u:][in_y] - tighten[in_y] + slack[in_y])
        problem = cp.Problem(cp.Minimize(0.5 * cost + SLACK * cp.sum(slack)), rows)
        names = {"problem": problem, "u": u, "free": free, "of_cost": of_cost, "of_along": of_along, "reach": reach}
        row = np.linalg.norm(maps.K_y, axis=1)
        return {**names, "tighten": tighten, "maps": maps, "U": U, "orthogonal": orthogonal, "row": row}

    def forward(
        self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None, on_failure: str | None = None
    ) -> DPCSolution:
        """Plan for the worst error; see :meth:`torch_dpc.DPCLayer.forward`.

        Raises:
            ValueError: as the layer, and where a measurement asks for a gradient.
            SolveError: the program was not solved (with `on_failure="raise"`).
        """
        theta, dtype = self.flatten(u_ini, y_ini, y_ref, u_ref)
        if theta.requires_grad and torch.is_grad_enabled():
            raise ValueError("`y_ini` must not require a gradient: plans of RobustDPC have none.")
        flat = theta.detach().reshape(-1, theta.shape[-1]).cpu()
        plans = [self._plan_one(sample) for sample in flat]
        failed = [i for i, plan in enumerate(plans) if plan is None]
        if failed and (on_failure or self.on_failure) == "raise":
            raise SolveError(f"the robust program was not solved for {len(failed)} samples.", [(i,) for i in failed])
        size = self.data.horizon * (self.data.n_u + self.data.n_y)
        v = torch.stack([torch.full((size,), torch.nan).double() if plan is None else plan for plan in plans])
        v = v.reshape(*theta.shape[:-1], size).to(theta.device)
        u, y = (
            part.unflatten(-1, (self.data.horizon, -1))
            for part in v.tensor_split([self.data.horizon * self.data.n_u], -1)
        )
        table = torch.zeros(*theta.shape[:-1], 5, dtype=torch.float64, device=theta.device)
        table[..., 0] = torch.where(v.isnan().any(-1), float(Status.FAILED), float(Status.SOLVED))
        info = SolveInfo(table, False, lambda: torch.ones(theta.shape[:-1], dtype=torch.bool))
        return DPCSolution(u.to(dtype), y.to(dtype), info, torch.full_like(v, torch.nan), Thunks({}))

    def _plan_one(self, theta: Tensor) -> Tensor | None:
        """Return (u, y) of one sample; y is the prediction from the window as measured. None where it failed."""
        posed, sizes = self._program, self.sizes
        past, u_ref, y_ref = theta.split([sizes.u_ini + sizes.y_ini, sizes.u, sizes.y])
        y_ini = past[sizes.u_ini :].reshape(1, self.data.t_ini, -1)
        radius = float(self.error._reach(y_ini).squeeze())
        maps = posed["maps"]
        free = maps.K_past @ past.numpy()
        off = maps.root_Q @ (free - y_ref.numpy())
        targets = np.concatenate([-maps.root_R @ u_ref.numpy(), off])
        values = {"free": free, "of_cost": posed["orthogonal"].T @ targets, "of_along": posed["U"].T @ off}
        for name, value in values.items():
            posed[name].value = value
        posed["reach"].value = max(radius * self._largest, SMALLEST) ** 2
        posed["tighten"].value = radius * posed["row"]
        try:
            posed["problem"].solve(solver="CLARABEL")
        except self._cvxpy.error.SolverError:
            return None
        u = posed["u"].value
        if u is None:
            return None
        return torch.from_numpy(np.concatenate([u, maps.K_u @ u + free]))
