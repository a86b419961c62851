"""Every public object says what it is, in one to five lines."""

import inspect

import pytest
import torch

import torch_dpc as dpc
from helpers import generator, small_layer
from torch_dpc import attacks, detection, systems, tuning
from torch_dpc.reprs import shown

LAYER = small_layer()
DATA = LAYER.data
LINES, CHARACTERS = 5, 700


def recording(steps=200):
    return dpc.collect(systems.OscillatingMasses(noise=1e-2, generator=generator(1)), steps, generator=generator(0))


def windows(count=3):
    u, y = recording()
    rows = torch.arange(count)[:, None] + torch.arange(DATA.t_ini)
    return u[rows], y[rows]


def objects():
    """Return one object of every public class, by the name of its class."""
    u, y = recording()
    u_ini, y_ini = windows()
    plan = LAYER(u_ini, y_ini)
    budget, cost = attacks.RelativeBallBudget(0.1), attacks.TargetInput(torch.ones(DATA.n_u))
    attack = attacks.LinearizedAttack(LAYER, cost, budget)
    controller, plant = dpc.DPCController(LAYER, 3), systems.OscillatingMasses()
    detector = detection.ConsistencyDetector(DATA)
    calibrated = detection.ConsistencyDetector(DATA).calibrate(u, y, false_alarms=0.1)
    predictor = tuning.Predictor(DATA)
    objective = tuning.RobustObjective(LAYER, tuning.Windows(u_ini, y_ini, torch.ones(4)), budget, predictor=predictor)
    nearest = dpc.NearestWindows(LAYER, 20)
    policy = attacks.AttackPolicy.for_windows(DATA, (u_ini, y_ini, torch.ones(4), torch.ones(2), torch.tensor(0)))
    made = [
        *(dpc.Ball(1.0), dpc.Box(-1.0, torch.ones(2)), dpc.SoftBox(-1.0, 1.0, 10.0), dpc.SecondOrderCone()),
        *(dpc.NonNegative(), dpc.Reals(), dpc.Product([(dpc.Ball(1.0), [0, 1]), (dpc.Box(-1.0, 1.0), 2)])),
        *(DATA, dpc.HankelBatch([DATA, DATA]), dpc.HankelStream(t_ini=2, horizon=3), dpc.HankelStream.from_data(DATA)),
        *(LAYER, plan, plan.info, dpc.Status.SOLVED, LAYER.compact_form(u_ini[0], y_ini[0])),
        *(controller, nearest, dpc.simulate(plant, controller, torch.zeros(4), steps=9)),
        *(plant, systems.FourTanks(), systems.CartPole(), systems.TorchQuadrotor(), systems.Many([plant, plant])),
        systems.StateSpace(torch.eye(2), torch.eye(2), torch.eye(2), dt=0.1),
        systems.Ode(lambda x, u: u - x, lambda x, u: x, n_x=1, n_u=1, n_y=1, dt=0.1),
        *(budget, attacks.BallBudget(1.0), attacks.BoxBudget(1.0), attacks.EllipsoidBudget(torch.ones(3, 4))),
        *(attacks.L1BallBudget(1.0), attacks.SparseBallBudget(2, 1.0), attacks.StealthyBudget(budget, calibrated)),
        attacks.PerChannelBudget(budget),
        attacks.PerSampleBudget(budget),
        *(cost, attacks.TrackingError(DATA, 1.0), attacks.Predictor(DATA), attacks.RunError()),
        *(attack, attacks.RandomAttack(budget), attacks.ProjectedGradientAttack(LAYER, cost, budget)),
        *(attacks.FrankWolfeAttack(LAYER, cost, budget), attacks.Ensemble([attack, attacks.RandomAttack(budget)])),
        *(attacks.FiniteDifferenceAttack(LAYER, cost, budget), attacks.RandomSearchAttack(LAYER, cost, budget)),
        *(policy, attacks.PolicyAttack(policy, budget)),
        attacks.SignalAttack(plant, controller, attacks.RunError(), budget),
        *(attacks.PoisonedRecording(LAYER, cost, budget, samples=2), attacks.AttackOn("u_ini", attack)),
        attacks.BoundViolation(-1.0, 1.0),
        attacks.robustness_curve(plant, controller, attack, rhos=[0.0, 0.1], y_ref=torch.ones(4), steps=4, batch=2),
        *(detector, calibrated, calibrated.statistic(u_ini, y_ini), detection.Cusum(calibrated.score, 1.0, 2.0)),
        *(tuning.Windows(u_ini, y_ini, torch.ones(4)), objective, tuning.WeightScales(LAYER), tuning.MeanError([0])),
        tuning.QuadraticCost(torch.eye(4), torch.eye(2)),
        *(dpc.SolveError("no plan", []), dpc.InfeasibleError("no plan", []), dpc.ExcitationWarning("too little")),
    ]
    return {type(one).__name__: one for one in made}


