"""Attacks: budgets, costs, attacks, policies."""

import torch

import torch_dpc as dpc
from helpers import randn, small_data, small_layer, windows
from torch_dpc import attacks

from .entry import NAN, NEGATIVE, NO_COUNT, NOT_POSITIVE, Call, each, one

DATA, LAYER = small_data(), small_layer()
U_INI, Y_INI = (w[0] for w in windows(1, 3))
BUDGET, COST = attacks.BallBudget(0.1), attacks.TargetInput(torch.ones(2))
NO_LAYER = (None, 3, "a", DATA, torch.ones(2))
NO_COST = (None, 3, 1.5, "a", torch.ones(2))
NO_BUDGET = (None, 3, 0.1, "a", dpc.Ball(0.1), torch.ones(2), attacks.BallBudget)
GRADIENT = {"steps": 2}


def ask(attack=None, **options):
    """Return the answer of an attack to a good window, unless options say otherwise."""
    attack = attacks.RandomAttack(BUDGET) if attack is None else attack
    arguments = {"u_ini": U_INI, "y_ini": Y_INI, **options}
    return attack(arguments.pop("u_ini"), arguments.pop("y_ini"), **arguments)


def pgd(layer=LAYER, cost=COST, budget=BUDGET, **options):
    return attacks.ProjectedGradientAttack(layer, cost, budget, **{**GRADIENT, **options})


def calls() -> list[Call]:
    """Return the table."""
    linear = attacks.LinearizedAttack
    return [
        *_budgets(),
        *_costs(),
        *[
            *each("layer", "LinearizedAttack layer", NO_LAYER, lambda x: linear(x, COST, BUDGET)),
            *each("cost", "LinearizedAttack cost", NO_COST, lambda x: linear(LAYER, x, BUDGET)),
            *each("budget", "LinearizedAttack budget", NO_BUDGET, lambda x: linear(LAYER, COST, x)),
            *each(
                "iterations",
                "LinearizedAttack iterations",
                NO_COUNT,
                lambda n: linear(LAYER, COST, BUDGET, iterations=n),
            ),
            *each("layer", "ProjectedGradientAttack layer", (None, 3, "a"), lambda x: pgd(layer=x)),
            *each("cost", "ProjectedGradientAttack cost", NO_COST, lambda x: pgd(cost=x)),
            *each("budget", "ProjectedGradientAttack budget", NO_BUDGET, lambda x: pgd(budget=x)),
            *each("steps", "ProjectedGradientAttack steps", (-1, 1.5, True, "3", None), lambda n: pgd(steps=n)),
            *each("step_size", "ProjectedGradientAttack step_size", NOT_POSITIVE, lambda x: pgd(step_size=x)),
            *each(
                "momentum", "ProjectedGradientAttack momentum", (-1.0, 1.0, NAN, "a", None), lambda x: pgd(momentum=x)
            ),
            *each("restarts", "ProjectedGradientAttack restarts", NO_COUNT, lambda n: pgd(restarts=n)),
            *each(
                "budget", "FrankWolfeAttack budget", NO_BUDGET[:3], lambda x: attacks.FrankWolfeAttack(LAYER, COST, x)
            ),
            *each(
                "steps",
                "FrankWolfeAttack steps",
                (-1, 1.5, "3", None),
                lambda n: attacks.FrankWolfeAttack(LAYER, COST, BUDGET, steps=n),
            ),
            *each("budget", "RandomAttack", NO_BUDGET, attacks.RandomAttack),
            *each(
                "queries",
                "RandomSearchAttack queries",
                (-1, 1.5, True, "3", None),
                lambda n: attacks.RandomSearchAttack(LAYER, COST, BUDGET, queries=n),
            ),
            *each("cost", "RandomSearchAttack cost", NO_COST, lambda x: attacks.RandomSearchAttack(LAYER, x, BUDGET)),
            *each(
                "controller",
                "RandomSearchAttack controller",
                (None, 3, "a"),
                lambda x: attacks.RandomSearchAttack(x, COST, BUDGET),
            ),
            *each(
                "probe",
                "FiniteDifferenceAttack probe",
                NOT_POSITIVE,
                lambda x: attacks.FiniteDifferenceAttack(LAYER, COST, BUDGET, probe=x),
            ),
            *each(
                "directions",
                "FiniteDifferenceAttack directions",
                (0, -1, 1.5, "3"),
                lambda n: attacks.FiniteDifferenceAttack(LAYER, COST, BUDGET, directions=n),
            ),
            *each("policy", "PolicyAttack policy", (None, 3, "a"), lambda x: attacks.PolicyAttack(x, BUDGET)),
            *each(
                "budget",
                "PolicyAttack budget",
                NO_BUDGET[:4],
                lambda x: attacks.PolicyAttack(attacks.AttackPolicy(DATA), x),
            ),
            *each(
                "reach",
                "PolicyAttack reach",
                ("far", 3),
                lambda x: attacks.PolicyAttack(attacks.AttackPolicy(DATA), BUDGET, reach=x),
            ),
            *each("data", "AttackPolicy data", (None, 3, "a"), attacks.AttackPolicy),
            *each(
                "hidden",
                "AttackPolicy hidden",
                ((0,), "a", 3, (1.5,), None, (-1,)),
                lambda x: attacks.AttackPolicy(DATA, hidden=x),
            ),
            *each("looks", "AttackPolicy looks", (0, -1, 1.5, "3"), lambda n: attacks.AttackPolicy(DATA, looks=n)),
            *each("data", "Predictor data", (None, 3, "a", torch.ones(2)), attacks.Predictor),
            *each(
                "y_ini",
                "attack y_ini",
                (None, "a", 3.0, torch.ones(3, 4).long(), torch.full((3, 4), NAN)),
                lambda x: ask(y_ini=x),
            ),
            *each(
                "u_ini",
                "Algorithm 1 u_ini",
                (None, "a", randn(3, 7)),
                lambda x: ask(linear(LAYER, COST, BUDGET), u_ini=x),
            ),
            *each(
                "y_ini",
                "Algorithm 1 y_ini",
                (None, "a", randn(3, 7)),
                lambda x: ask(linear(LAYER, COST, BUDGET), y_ini=x),
            ),
            *each("y_ref", "Algorithm 1 y_ref", ("a", randn(7)), lambda x: ask(linear(LAYER, COST, BUDGET), y_ref=x)),
            *each("generator", "attack generator", (3, "a"), lambda g: ask(generator=g)),
            *each("step", "attack step", ("a", None, 1.5, -1), lambda k: ask(linear(LAYER, SINE, BUDGET), step=k)),
        ],
    ]


