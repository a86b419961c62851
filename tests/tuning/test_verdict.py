"""What counts as a better controller, and weights that stay in their domain."""

import pytest
import torch
from torch.nn.utils import parametrize

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, masses_data, randn
from torch_dpc import attacks, tuning


def layer(**weights):
    data = masses_data(0.0, steps=200, t_ini=4, horizon=20)
    options = {"Q": 10.0, "R": 1.0, "lambda_g": 1.0, "lambda_s": 1e4, **weights}
    return dpc.DPCLayer(data, u_set=dpc.Box(-1.0, 1.0), **options)


SUITE = {
    "Algorithm 1": lambda planner: attacks.LinearizedAttack(
        planner, attacks.TargetInput(torch.zeros(2)), attacks.RelativeBall(0.1)
    ),
    "random noise": lambda planner: attacks.RandomAttack(attacks.RelativeBall(0.1)),
}


def errors(planner, spread, **options):
    starts = 0.3 * Y_REF + spread * randn(8, 4, seed=2)
    run = {"y_ref": 0.3 * Y_REF, "u_ref": 0.3 * HOLDING, "resets": {"state": starts}, "u_warmup": 0.3}
    plant = dpc.systems.OscillatingMasses()
    return tuning.scenarios(plant, planner, **run, attacks=SUITE, steps=80, channels=[0, 1], replan_every=5, **options)


def test_a_controller_that_holds_its_input_is_rejected():
    """Weights that ignore the outputs: on its reference nothing can move it, and it no longer controls."""
    honest, holding = layer(), layer(Q=1e-6, lambda_s=1e-3)
    hollow = tuning.compare(errors(honest, 0.0), errors(holding, 0.0))
    assert hollow.dominates, "judged from the reference alone it looks better: the claim that must not be made"
    more = {"other_y_ref": 0.2 * Y_REF, "push": torch.tensor([0.3, -0.3])}
    verdict = tuning.compare(errors(honest, 0.2, **more), errors(holding, 0.2, **more))
    assert not verdict.dominates
    assert {"from every start", "pushed", "another reference"} <= set(verdict.worse)
    assert "from every start" in str(verdict)


def test_a_controller_does_not_dominate_itself():
    own = errors(layer(), 0.2)
    verdict = tuning.compare(own, own)
    assert not verdict.worse and not verdict.better and not verdict.dominates


def test_the_interval_is_paired():
    """A small gain on every run is seen although the runs differ by far more."""
    spread = 10 * torch.rand(30, dtype=torch.float64, generator=generator())
    gain = 0.1 + 0.01 * randn(30)
    verdict = tuning.compare({"runs": spread}, {"runs": spread - gain})
    assert verdict.dominates and -0.11 < verdict.low["runs"] < verdict.high["runs"] < -0.09


def test_other_scenarios_and_runs_are_named():
    with pytest.raises(ValueError, match="must hold the same scenarios"):
        tuning.compare({"a": torch.ones(3)}, {"b": torch.ones(3)})
    with pytest.raises(ValueError, match="must hold the same runs"):
        tuning.compare({"a": torch.ones(3)}, {"a": torch.ones(4)})


def test_weights_under_adam_stay_in_their_domain():
    planner = layer(
        Q=torch.nn.Parameter(10 * torch.eye(4).double()), lambda_s=torch.nn.Parameter(torch.tensor(1.0).double())
    )
    parametrize.register_parametrization(planner, "Q", tuning.Semidefinite())
    parametrize.register_parametrization(planner, "lambda_s", tuning.Positive())
    torch.testing.assert_close(planner.Q.detach(), 10 * torch.eye(4, dtype=torch.float64))
    optimizer = torch.optim.Adam(planner.parameters(), lr=1.0)
    u_ini, y_ini = torch.zeros(4, 2).double(), 0.1 * randn(4, 4)
    for _ in range(10):
        optimizer.zero_grad()
        planner(u_ini, y_ini, y_ref=0.3 * Y_REF).u.square().sum().backward()
        optimizer.step()
    assert float(planner.lambda_s) > 0 and torch.linalg.eigvalsh(planner.Q).min() > -1e-9
    with pytest.raises(ValueError, match="must be positive"):
        tuning.Positive().right_inverse(torch.tensor(0.0))
    with pytest.raises(ValueError, match="positive semidefinite"):
        tuning.Semidefinite().right_inverse(-torch.eye(2))


