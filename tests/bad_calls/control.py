"""Controllers, closed loops, recordings of plants."""

import torch

import torch_dpc as dpc
from helpers import Y_REF, randn, small_layer

from .entry import INF, NAN, NEGATIVE, NO_COUNT, NOT_POSITIVE, Call, each, one

LAYER = small_layer()
MASSES = dpc.systems.OscillatingMasses()
NO_PLANT = (None, 3, "a", dpc.systems.OscillatingMasses, torch.ones(2), object())


def controller(**options):
    return dpc.DPCController(LAYER, **{"replan_every": 2, **options})


def simulate(**options):
    arguments = {"plant": MASSES, "controller": controller(), "y_ref": Y_REF, "steps": 4, **options}
    return dpc.simulate(arguments.pop("plant"), arguments.pop("controller"), arguments.pop("y_ref"), **arguments)


def collect(**options):
    arguments = {"plant": MASSES, "steps": 10, **options}
    return dpc.collect(arguments.pop("plant"), arguments.pop("steps"), **arguments)


class Faulty:
    """A plant whose measurements are wrong."""

    n_u, n_y, dt = 2, 4, 0.1

    def __init__(self, y):
        self.y = y

    def reset(self):
        return self.y

    def step(self, u):
        return self.y


class Sized:
    """A plant whose sizes are wrong."""

    def __init__(self, n_u=2, n_y=4, dt=0.1):
        self.n_u, self.n_y, self.dt = n_u, n_y, dt

    def reset(self):
        return torch.zeros(4)

    step = reset


def calls() -> list[Call]:
    """Return the table."""
    window = {"u_ini": randn(3, 2), "y_ini": randn(3, 4)}
    step = lambda **o: controller().step(*{**window, **o}.values())  # noqa: E731
    return [
        *each("layer", "DPCController layer", (None, 3, "a", LAYER.data, dpc.DPCLayer), dpc.DPCController),
        *each("replan_every", "replan_every", (0, -1, 1.5, True, "3", NAN, 7), lambda n: controller(replan_every=n)),
        *each("on_failure", "on_failure", ("ignore", None, 3), lambda f: controller(on_failure=f)),
        *each("soft_weight", "soft_weight", NOT_POSITIVE, lambda w: controller(on_failure="soften", soft_weight=w)),
        *each("u_ini", "step u_ini", (None, "a", randn(3, 7), randn(2)), lambda w: step(u_ini=w)),
        *each("y_ini", "step y_ini", (None, "a", randn(3, 7), randn(2)), lambda w: step(y_ini=w)),
        *each("n_u", "simulate plant", NO_PLANT, lambda p: simulate(plant=p)),
        *each("n_u", "plant n_u", (0, -1, 1.5, "2", None), lambda n: simulate(plant=Sized(n_u=n))),
        *each("n_y", "plant n_y", (0, -1, 1.5, "2", None), lambda n: simulate(plant=Sized(n_y=n))),
        *each("dt", "plant dt", (0.0, -1.0, NAN, INF, "a", None), lambda dt: simulate(plant=Sized(dt=dt))),
        *each(
            "y",
            "plant y",
            (None, "a", torch.zeros(3), torch.full((4,), NAN), [1.0]),
            lambda y: simulate(plant=Faulty(y)),
        ),
        *each(
            "controller",
            "simulate controller",
            (None, 3, "a", LAYER, dpc.DPCController),
            lambda c: simulate(controller=c),
        ),
        *each(
            "y_ref",
            "simulate y_ref",
            ("a", {}, torch.ones(3), torch.ones(2, 4), torch.full((4,), NAN)),
            lambda r: simulate(y_ref=r),
        ),
        *each(
            "u_ref",
            "simulate u_ref",
            ("a", {}, torch.ones(3), torch.ones(2, 2), torch.full((2,), NAN)),
            lambda r: simulate(u_ref=r),
        ),
        *each("steps", "simulate steps", NO_COUNT, lambda n: simulate(steps=n)),
        *each("attack", "simulate attack", (3, "a", torch.ones(4)), lambda a: simulate(attack=a)),
        *each(
            "attack",
            "what an attack returns",
            (None, "a", 3.0, torch.ones(3), torch.full((3, 4), NAN)),
            lambda p: simulate(attack=lambda *_, **__: p),
        ),
        *each("generator", "simulate generator", (3, "a"), lambda g: simulate(generator=g)),
        *each("reset", "simulate reset", ("yes", 3, None), lambda r: simulate(reset=r)),
        *each("u_warmup", "simulate u_warmup", ("a", None, {}, torch.ones(3), NAN), lambda u: simulate(u_warmup=u)),
        *each("progress", "simulate progress", (3, "a"), lambda f: simulate(progress=f)),
        *each("n_u", "collect plant", NO_PLANT, lambda p: collect(plant=p)),
        *each("steps", "collect steps", NO_COUNT, lambda n: collect(steps=n)),
        *each("amplitude", "collect amplitude", (*NEGATIVE, torch.ones(3)), lambda a: collect(amplitude=a)),
        *each("offset", "collect offset", ("a", {}, torch.ones(3), NAN), lambda o: collect(offset=o)),
        *each("hold", "collect hold", NO_COUNT, lambda n: collect(hold=n)),
        *each("feedback", "collect feedback", (3, "a", torch.ones(2)), lambda f: collect(feedback=f)),
        *each("feedback", "what feedback returns", (None, "a", torch.ones(3)), lambda u: collect(feedback=lambda y: u)),
        *each("generator", "collect generator", (3, "a"), lambda g: collect(generator=g)),
        *each("reset", "collect reset", ("yes", 3, None), lambda r: collect(reset=r)),
        *one("plant", "a plant that needs another layer", lambda: simulate(plant=Sized(n_u=1, n_y=1))),
    ]
