"""Proven worst cases and bounds, plants side by side, the controller for hardware."""

import torch

import torch_dpc as dpc
from helpers import randn, small_data, small_layer, windows
from torch_dpc import attacks

from .entry import INF, NAN, NO_COUNT, NOT_POSITIVE, Call, each

LAYER = small_layer()
U_INI, Y_INI = (w[0] for w in windows(1, 3))


def worst(layer=LAYER, cost=None, budget=None, u_ini=U_INI, y_ini=Y_INI, **options):
    cost = attacks.TargetInput(torch.ones(2)) if cost is None else cost
    budget = attacks.BoxBudget(0.1) if budget is None else budget
    return attacks.worst_case(layer, cost, budget, u_ini, y_ini, **options)


def act(y, **window):
    controller = dpc.DPCController(LAYER)
    controller.reset(**window)
    return controller.act(y)


def calls() -> list[Call]:
    """Return the table."""
    past = {"u_past": randn(3, 2), "y_past": randn(3, 4)}
    return [
        *each("layer", "worst_case layer", (3, "a", small_data()), lambda x: worst(layer=x)),
        *each("cost", "worst_case cost", (3, "a", lambda plan: plan.u.sum()), lambda x: worst(cost=x)),
        *each("budget", "worst_case budget", (3, 0.1, "a"), lambda x: worst(budget=x)),
        *each("u_ini", "worst_case u_ini", ("a", None, randn(3, 7)), lambda x: worst(u_ini=x)),
        *each("y_ini", "worst_case y_ini", ("a", None, randn(3, 7)), lambda x: worst(y_ini=x)),
        *each("time_limit", "worst_case time_limit", (-1.0, NAN, "a", None), lambda x: worst(time_limit=x)),
        *each("tolerance", "worst_case tolerance", (-1.0, NAN, INF, "a", None), lambda x: worst(tolerance=x)),
        *each("layer", "sensitivity_bound layer", (3, "a", small_data(), None), attacks.sensitivity_bound),
        *each("budget", "sensitivity_bound budget", (3, 0.1, "a"), lambda x: attacks.sensitivity_bound(LAYER, x)),
        *each("plants", "Many plants", ([], None, 3, "ab", [3]), dpc.systems.Many),
        *each("y", "act y", ("a", None, randn(3), torch.full((4,), NAN)), act),
        *each(
            "u_past", "reset u_past", ("a", randn(2, 2), randn(3, 7)), lambda x: act(randn(4), **{**past, "u_past": x})
        ),
        *each("y_past", "reset y_past", ("a", randn(2, 4), None), lambda x: act(randn(4), **{**past, "y_past": x})),
        *each("deadline", "DPCController deadline", NOT_POSITIVE[:3], lambda x: dpc.DPCController(LAYER, deadline=x)),
        *each("checkpoint_every", "simulate checkpoint_every", NO_COUNT[:4], _checkpoints),
        *each("batch", "simulate batch", ("a", 1.5, -1), _batch),
    ]


def _checkpoints(n):
    plant = dpc.systems.OscillatingMasses()
    return dpc.simulate(plant, dpc.DPCController(LAYER), torch.zeros(4), steps=4, checkpoint_every=n)


def _batch(n):
    plant = dpc.systems.OscillatingMasses()
    return dpc.simulate(plant, dpc.DPCController(LAYER), torch.zeros(4), steps=4, batch=n)
