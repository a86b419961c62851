"""One controller against another on recordings kept back, under every attack there is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from .. import attacks as suite
from ..attacks.base import Attack
from ..attacks.budgets import Budget
from ..attacks.costs import check_cost
from ..checks import check_count, check_flag, check_type
from ..data.hankel import HankelData
from ..layer import DPCLayer
from ..systems.plant import Plant
from .verdict import Verdict, compare, scenarios

#: layer -> attack that knows it.
AttackOn = Callable[[DPCLayer], Attack]


def attack_suite(
    cost: Any, budget: Budget, *, judged: Any = 1.0, steps: int = 20, queries: int = 50
) -> dict[str, AttackOn]:
    """Return every kind of attack of the package by name, each as layer -> attack: what a controller must stand.

    Random noise, Algorithm 1, projected gradient from three starts, Frank-Wolfe, a black box that only queries, and
    projected gradient on the true tracking error; and for each sample the strongest of those that share `cost`.

    Args:
        cost: psi, what the attacker wants of the plan.
        budget: the admissible perturbations.
        judged: weight of the outputs in the tracking error, as `attacks.TrackingError` takes it.
        steps: of the attacks by gradient.
        queries: of the black box.

    Example:
        >>> list(attack_suite(suite.TargetInput(torch.ones(2)), suite.RelativeBall(0.1)))[:3]
        ['random noise', 'Algorithm 1', 'projected gradient']
    """
    check_cost(cost)
    check_type("budget", budget, Budget)
    check_count("steps", steps)
    check_count("queries", queries)

    def tracking(layer: DPCLayer) -> Attack:
        check_type("layer.data", layer.data, HankelData)
        assert isinstance(layer.data, HankelData)
        error = suite.TrackingError(layer.data, judged)
        return suite.ProjectedGradientAttack(layer, error, budget, steps, restarts=3)

    makers: dict[str, AttackOn] = {
        "random noise": lambda layer: suite.RandomAttack(budget),
        "Algorithm 1": lambda layer: suite.LinearizedAttack(layer, cost, budget),
        "projected gradient": lambda layer: suite.ProjectedGradientAttack(layer, cost, budget, steps, restarts=3),
        "Frank-Wolfe": lambda layer: suite.FrankWolfeAttack(layer, cost, budget, steps),
        "black box": lambda layer: suite.RandomSearchAttack(layer, cost, budget, queries=queries),
    }
    single = dict(makers)
    makers["strongest of all"] = lambda layer: suite.Ensemble(
        [make(layer) for make in single.values()], layer=layer, cost=cost
    )
    return {**makers, "tracking": tracking}


def judge(
    plant: Plant,
    before: DPCLayer | Sequence[DPCLayer],
    after: DPCLayer | Sequence[DPCLayer],
    *,
    attacks: Mapping[str, AttackOn],
    certify: bool = False,
    **run: Any,
) -> Verdict:
    """Compare two controllers on every held-out recording, in every scenario and under every attack.

    Every attack is made anew for the layer it attacks: the attacker knows the weights.

    Args:
        plant: as for :func:`scenarios`.
        before, after: a layer, or one for each held-out recording: the same recordings in the same order, which neither
            the weights nor their tuning have seen.
        attacks: layer -> attack, by name, such as :func:`attack_suite`; none are left out of the verdict.
        certify: whether the certified bound of |du| / |p| (:func:`torch_dpc.attacks.sensitivity_bound`, seconds to a
            minute a layer, extra `exact`) stands in the verdict, as its mean over the recordings.
        run: the other arguments of :func:`scenarios`.

    Raises:
        ValueError: no recordings, other recordings, or bad arguments of the runs.

    Example:
        >>> import torch_dpc as dpc
        >>> plant = dpc.systems.OscillatingMasses()
        >>> u, y = dpc.collect(plant, 120, generator=torch.Generator().manual_seed(0))
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> old, new = (dpc.DPCLayer(data, Q=q, R=1.0, lambda_g=1.0, lambda_s=1e4) for q in (1.0, 10.0))
        >>> attacks = attack_suite(suite.TargetInput(torch.ones(2)), suite.RelativeBall(0.01), steps=2, queries=2)
        >>> starts = 0.1 * torch.randn(4, 4, generator=torch.Generator().manual_seed(1))
        >>> verdict = judge(plant, old, new, attacks=attacks, resets={"state": starts}, y_ref=torch.zeros(4), steps=20)
        >>> verdict.runs, sorted(set(verdict.before) - set(attacks))
        (4, ['from every start'])
    """
    check_flag("certify", certify)
    pairs = _pairs(before, after)
    if not isinstance(attacks, Mapping) or not all(map(callable, attacks.values())):
        raise ValueError(f"`attacks` must map names to callables, layer -> attack, got {type(attacks).__name__}.")
    sides = [list(layers) for layers in zip(*pairs, strict=True)]
    errors = [[scenarios(plant, layer, attacks=attacks, **run) for layer in side] for side in sides]
    old, new = ({name: torch.cat([of[name] for of in side]) for name in side[0]} for side in errors)
    verdict = compare(old, new)
    if not certify:
        return verdict
    before_bound, after_bound = (sum(float(suite.sensitivity_bound(layer)) for layer in side) for side in sides)
    return replace(verdict, certified=(before_bound / len(pairs), after_bound / len(pairs)))


def _pairs(before: Any, after: Any) -> list[tuple[DPCLayer, DPCLayer]]:
    """Return the layers of each recording."""
    sides = [[side] if isinstance(side, DPCLayer) else side for side in (before, after)]
    for name, side in zip(("before", "after"), sides, strict=True):
        check_type(name, side, (list, tuple))
        for layer in side:
            check_type(name, layer, DPCLayer)
    if len(sides[0]) != len(sides[1]) or not sides[0]:
        came = f"{len(sides[0])} and {len(sides[1])}"
        raise ValueError(f"`before` and `after` must hold a layer for each of the same recordings, got {came}.")
    for old, new in zip(*sides, strict=True):
        if old.data is not new.data and not torch.equal(old.data.Up, new.data.Up):
            raise ValueError("`before` and `after` must hold layers of the same recordings in the same order.")
    return list(zip(*sides, strict=True))
