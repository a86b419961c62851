"""The attacker inside the objective: Algorithm 1, with the graph of its answer where that is asked for."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

from ..attacks.budgets import Budget
from ..attacks.costs import Cost
from ..attacks.gradient import NOISE_FLOOR
from ..errors import Status
from ..layer import DPCLayer


class Attacker:
    """Algorithm 1, repeated from its own answer: p <- argmin over the budget of <d psi(u*(p)) / dp, p>.

    Args:
        layer: what the controller solves.
        budget: what may be added to a window.
        psi: (u_ini, y_ini, y_ref, u_ref, step) -> what the attacker minimises at that plan.
        iterations: linearised steps; the first is Algorithm 1's.
        keeps_graph: whether p carries its derivative, through second derivatives of the layer.
    """

    def __init__(
        self, layer: DPCLayer, budget: Budget, psi: Callable[..., Cost], iterations: int = 1, keeps_graph: bool = False
    ):
        self.layer, self.budget, self.psi = layer, budget, psi
        self.iterations, self.keeps_graph = iterations, keeps_graph

    def __call__(self, u_ini: Tensor, y_ini: Tensor, *, y_ref: Any = None, u_ref: Any = None, step: int = 0) -> Tensor:
        """Return p, the shape of y_ini; the arguments are those of every attack."""
        if not self.keeps_graph:
            u_ini, y_ini = u_ini.detach(), y_ini.detach()
        psi = self.psi(u_ini, y_ini, y_ref, u_ref, step)
        p = torch.zeros_like(y_ini)
        with nullcontext() if self.keeps_graph else torch.enable_grad():
            for _ in range(self.iterations):
                p = p if p.requires_grad else p.requires_grad_()
                plan = self.layer(u_ini, y_ini + p, y_ref=y_ref, u_ref=u_ref, on_failure="nan")
                value = torch.where(plan.info.status == Status.SOLVED, psi(plan), 0.0)
                (gradient,) = torch.autograd.grad(value.sum(), p, create_graph=self.keeps_graph)
                best = self.budget.minimize_linear(gradient, y_ini)
                promised = (gradient * best).sum((-2, -1)).abs()  # not best - p: that vanishes at the maximum
                p = torch.where((promised > NOISE_FLOOR * value.abs())[:, None, None], best, p)
                p = p if self.keeps_graph else p.detach()
        return p
