"""Detectors, stealthy budgets, poisoned recordings, tuned weights, signals, environments, pictures, affine layers."""

import torch

import torch_dpc as dpc
from helpers import Y_REF, randn, small_data, small_layer, windows
from torch_dpc import attacks, detection, envs, plot, tuning

from .entry import INF, NAN, NEGATIVE, NO_COUNT, NOT_POSITIVE, Call, each, one

DATA, LAYER = small_data(), small_layer()
U, Y = randn(60, 2), randn(60, 4)
U_INI, Y_INI = (w[0] for w in windows(1, 3))
DETECTOR = detection.ConsistencyDetector(DATA).calibrate(U, Y, false_alarms=0.1)
BUDGET, COST = attacks.BallBudget(0.1), attacks.TargetInput(torch.ones(2))
PLANT = dpc.systems.OscillatingMasses()
NO_LAYER = (None, 3, "a", DATA)
NO_RATE = (0.0, 1.0, -0.1, NAN, "a", None)
NO_PICTURE = (None, 3, "a", torch.ones(3))


def calls() -> list[Call]:
    """Return the table."""
    return [*_detection(), *_poisoning(), *_judging(), *_signal(), *_environment(), *_pictures(), *_affine()]


def _detection() -> list[Call]:
    fresh = detection.ConsistencyDetector
    return [
        *each("data", "ConsistencyDetector data", (None, 3, "a", LAYER), fresh),
        *each("rank", "ConsistencyDetector rank", (0, -1, 1.5, "3", True, 99), lambda r: fresh(DATA, rank=r)),
        *each("false_alarms", "calibrate false_alarms", NO_RATE, lambda r: fresh(DATA).calibrate(U, Y, false_alarms=r)),
        *each("u", "calibrate u", ("a", None, 3, randn(60), randn(59, 2)), lambda u: fresh(DATA).calibrate(u, Y)),
        *each("y", "calibrate y", ("a", None, 3, randn(60, 3)), lambda y: fresh(DATA).calibrate(U, y)),
        *each("u_ini", "statistic u_ini", ("a", None, randn(3, 7)), lambda u: DETECTOR.statistic(u, Y_INI)),
        *each("y_ini", "score y_ini", ("a", None, randn(3, 7)), lambda y: DETECTOR.score(U_INI, y)),
        *each("y_ini", "alarms y_ini", ("a", None, randn(3, 7)), lambda y: DETECTOR.alarms(U_INI, y)),
        *each("drift", "cusum drift", (NAN, INF, "a"), lambda d: DETECTOR.cusum(d)),
        *each("false_alarms", "cusum false_alarms", NO_RATE, lambda r: DETECTOR.cusum(false_alarms=r)),
        *each("score", "Cusum score", (None, 3, "a"), lambda s: detection.Cusum(s, 1.0, 1.0)),
        *each("drift", "Cusum drift", (NAN, "a", None), lambda d: detection.Cusum(DETECTOR.score, d, 1.0)),
        *each("threshold", "Cusum threshold", NEGATIVE[:3], lambda t: detection.Cusum(DETECTOR.score, 1.0, t)),
        *each("detector", "StealthyBudget", (None, 3, "a", DATA), lambda d: attacks.StealthyBudget(BUDGET, d)),
        *each("budget", "StealthyBudget", (None, 3, attacks.Box(0.1)), lambda b: attacks.StealthyBudget(b, DETECTOR)),
        *each("detector", "simulate detector", (3, "a", DATA), lambda d: _run(detector=d)),
        *each("on_alarm", "DPCController on_alarm", ("panic", None, 3), lambda a: dpc.DPCController(LAYER, on_alarm=a)),
    ]


def _run(**options):
    return dpc.simulate(PLANT, dpc.DPCController(LAYER, 2), Y_REF, steps=4, **options)


def _poisoning() -> list[Call]:
    def poison(layer=LAYER, cost=COST, budget=BUDGET, **options):
        return attacks.PoisonedRecording(layer, cost, budget, **{"samples": 2, **options})

    def influence(layer=LAYER, cost=COST, **window):
        return attacks.window_influence(layer, cost, *{"u_ini": U_INI, "y_ini": Y_INI, **window}.values())

    def attack(**options):
        return poison()(*{"u": U, "y": Y, "u_ini": U_INI, "y_ini": Y_INI, **options}.values())

    ones = torch.ones(DATA.n_g)
    return [
        *each("layer", "PoisonedRecording layer", NO_LAYER, lambda x: poison(layer=x)),
        *each("cost", "PoisonedRecording cost", (None, 3, "a"), lambda x: poison(cost=x)),
        *each("budget", "PoisonedRecording budget", (None, 3, "a"), lambda x: poison(budget=x)),
        *each("samples", "samples", (*NO_COUNT, [], [0, 0], [-1], [1.5], [0, 10**6]), lambda n: _asked(poison, n)),
        *each("choose", "PoisonedRecording choose", ("worst", None, 3), lambda x: poison(choose=x)),
        *each("steps", "PoisonedRecording steps", (-1, 1.5, "3", None), lambda n: poison(steps=n)),
        *each("u", "poisoned u", ("a", None, randn(60), randn(59, 2)), lambda x: attack(u=x)),
        *each("y", "poisoned y", ("a", None, randn(60)), lambda x: attack(y=x)),
        *each("u_ini", "poisoned u_ini", ("a", None, randn(3, 7)), lambda x: attack(u_ini=x)),
        *each("y_ini", "poisoned y_ini", ("a", None, randn(3, 7)), lambda x: attack(y_ini=x)),
        *each("generator", "poisoned generator", (3, "a"), lambda g: poison()(U, Y, U_INI, Y_INI, generator=g)),
        *each("layer", "window_influence layer", NO_LAYER, lambda x: influence(layer=x)),
        *each("cost", "window_influence cost", (None, 3, "a"), lambda x: influence(cost=x)),
        *each("y_ini", "window_influence y_ini", ("a", None, randn(3, 7)), lambda x: influence(y_ini=x)),
        *each("data", "weigh_windows data", (None, 3, "a", LAYER), lambda x: attacks.weigh_windows(x, ones)),
        *each(
            "weights",
            "weigh_windows weights",
            (None, "a", -ones, ones[1:], NAN * ones, 1.0),
            lambda w: attacks.weigh_windows(DATA, w),
        ),
    ]


