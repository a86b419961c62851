"""The masses with a Euclidean ball on every step's input: the layer beside cvxpylayers on the same conic problem."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.bench.cases import take
from scripts.bench.higher_precision import relative
from scripts.bench.learning import with_sets
from scripts.bench.ratios import both, case, forward, milliseconds

RADIUS = 0.8
CHECKED = 3  # problems whose errors are measured
STEP = 1e-5  # of central differences


class ConicPeer:
    """The reduced problem, min 1/2 |x|^2 with v0 + Ct x in the sets, as a CvxpyLayer.

    Args:
        layer: whose reduction and whose box on y it has.
        solver, options: of cvxpylayers.
    """

    def __init__(self, layer: dpc.DPCLayer, solver: str, options: dict[str, Any]):
        import cvxpy
        from cvxpylayers.torch import CvxpyLayer

        self.layer, self.reduction = layer, layer.reduction
        Ct, sizes = self.reduction.Ct.numpy(), layer.sizes
        x, v0 = cvxpy.Variable(Ct.shape[1]), cvxpy.Parameter(len(Ct))
        v, n_u = v0 + Ct @ x, layer.data.n_u
        lower, upper = (bound[sizes.u :].numpy() for bound in layer.bounds(torch.device("cpu")))
        limits = [cvxpy.norm(v[k : k + n_u]) <= RADIUS for k in range(0, sizes.u, n_u)]
        limits += [v[sizes.u :] <= upper, v[sizes.u :] >= lower]
        problem = cvxpy.Problem(cvxpy.Minimize(0.5 * cvxpy.sum_squares(x)), limits)
        self.peer = CvxpyLayer(problem, [v0], [x], solver=solver, solver_args=options)

    def __call__(self, u_ini: Tensor, y_ini: Tensor, y_ref: Tensor, u_ref: Tensor) -> Any:
        """Return the plan; only u."""
        theta, _ = self.layer.flatten(u_ini, y_ini, y_ref, u_ref)
        v0 = self.reduction.V @ theta
        (x,) = self.peer(v0)
        v = v0 + self.reduction.Ct @ x
        return type("Plan", (), {"u": v[: self.layer.sizes.u].reshape(self.layer.data.horizon, -1)})


def rows() -> Iterator[tuple[str, float, float, float, float]]:
    """Yield (solver, ms forward, ms forward and backward, error of u, error of the gradient of sum(u)).

    u is compared with Clarabel at tolerances of 1e-12, gradients with central differences of the layer's plans.
    """
    layer, inputs = case("masses", 16)
    ours = with_sets(layer, u_set=dpc.Ball(RADIUS))
    problems = [take(inputs, i) for i in range(16)]
    tight = {"solve_method": "Clarabel", "tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}
    made: dict[str, Any] = {
        "torch_dpc": ours,
        "cvxpylayers MOREAU": ConicPeer(layer, "MOREAU", {}),
        "cvxpylayers DIFFCP Clarabel": ConicPeer(layer, "DIFFCP", {"solve_method": "Clarabel"}),
    }
    exact = ConicPeer(layer, "DIFFCP", tight)
    alone = milliseconds({name: forward(one, problems) for name, one in made.items()})
    times = milliseconds({name: both(one, problems) for name, one in made.items()})
    for name, one in made.items():
        of_u, of_gradient = [], []
        for problem in problems[:CHECKED]:
            y_ini = problem["y_ini"].clone().requires_grad_()
            plan = one(**{**problem, "y_ini": y_ini})
            (gradient,) = torch.autograd.grad(plan.u.sum(), y_ini)
            of_u.append(relative(plan.u.detach().numpy(), exact(**problem).u.detach().numpy()))
            of_gradient.append(relative(gradient.numpy(), _differences(ours, problem)))
        yield name, alone[name], times[name], max(of_u), max(of_gradient)


def _differences(layer: dpc.DPCLayer, problem: dict[str, Tensor]) -> np.ndarray[Any, Any]:
    """Return central differences of sum(u) in y_ini."""
    y_ini = problem["y_ini"]
    found = torch.zeros_like(y_ini)
    for place in np.ndindex(*y_ini.shape):
        step = torch.zeros_like(y_ini)
        step[place] = STEP
        sides = [float(layer(**{**problem, "y_ini": y_ini + sign * step}).u.sum()) for sign in (1, -1)]
        found[place] = (sides[0] - sides[1]) / (2 * STEP)
    return found.numpy()