#: Interfaces, what is returned by what takes long, and what needs an extra (tested below, where it is installed).
NOT_MADE = {
    *("Attack", "Budget", "ConvexSet", "Plant", "Planner", "TorchPlant"),
    *("WorstCase", "SensitivityBound", "CertifiedInterval", "Poisoned"),
    *("TuningResult", "Verdict", "Positive", "Semidefinite"),
    *("Quadrotor", "GymPlant"),
}


@pytest.fixture(scope="module")
def made():
    return objects()


def test_every_public_class_is_here(made):
    rooms = [dpc, attacks, detection, systems, tuning]
    things = [getattr(room, name) for room in rooms for name in room.__all__]
    public = {thing.__name__ for thing in things if inspect.isclass(thing)}
    assert public - set(made) == NOT_MADE


def test_each_says_what_it_is(made):
    for name, one in made.items():
        text = repr(one)
        assert " at 0x" not in text and "tensor([" not in text, text
        assert len(text.splitlines()) <= LINES and len(text) <= CHARACTERS, text
        assert name in text or name == "Status", text


def test_plants_of_other_libraries_say_what_they_are():
    gymnasium = pytest.importorskip("gymnasium")
    assert "1 inputs" in repr(systems.GymPlant(gymnasium.make("Pendulum-v1"), dt=0.05))
    env = dpc.envs.AttackEnv(systems.OscillatingMasses(), dpc.DPCController(LAYER), attacks.BallBudget(1.0), max)
    assert repr(env).startswith("AttackEnv(OscillatingMasses(") and "BallBudget(radius=1" in repr(env)
    assert repr(dpc.envs.QuadrotorEnv()).startswith("QuadrotorEnv(target=[")


def test_the_quadrotor_says_whether_it_flies():
    pytest.importorskip("pybullet")
    plant = systems.Quadrotor()
    assert repr(plant).endswith(": flying")
    plant.close()
    assert repr(plant).endswith(": closed")


def test_a_layer_says_what_was_asked_of_it():
    text = repr(small_layer(solver="newton", R_du=torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))))
    for part in ("n_u=2", "u_set=", "solver='newton'", "R_du=Parameter(2)", "reduced_kkt_size=", "lambda_g="):
        assert part in text, text
    assert "affine" not in text and "on_failure" not in text  # left at their defaults
    assert "DPCLayer(HankelData(" in repr(torch.nn.Sequential(small_layer()))


def test_a_log_counts_its_statuses_by_name():
    log = dpc.simulate(systems.OscillatingMasses(), dpc.DPCController(LAYER, 3), torch.zeros(4), steps=9)
    assert "status: 9 SOLVED" in repr(log) and "u in [" in repr(log)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "None"),
        (True, "True"),
        (1e6, "1e+06"),
        (3, "3"),
        ("auto", "'auto'"),
        (torch.tensor(0.1, dtype=torch.float64), "0.1"),
        (torch.ones(7), "tensor(7,)"),
        (torch.nn.Parameter(torch.ones(2)), "Parameter([1, 1])"),
        (torch.nn.Parameter(torch.ones(2, 2)), "Parameter(2, 2)"),
        ([1.0] * 9, "9 entries"),
        (torch.nn.Linear(1, 1), "Linear"),
        (max, "max"),
    ],
)
def test_values(value, text):
    assert shown(value) == text


def test_values_under_vmap():
    torch.vmap(lambda x: (shown(x), x)[1])(torch.ones(3, 2))