def _asked(poison, samples):
    return poison(samples=samples)(U, Y, U_INI, Y_INI)


def _judging() -> list[Call]:
    def judge(before=LAYER, after=LAYER, attacks=None, **options):
        run = {"resets": {"state": randn(2, 4)}, "y_ref": Y_REF, "steps": 4, **options}
        return tuning.judge(PLANT, before, after, attacks={} if attacks is None else attacks, **run)

    return [
        *each("before", "judge before", (3, "a", None, [3], []), lambda x: judge(before=x)),
        *each("after", "judge after", (3, "a", None, [3], []), lambda x: judge(after=x)),
        *each("attacks", "judge attacks", (3, "a", [], {"a": 3}), lambda x: judge(attacks=x)),
        *each("certify", "judge certify", (3, "a", None), lambda x: judge(certify=x)),
        *each("cost", "attack_suite cost", (None, 3, "a"), lambda x: tuning.attack_suite(x, BUDGET)),
        *each("budget", "attack_suite budget", (None, 3, "a"), lambda x: tuning.attack_suite(COST, x)),
        *each("layer", "plan_gain layer", NO_LAYER, tuning.plan_gain),
        *each("weight", "Positive", (torch.tensor(0.0), torch.tensor(-1.0)), tuning.Positive().right_inverse),
        *each("weight", "Semidefinite", (-torch.eye(2), torch.ones(2, 3)), tuning.Semidefinite().right_inverse),
    ]


def _signal() -> list[Call]:
    def signal(plant=PLANT, controller=None, cost=None, budget=BUDGET, **options):
        controller = dpc.DPCController(LAYER, 2) if controller is None else controller
        cost = attacks.RunError([0]) if cost is None else cost
        return attacks.SignalAttack(plant, controller, cost, budget, **options)

    return [
        *each("controller", "SignalAttack controller", (3, "a", LAYER), lambda x: signal(controller=x)),
        *each("budget", "SignalAttack budget", (None, 3, "a"), lambda x: signal(budget=x)),
        *each("step_size", "SignalAttack step_size", NOT_POSITIVE, lambda x: signal(step_size=x)),
        *each("plans", "SignalAttack plans", NO_COUNT, lambda n: signal(plans=n)),
        *each("cost", "SignalAttack cost", (3, "a"), lambda x: signal(cost=x)),
        *each("channels", "RunError", (3, "a", [], [1.5], [-1]), attacks.RunError),
        *each("budget", "PerSampleBudget", (None, 3, "a"), attacks.PerSampleBudget),
        *each("attacks", "Ensemble", ([], None, 3, "a", [3]), attacks.Ensemble),
    ]


def _environment() -> list[Call]:
    def env(plant=PLANT, controller=None, budget=BUDGET, cost=COST, **options):
        controller = dpc.DPCController(LAYER, 2) if controller is None else controller
        return envs.AttackEnv(plant, controller, budget, cost, **{"y_ref": Y_REF, **options})

    return [
        *each("n_u", "AttackEnv plant", (3, "a", object()), lambda x: env(plant=x)),
        *each("controller", "AttackEnv controller", (3, "a", LAYER), lambda x: env(controller=x)),
        *each("budget", "AttackEnv budget", (None, 3, "a"), lambda x: env(budget=x)),
        *each("cost", "AttackEnv cost", (None, 3, "a"), lambda x: env(cost=x)),
        *each("steps", "AttackEnv steps", NO_COUNT, lambda n: env(steps=n)),
        *each("y_ref", "AttackEnv y_ref", ("a", {}, torch.ones(3), torch.full((4,), NAN)), lambda r: env(y_ref=r)),
    ]


def _pictures() -> list[Call]:
    return [
        *each("log", "plot.log", NO_PICTURE, plot.log),
        *each("plan", "plot.plan", NO_PICTURE, plot.plan),
        *each("data", "plot.data", NO_PICTURE, plot.data),
        *each("log", "plot.perturbation", NO_PICTURE, plot.perturbation),
        *each("result", "plot.worst_case", NO_PICTURE, plot.worst_case),
        *each("curves", "plot.damage", (None, 3, "a", {}, {"a": 3}), plot.damage),
        *each("log", "plot.animate", NO_PICTURE, lambda x: plot.animate(x, "nowhere.gif")),
    ]


def _affine() -> list[Call]:
    return [
        *each("affine", "affine", (3, "a", None), lambda x: small_layer(affine=x)),
        *each("affine", "set affine", (3, "a", None), _set_affine),
        *each(
            "Q_terminal",
            "Q_terminal",
            (-1.0, NAN, "a", {}, torch.eye(3), torch.ones(4), torch.eye(4) - 2),
            lambda q: small_layer(Q_terminal=q),
        ),
        *one("affine", "affine on compact data", lambda: _affine_on_compact()),
    ]


def _set_affine(value):
    layer = small_layer()
    layer.affine = value


def _affine_on_compact():
    return dpc.DPCLayer(DATA.compressed(), Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e3, affine=True)
