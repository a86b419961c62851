"""One window under a budget: its complementarity system in few variables, and how to replay a perturbation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...checks import check_type
from ...layer import DPCLayer
from ...solution import DPCSolution
from ..base import within_budget
from ..budgets import Budget
from .complementarity import Array, Budgeted, Rows, in_few_variables


def check_problem(layer: Any, budget: Any) -> None:
    """Raise ValueError unless a layer has boxes and a budget is one."""
    check_type("layer", layer, DPCLayer)
    check_type("budget", budget, Budget)
    if not layer.has_bounds:
        raise ValueError("`layer` must have boxes as its sets: curved sets have more than three states a row.")


class Window:
    """What a budget can do to one window.

    Args:
        layer: its sets are boxes.
        budget: has `norm_bounds`.
        theta: the window and its references, flattened as the layer does.

    Attributes:
        v0, A, G: v = v0 + A s - G lam, of all rows of the plan, inputs first.
        bounds: lower and upper, of all rows.
        of_s: the budget in s, p = N s.
        nominal: the plan at p = 0.
        n_u: rows that are inputs.
        channel: of each row, inputs first.
    """

    def __init__(self, layer: DPCLayer, budget: Budget, theta: Tensor):
        data = layer.data
        sizes = [n * data.t_ini for n in (data.n_u, data.n_y)] + [n * data.horizon for n in (data.n_u, data.n_y)]
        u_ini, y_ini, u_ref, y_ref = theta.split(sizes)
        self.u_ini, self.y_ini = u_ini.reshape(-1, data.n_u), y_ini.reshape(-1, data.n_y)
        self.refs: dict[str, Any] = {"y_ref": y_ref.reshape(-1, data.n_y), "u_ref": u_ref.reshape(-1, data.n_u)}
        self.layer, self.budget = layer, budget.given(self.u_ini)
        reduction = layer.reduction.detach()
        self.v0, self.G = (x.cpu().numpy() for x in (reduction.V @ theta, reduction.G))
        Vp = reduction.V[:, sizes[0] : sizes[0] + sizes[1]].cpu().numpy()
        lower, upper = (b.detach().cpu().expand(len(self.v0)).numpy() for b in layer.bounds(theta.device))
        self.bounds = lower, upper
        self.of_s: Budgeted = in_few_variables(Vp, self.budget.norm_bounds(self.y_ini))
        self.A: Array = Vp @ self.of_s.N
        self.n_u = data.horizon * data.n_u
        inputs, outputs = np.arange(self.n_u) % data.n_u, np.arange(len(self.v0) - self.n_u) % data.n_y
        self.channel = np.concatenate([inputs, data.n_u + outputs])
        self.nominal = layer(self.u_ini, self.y_ini, **self.refs, on_failure="raise")
        self.lam: Array = self.nominal.lam.detach().cpu().numpy()

    @property
    def has_bound(self) -> np.ndarray:
        """Which rows have a finite bound."""
        return np.isfinite(self.bounds[0]) | np.isfinite(self.bounds[1])

    def rows(self, index: np.ndarray) -> Rows:
        """Return some rows with intervals from nonexpansiveness."""
        nominal = self.v0 - self.G @ self.lam, self.lam
        return Rows.of(index, self.v0, self.A, self.G, self.bounds, nominal, self.of_s)

    def perturbation(self, s: Array) -> Tensor:
        """Return p = N s, in the budget."""
        p = torch.from_numpy(self.of_s.N @ s).to(self.y_ini).reshape(self.y_ini.shape)
        return within_budget(self.budget.project(p, self.y_ini), self.y_ini, self.budget)

    def plan(self, s: Array) -> DPCSolution:
        """Return the layer's plan under N s; its status says whether there is one."""
        return self.layer(self.u_ini, self.y_ini + self.perturbation(s), **self.refs, on_failure="nan")
