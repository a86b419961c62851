"""Several attacks as one: for each sample the strongest answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..checks import check_type
from .base import Attack, AttackCall
from .budgets import Budget
from .objective import Objective


class Ensemble(Attack):
    """Ask several attacks and keep, for each sample, the answer with the smallest psi.

    Args:
        attacks: each keeps its own budget. The first that has a `layer` and a `cost` judges all.
        layer, cost: the judge instead: what the attacker believes the controller solves, and psi.

    Raises:
        ValueError: no attacks, or none that can judge.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> cost, budget = dpc.attacks.TargetInput(torch.ones(2)), dpc.attacks.RelativeBall(0.01)
        >>> attack = Ensemble([dpc.attacks.LinearizedAttack(layer, cost, budget), dpc.attacks.RandomAttack(budget)])
        >>> p = attack(u[:4], y[:4], generator=generator)
        >>> bool(cost(layer(u[:4], y[:4] + p)) <= cost(layer(u[:4], y[:4])))
        True
    """

    def __init__(self, attacks: Sequence[Attack], *, layer: Any = None, cost: Any = None):
        check_type("attacks", attacks, (list, tuple))
        for attack in attacks:
            check_type("attacks", attack, Attack)
        if not attacks:
            raise ValueError("`attacks` must hold at least one attack, got none.")
        super().__init__(_AnyOf([attack.budget for attack in attacks]))
        judges = [one for one in attacks if hasattr(one, "layer") and hasattr(one, "cost")]
        if (layer is None or cost is None) and not judges:
            raise ValueError("none of `attacks` knows a plan and its cost: give `layer=` and `cost=`.")
        self.attacks = list(attacks)
        self.layer = judges[0].layer if layer is None else layer
        self.cost = judges[0].cost if cost is None else cost

    def _perturb(self, call: AttackCall) -> Tensor:
        objective = Objective(self.layer, self.cost, call.u_ini, call.y_ini, call.y_ref, call.u_ref, call.step)
        best = torch.zeros_like(call.y_ini)
        with torch.no_grad():
            least = objective.psi(best.double())
            for attack in self.attacks:
                p = attack(*call[:2], y_ref=call.y_ref, u_ref=call.u_ref, generator=call.generator, step=call.step)
                psi = objective.psi(p.detach().double())
                better = psi < least
                best = torch.where(better[..., None, None], p.detach(), best)
                least = torch.where(better, psi, least)
        return best


class _AnyOf(Budget):
    """A union of budgets; for the check of an answer only."""

    convex = False

    def __init__(self, budgets: Sequence[Budget]):
        self.budgets = list(budgets)

    def given(self, u_ini: Tensor) -> Budget:
        return _AnyOf([budget.given(u_ini) for budget in self.budgets])

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        return torch.stack([budget.excess(p, y_ini) for budget in self.budgets]).amin(0)