SINE = attacks.TargetInput(trajectory=randn(40, 2))


def _budgets() -> list[Call]:
    return [
        *each("radius", "BallBudget", (*NEGATIVE, torch.tensor(-1.0)), attacks.BallBudget),
        *each("radius", "BoxBudget", (*NEGATIVE, torch.tensor([1.0, -1.0])), attacks.BoxBudget),
        *each("radius", "L1BallBudget", NEGATIVE, attacks.L1BallBudget),
        *each("scale", "EllipsoidBudget", NEGATIVE, attacks.EllipsoidBudget),
        *each("rho", "RelativeBallBudget", NEGATIVE, attacks.RelativeBallBudget),
        *each("channels", "SparseBallBudget channels", NO_COUNT, lambda n: attacks.SparseBallBudget(n, 1.0)),
        *each("radius", "SparseBallBudget radius", (-1.0, NAN, "a", None), lambda r: attacks.SparseBallBudget(1, r)),
        *each("budget", "PerChannelBudget", NO_BUDGET, attacks.PerChannelBudget),
        *each("relative", "BallBudget relative", ("yes", 3, None), lambda r: attacks.BallBudget(1.0, relative=r)),
        *one("radius", "box of another size", lambda: ask(attacks.RandomAttack(attacks.BoxBudget(torch.ones(7))))),
        *one(
            "scale",
            "ellipsoid of another size",
            lambda: ask(attacks.RandomAttack(attacks.EllipsoidBudget(torch.ones(7)))),
        ),
    ]


def _costs() -> list[Call]:
    linear = attacks.LinearizedAttack
    return [
        *each(
            "u_target", "TargetInput", ("a", {}, 1j, torch.full((2,), NAN), torch.ones(2).long()), attacks.TargetInput
        ),
        *each(
            "trajectory",
            "TargetInput trajectory",
            ("a", {}, randn(0, 2), torch.full((4, 2), NAN)),
            lambda t: attacks.TargetInput(trajectory=t),
        ),
        *one("u_target", "TargetInput without either", attacks.TargetInput),
        *one("u_target", "TargetInput with both", lambda: attacks.TargetInput(torch.ones(2), trajectory=randn(4, 2))),
        *one(
            "u_target", "target of another size", lambda: ask(linear(LAYER, attacks.TargetInput(torch.ones(3)), BUDGET))
        ),
        *one(
            "trajectory",
            "trajectory of another size",
            lambda: ask(linear(LAYER, attacks.TargetInput(trajectory=randn(40, 3)), BUDGET)),
        ),
        *each("data", "TrackingError data", (None, 3, "a"), attacks.TrackingError),
        *each("Q", "TrackingError Q", (-1.0, "a", None, torch.eye(3), NAN), lambda q: attacks.TrackingError(DATA, q)),
        *one("cost", "a cost that returns text", lambda: ask(linear(LAYER, lambda plan: "a", BUDGET))),
        *one("cost", "a cost of another shape", lambda: ask(linear(LAYER, lambda plan: plan.u, BUDGET))),
    ]