def test_the_error_names_what_keeps_a_learned_weight_in_its_domain():
    u_ini, y_ini = torch.zeros(4, 2).double(), torch.zeros(4, 4).double()
    for name, start, bad, remedy in (
        ("lambda_s", torch.tensor(1.0), torch.tensor(-1.0), "tuning.Positive"),
        ("Q", torch.eye(4), -torch.eye(4), "tuning.Semidefinite"),
    ):
        planner = layer(**{name: torch.nn.Parameter(start.double())})
        with torch.no_grad():
            getattr(planner, name).copy_(bad)
        with pytest.raises(ValueError, match=rf"`{name}` must .* stays in its domain with {remedy}"):
            planner(u_ini, y_ini)
    with pytest.raises(ValueError, match=r"`lambda_s` must not be negative, got -1\.$"):
        layer(lambda_s=-1.0)


# --- every attack, every recording ------------------------------------------------------------------------------------

COST, BUDGET = attacks.TargetInput(torch.zeros(2)), attacks.RelativeBall(0.1)
RUN = {"resets": {"state": 0.3 * Y_REF + 0.2 * randn(3, 4, seed=2)}, "y_ref": 0.3 * Y_REF, "u_ref": 0.3 * HOLDING}
RUN |= {"steps": 20, "replan_every": 5}


def recorded(seed, **weights):
    data = masses_data(0.01, steps=150, t_ini=3, horizon=8, seed=seed)
    return dpc.DPCLayer(data, **{"Q": 10.0, "R": 1.0, "lambda_g": 1.0, "lambda_s": 1e4, **weights})


def test_the_verdict_has_every_attack_on_every_recording():
    before, after = ([recorded(seed, Q=q) for seed in (0, 1)] for q in (10.0, 1.0))
    suite = tuning.attack_suite(COST, BUDGET, steps=2, queries=3)
    plant = dpc.systems.OscillatingMasses()
    verdict = tuning.judge(plant, before, after, attacks=suite, **RUN)
    assert set(verdict.before) == {"from every start", *suite} and len(suite) == 7 and verdict.runs == 6
    one = tuning.scenarios(plant, before[1], attacks=suite, **RUN)
    two = tuning.scenarios(plant, before[0], attacks=suite, **RUN)
    for name, errors in one.items():
        assert verdict.before[name] == float(torch.cat([two[name], errors]).mean())
    assert verdict.certified is None and "certified" not in str(verdict)


def test_the_strongest_of_all_is_at_least_as_strong_as_each():
    layer = recorded(0, u_set=dpc.Box(-1.0, 1.0))
    u_ini, y_ini = layer.data.Up[:, :4].mT.reshape(4, 3, 2), layer.data.Yp[:, :4].mT.reshape(4, 3, 4)
    psi = {}
    for name, make in tuning.attack_suite(COST, BUDGET, steps=3, queries=5).items():
        p = make(layer)(u_ini, y_ini, y_ref=0.3 * Y_REF, generator=generator())
        psi[name] = COST(layer(u_ini, y_ini + p, y_ref=0.3 * Y_REF))
    single = torch.stack([value for name, value in psi.items() if name not in ("strongest of all", "tracking")])
    assert (psi["strongest of all"] <= single[1:].amin(0) * (1 + 1e-9)).all()


def test_the_certificate_stands_beside_the_errors():
    pytest.importorskip("clarabel", reason="extra `exact`")
    layers = [recorded(0, Q=q, u_set=dpc.Box(-1.0, 1.0)) for q in (10.0, 1.0)]
    verdict = tuning.judge(dpc.systems.OscillatingMasses(), *layers, attacks={}, certify=True, **RUN)
    bounds = tuple(float(attacks.sensitivity_bound(layer)) for layer in layers)
    assert verdict.certified == pytest.approx(bounds, rel=1e-6)
    assert "certified |du| / |p|" in str(verdict)


def test_what_cannot_be_judged_is_named():
    plant, own = dpc.systems.OscillatingMasses(), recorded(0)
    with pytest.raises(ValueError, match="layers of the same recordings in the same order"):
        tuning.judge(plant, own, recorded(1), attacks={}, **RUN)
    with pytest.raises(ValueError, match="a layer for each of the same recordings, got 1 and 2"):
        tuning.judge(plant, own, [own, own], attacks={}, **RUN)
    with pytest.raises(ValueError, match="`attacks` must map names to callables"):
        tuning.judge(plant, own, own, attacks=[3], **RUN)
