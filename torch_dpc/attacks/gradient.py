"""Attacks by the gradient of the layer: Algorithm 1 of the paper."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_data
from ..errors import Status
from ..layer import DPCLayer
from .budgets import Budget
from .costs import at_step

#: A step that promises to change psi by less than this fraction is rounding, and is not taken: p = 0.
NOISE_FLOOR = 1e-10
#: How far outside its budget a perturbation may be, relative to its size, before it is a defect.
BUDGET_TOLERANCE = 1e-9


class LinearizedAttack:
    """Algorithm 1: minimise the attacker's cost, linearised at p = 0, over the budget.

        p* = argmin over the budget of <d psi(u*(p)) / dp at 0, p>,

    for the ball |p| <= rho |y_ini| the step p* = -rho |y_ini| grad / |grad|. The gradient comes from the projected KKT
    system of the layer, whichever its `backward` is. Rows of the plan that only touch their bounds count as free (see
    `sol.info.n_weakly_active`).

    Args:
        layer: what the attacker believes the controller solves.
        cost: psi, a callable DPCSolution -> `(*batch,)`, such as `TargetInput`.
        budget: the admissible perturbations.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> cost = dpc.attacks.TargetInput(torch.ones(2))
        >>> attack = LinearizedAttack(layer, cost, dpc.attacks.RelativeBall(0.01))
        >>> p = attack(u[:4], y[:4])
        >>> bool(cost(layer(u[:4], y[:4] + p)) < cost(layer(u[:4], y[:4])))
        True
    """

    def __init__(self, layer: DPCLayer, cost: Any, budget: Budget):
        self.layer = layer
        self.cost = cost
        self.budget = budget

    def __call__(
        self,
        u_ini: Any,
        y_ini: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        generator: torch.Generator | None = None,
        step: int = 0,
    ) -> Tensor:
        """Return p, the shape of y_ini.

        Args:
            u_ini, y_ini: the true windows, `(*batch, t_ini, n)`.
            y_ref, u_ref: references, as the layer takes them.
            generator: unused; every attack takes the same call.
            step: of the run, for costs that move with it.
        """
        y_ini = as_data("y_ini", y_ini)
        nothing = torch.zeros_like(y_ini)
        psi, gradient = psi_and_gradient(self.layer, self.cost, u_ini, y_ini, nothing, y_ref, u_ref, step)
        p = self.budget.minimize_linear(gradient, y_ini)
        promised = (gradient * p).sum((-2, -1)).abs()
        p = torch.where((promised > NOISE_FLOOR * psi.abs())[..., None, None], p, 0.0)
        return checked(p, y_ini, self.budget)


def psi_and_gradient(
    layer: DPCLayer, cost: Any, u_ini: Any, y_ini: Tensor, p: Tensor, y_ref: Any, u_ref: Any, step: int
) -> tuple[Tensor, Tensor]:
    """Return psi(u*(p)), `(*batch,)`, and its gradient in p; infinity and 0 where unsolved."""
    with torch.inference_mode(False), torch.enable_grad():
        p = p.detach().clone().requires_grad_()
        solution = layer(u_ini, y_ini.detach() + p, y_ref=y_ref, u_ref=u_ref, on_failure="nan")
        psi = at_step(cost, step)(solution)
        solved = solution.info.status == Status.SOLVED
        (gradient,) = torch.autograd.grad(torch.where(solved, psi, 0.0).sum(), p)
    return torch.where(solved, psi.detach(), torch.inf), gradient


def checked(p: Tensor, y_ini: Tensor, budget: Budget) -> Tensor:
    """Return p, after a look at the budget by someone other than the attack."""
    worst = budget.excess(p, y_ini)
    if not bool((worst <= _tolerance(p.dtype)).all()):
        raise AssertionError(f"the attack left its budget by {float(worst.max()):.1e} of its size.")
    return p


def _tolerance(dtype: torch.dtype) -> float:
    return BUDGET_TOLERANCE if dtype == torch.float64 else 10 * torch.finfo(dtype).eps
