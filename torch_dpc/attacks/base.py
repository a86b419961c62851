"""What every attack has in common: one call, its checks, and the check of its answer."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from ..checks import as_data, check_generator, check_type
from ..reprs import Described
from .budgets import Budget

#: How far outside its budget a perturbation may be, relative to the size of the budget: rounding in float64.
BUDGET_TOLERANCE = 1e-9


class Planner(Protocol):
    """Anything that plans: a `DPCLayer`, a surrogate, or a controller that an attacker can only query."""

    def __call__(self, u_ini: Tensor, y_ini: Tensor, *, y_ref: Any, u_ref: Any) -> Any:
        """Return the planned inputs `(*batch, horizon, n_u)`, or an object that has them as `u`."""


class AttackCall(NamedTuple):
    """The arguments of one call of an attack, checked; see :meth:`Attack.__call__`."""

    u_ini: Tensor
    y_ini: Tensor
    y_ref: Any
    u_ref: Any
    generator: torch.Generator | None
    step: Any


class Attack(Described):
    """A map from what is measured to what is added to it. Write your own by giving `_perturb`.

    Args:
        budget: the admissible perturbations.
    """

    budget: Budget

    def __init__(self, budget: Budget):
        check_type("budget", budget, Budget)
        self.budget = budget

    def __call__(
        self,
        u_ini: Any,
        y_ini: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        generator: torch.Generator | None = None,
        step: Any = 0,
    ) -> Tensor:
        """Return p, the shape and dtype of y_ini; the call of every attack.

        Args:
            u_ini, y_ini: the true windows, `(*batch, t_ini, n)`.
            y_ref, u_ref: references, as the layer takes them.
            generator: of random choices; unused by an attack that makes none.
            step: of the run, for costs that move with it. A policy also takes one for each sample, `(*batch,)`.

        Raises:
            ValueError: windows that are not finite, or shapes that do not fit.
            AssertionError: the answer is outside the budget by more than 1e-9 of its size; a defect of the attack.
        """
        u_ini, y_ini = _window("u_ini", u_ini), _window("y_ini", y_ini)
        check_generator(generator)
        attack, budget = self, self.budget.given(u_ini)
        if budget is not self.budget:  # a budget of this call alone; the attack itself keeps no state
            attack = copy.copy(self)
            attack.budget = budget
        p = attack._perturb(AttackCall(u_ini, y_ini, y_ref, u_ref, generator, step))
        return within_budget(p.to(y_ini.dtype), y_ini, budget)

    def _perturb(self, call: AttackCall) -> Tensor:
        """Return p, the shape of y_ini, in float64 or the dtype of y_ini."""
        raise NotImplementedError


def _window(name: str, value: Any) -> Tensor:
    tensor = as_data(name, value)
    if tensor.ndim < 2:
        raise ValueError(f"`{name}` must have shape (*batch, t_ini, n), got {tuple(tensor.shape)}.")
    return tensor


def within_budget(p: Tensor, y_ini: Tensor, budget: Budget) -> Tensor:
    """Return p after an independent check against its budget in float64.

    A p of lower precision may be outside by the rounding of its own entries; it is scaled down by that much.

    Raises:
        AssertionError: p is outside its budget by more than 1e-9 of the budget's size.
    """
    excess = budget.excess(p.detach().double(), y_ini.detach().double())
    if p.dtype != torch.float64:
        eps = torch.finfo(p.dtype).eps
        outside = (excess > 0) & (excess <= 10 * eps)
        p = torch.where(outside[..., None, None], p * (1 - excess[..., None, None] - 2 * eps).to(p.dtype), p)
        excess = budget.excess(p.detach().double(), y_ini.detach().double())
    if not bool((excess <= BUDGET_TOLERANCE).all()):
        raise AssertionError(f"the attack left its budget by {float(excess.max()):.1e} of its size.")
    return p
