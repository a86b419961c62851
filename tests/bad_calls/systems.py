"""Plants and the tuning of weights."""

import torch

from helpers import randn, small_layer, windows
from torch_dpc import attacks, systems, tuning

from .entry import INF, NAN, NEGATIVE, NO_COUNT, NOT_POSITIVE, Call, each, one

EYE = torch.eye(2)


def ode(**options):
    arguments = {"f": lambda x, u: u - x, "n_x": 1, "n_u": 1, "dt": 0.1, **options}
    return systems.Ode(arguments.pop("f"), arguments.pop("h", None), **arguments)


def space(A=EYE, B=EYE, **options):
    return systems.StateSpace(A, B, **{"dt": 0.1, **options})


NO_MATRIX = ("a", None, {}, torch.ones(2), torch.ones(2, 3), torch.full((2, 2), NAN), EYE.long())
NO_INPUT = (None, "a", {}, torch.ones(3), torch.full((2,), NAN), INF)
MASSES = {"dt": NOT_POSITIVE, "mass": NOT_POSITIVE, "spring": NOT_POSITIVE, "damping": NEGATIVE, "noise": NEGATIVE}


def calls() -> list[Call]:
    """Return the table."""
    masses = systems.OscillatingMasses
    return [
        *_tuning(),
        *[
            *each("masses", "OscillatingMasses masses", NO_COUNT, masses),
            *[
                call
                for name, values in MASSES.items()
                for call in each(name, f"OscillatingMasses {name}", values, lambda v, name=name: masses(**{name: v}))
            ],
            *each(
                "state",
                "OscillatingMasses.reset",
                ("a", {}, torch.ones(3), torch.full((4,), NAN)),
                lambda x: masses().reset(x),
            ),
            *each("u", "OscillatingMasses.step", NO_INPUT, lambda u: masses().step(u)),
            *each("A", "StateSpace A", NO_MATRIX, lambda A: space(A=A)),
            *each(
                "B", "StateSpace B", ("a", None, {}, torch.ones(3, 2), torch.full((2, 2), NAN)), lambda B: space(B=B)
            ),
            *each("C", "StateSpace C", ("a", {}, torch.ones(2, 3), torch.full((2, 2), NAN)), lambda C: space(C=C)),
            *each("D", "StateSpace D", ("a", {}, torch.ones(3, 3), torch.full((2, 2), NAN)), lambda D: space(D=D)),
            *each("dt", "StateSpace dt", NOT_POSITIVE, lambda dt: space(dt=dt)),
            *each("x0", "StateSpace x0", ("a", {}, torch.ones(3), NAN), lambda x: space(x0=x)),
            *each(
                "process_noise",
                "StateSpace process_noise",
                (-1.0, NAN, "a", None, torch.ones(3)),
                lambda s: space(process_noise=s),
            ),
            *each(
                "measurement_noise",
                "StateSpace measurement_noise",
                (-1.0, NAN, "a", None, torch.ones(3)),
                lambda s: space(measurement_noise=s),
            ),
            *each("generator", "StateSpace generator", (3, "a"), lambda g: space(generator=g)),
            *each("f", "Ode f", (None, 3, "a"), lambda f: ode(f=f)),
            *each("h", "Ode h", (3, "a"), lambda h: ode(h=h, n_y=1)),
            *each("n_x", "Ode n_x", NO_COUNT, lambda n: ode(n_x=n)),
            *each("n_u", "Ode n_u", NO_COUNT, lambda n: ode(n_u=n)),
            *each("dt", "Ode dt", NOT_POSITIVE, lambda dt: ode(dt=dt)),
            *each("method", "Ode method", ("euler", None, 3), lambda m: ode(method=m)),
            *each("substeps", "Ode substeps", NO_COUNT, lambda n: ode(substeps=n)),
            *each(
                "f",
                "what f returns",
                (torch.ones(3), "a", None),
                lambda dx: ode(f=lambda x, u: dx).step(torch.zeros(1)),
            ),
            *each("phase", "FourTanks phase", ("medium", None, 3), systems.FourTanks),
            *each("dt", "FourTanks dt", NOT_POSITIVE, lambda dt: systems.FourTanks(dt=dt)),
            *each("dt", "CartPole dt", NOT_POSITIVE, lambda dt: systems.CartPole(dt=dt)),
            *each("physics_hz", "TorchQuadrotor physics_hz", (*NO_COUNT, 240), systems.TorchQuadrotor),
            *each("ground", "TorchQuadrotor ground", ("bounce", None, 3), lambda g: systems.TorchQuadrotor(ground=g)),
            *each(
                "position",
                "TorchQuadrotor.reset position",
                ("a", (0.0, 0.0), (0.0, 0.0, NAN), (0.0, 0.0, -1.0)),
                lambda p: systems.TorchQuadrotor().reset(position=p),
            ),
            *each("u", "TorchQuadrotor.step", (None, "a", torch.ones(4), torch.full((3,), NAN)), _fly),
            *each("batch", "reset batch", ("a", 1.5, (-1,)), lambda b: masses().reset(batch=b)),
        ],
    ]


def _fly(u):
    vehicle = systems.TorchQuadrotor()
    vehicle.reset()
    return vehicle.step(u)


LAYER = small_layer(Q=10 * torch.eye(4), R=torch.eye(2))
WINDOWS = tuning.Windows(*windows(4, 3), torch.zeros(4))


def objective(**options):
    arguments = {"layer": LAYER, "windows": WINDOWS, "budget": attacks.BallBudget(0.1), **options}
    arguments.setdefault("predictor", tuning.Predictor(LAYER.data))
    return tuning.RobustObjective(
        arguments.pop("layer"), arguments.pop("windows"), arguments.pop("budget"), **arguments
    )


def _tuning() -> list[Call]:
    tune = lambda **options: tuning.tune(objective(), **{"steps": 1, **options})  # noqa: E731
    return [
        *each("layer", "RobustObjective layer", (None, 3, "a"), lambda x: objective(layer=x)),
        *each("windows", "RobustObjective windows", (None, 3, "a", torch.ones(2)), lambda x: objective(windows=x)),
        *each("budget", "RobustObjective budget", (None, 3, 0.1, "a"), lambda x: objective(budget=x)),
        *each("psi", "RobustObjective psi", (3, "a"), lambda x: objective(psi=x)),
        *each("predictor", "RobustObjective predictor", (3, "a", None), lambda x: objective(predictor=x)),
        *each("cost", "RobustObjective cost", (3, "a"), lambda x: objective(cost=x)),
        *each("plans", "RobustObjective plans", NO_COUNT, lambda n: objective(plans=n)),
        *each(
            "replan_every", "RobustObjective replan_every", (0, -1, 1.5, "3", 99), lambda n: objective(replan_every=n)
        ),
        *each("attacked_weight", "RobustObjective attacked_weight", NEGATIVE, lambda w: objective(attacked_weight=w)),
        *each("gain_weight", "RobustObjective gain_weight", NEGATIVE, lambda w: objective(gain_weight=w)),
        *each("through", "RobustObjective through", ("walls", None, 3), lambda x: objective(through=x)),
        *each("iterations", "RobustObjective iterations", NO_COUNT, lambda n: objective(iterations=n)),
        *each("objectives", "tune objectives", (None, [], 3, "a", [3]), lambda x: tuning.tune(x, steps=1)),
        *each("steps", "tune steps", NO_COUNT, lambda n: tune(steps=n)),
        *each("lr", "tune lr", NOT_POSITIVE, lambda x: tune(lr=x)),
        *each("limit", "tune limit", (-1.0, 0.0, NAN, "a", None), lambda x: tune(limit=x)),
        *each("seconds", "tune seconds", (-1.0, NAN, "a", None), lambda x: tune(seconds=x)),
        *each("scales", "tune scales", (3, "a"), lambda x: tune(scales=x)),
        *each("progress", "tune progress", (3, "a", None), lambda x: tune(progress=x)),
        *each("layer", "WeightScales", (None, 3, "a"), tuning.WeightScales),
        *each("channels", "MeanError", (None, 3, "a", [], [1.5], [-1]), tuning.MeanError),
        *each(
            "Q", "QuadraticCost Q", (None, "a", -1.0, torch.ones(2)), lambda q: tuning.QuadraticCost(q, torch.eye(2))
        ),
        *each("u_ini", "Windows u_ini", (None, "a"), lambda u: tuning.Windows(u, randn(4, 3, 4), torch.zeros(4))),
        *one(
            "u_ini and y_ini",
            "Windows of other counts",
            lambda: tuning.Windows(randn(4, 3, 2), randn(3, 3, 4), torch.zeros(4)),
        ),
        *one("y_ref", "Windows without a reference", lambda: tuning.Windows(randn(4, 3, 2), randn(4, 3, 4), None)),
    ]
