"""The paper's setting, number by number, and the runs of Figures 3 and 4 written out once more by hand."""

import math
from dataclasses import replace

import pytest
import torch

import torch_dpc as dpc

pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")

from scripts.experiments.case import run_seed
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor

SAME = 1e-12  # of a run's mean error, relative: the same arithmetic, in another order

PAPER = {
    Masses: {
        "t_ini": 6,
        "horizon": 25,
        "n_g": 500,
        "lambda_g": 100.0,
        "lambda_s": 1e6,
        "Q": (10.0, 10.0, 10.0, 10.0),
        "R": (1.0, 1.0),
        "u_max": 1.0,
        "y_min": (-5.0, -5.0, -5.0, -5.0),
        "y_max": (5.0, 5.0, 5.0, 5.0),
        "replan_every": 10,
        "steps": 200,
        "dt": 0.1,
        "rhos": (0.02, 0.04, 0.10),
        "y_ref": (1.0, 1.0, 0.0, 0.0),
    },
    Quadrotor: {
        "t_ini": 6,
        "horizon": 25,
        "n_g": 500,
        "lambda_g": 100.0,
        "lambda_s": 1e6,
        "Q": (10.0, 10.0, 10.0, 0.0, 0.0, 0.0),
        "R": (1.0, 1.0, 1.0),
        "u_max": 1.0,
        "y_min": (-2.0, -2.0, 0.0, -math.pi / 8, -math.pi / 8, -math.pi / 8),
        "y_max": (2.0, 2.0, 2.0, math.pi / 8, math.pi / 8, math.pi / 8),
        "replan_every": 10,
        "steps": 500,
        "dt": 0.04,
        "rhos": (0.001, 0.002, 0.003),
        "radius": 0.3,
        "u_target": (0.0, 1.0, 0.0),
    },
}
OUR_CHOICE = {
    Masses: {"u_ref": (1.0, 1.0), "noise": 0.0, "start_spread": 0.1, "random_start": 0.5, "push": 0.3},
    Quadrotor: {
        "period": 10.0,
        "height": 1.0,
        "u_ref": (0.0, 0.0, 0.0),
        "amplitude": 0.5,
        "hold": 10,
        "pull": 0.3,
        "noise": 0.0,
        "physics_hz": 250,
        "random_start": 0.3,
        "push": 0.2,
    },
}


@pytest.mark.parametrize("kind", PAPER)
def test_every_number_is_the_papers_or_a_listed_choice(kind):
    assert vars(kind()) == PAPER[kind] | OUR_CHOICE[kind]


@pytest.mark.parametrize("kind", PAPER)
def test_the_layer_is_posed_with_these_numbers(kind):
    case, paper = kind(), PAPER[kind]
    generator = torch.Generator().manual_seed(0)
    shapes = (len(paper["R"]), len(paper["Q"]))
    u, y = (torch.randn(case.samples, n, dtype=torch.float64, generator=generator) for n in shapes)
    layer = case.layer(case.hankel(u, y))
    assert (layer.data.t_ini, layer.data.horizon, layer.data.n_g) == (6, 25, 500)
    assert (float(layer.lambda_g), float(layer.lambda_s)) == (100.0, 1e6)
    assert torch.equal(layer.Q, torch.diag(torch.tensor(paper["Q"]).double()))
    assert torch.equal(layer.R, torch.diag(torch.tensor(paper["R"]).double()))
    for box, least, most in (
        (layer.u_set, (-1.0,) * shapes[0], (1.0,) * shapes[0]),
        (layer.y_set, paper["y_min"], paper["y_max"]),
    ):
        far = 100 * torch.ones(25, len(most)).double()
        inside = torch.tensor(most, dtype=torch.float64).expand(25, -1)
        assert torch.equal(box.project(far), inside)
        assert torch.equal(box.project(-far), torch.tensor(least, dtype=torch.float64).expand(25, -1))


def test_a_case_with_one_number_changed_is_another_experiment():
    case = replace(Quadrotor(), replan_every=1)
    assert case != Quadrotor() and case == replace(Quadrotor(), replan_every=1) and case.horizon == 25


def test_figure_3_written_out_by_hand():
    plant = dpc.systems.OscillatingMasses()
    u, y = dpc.collect(plant, 530, generator=torch.Generator().manual_seed(1))
    layer = dpc.DPCLayer(
        dpc.HankelData.from_trajectories(u, y, t_ini=6, horizon=25),
        Q=10 * torch.eye(4),
        R=torch.eye(2),
        lambda_g=100.0,
        lambda_s=1e6,
        u_set=dpc.Box(-1.0, 1.0),
        y_set=dpc.Box(-5.0, 5.0),
    )
    sine = torch.sin(0.1 * torch.arange(225, dtype=torch.float64))[:, None].expand(-1, 2)
    attack = dpc.attacks.LinearizedAttack(
        layer, dpc.attacks.TargetInput(trajectory=sine), dpc.attacks.RelativeBall(0.1)
    )
    log = dpc.simulate(
        plant,
        dpc.DPCController(layer, replan_every=10),
        torch.tensor([1.0, 1.0, 0.0, 0.0]),
        steps=200,
        u_ref=torch.tensor([1.0, 1.0]),
        attack=attack,
        reset={"state": torch.tensor([1.0, 1.0, 0.0, 0.0]).double()},
        u_warmup=torch.tensor([1.0, 1.0]),
    )
    by_hand = (log.y[:, 0] - 1.0).abs().mean()
    (run,) = [run for run in run_seed(Masses(), 1, [0.1]) if run["attack"] == "algorithm1"]
    assert run["error"].mean() == pytest.approx(float(by_hand), rel=SAME)


def test_the_reference_inputs_move_the_circle():
    case = replace(Quadrotor(), u_ref=None)
    y_ref, u_ref = case.references(251)
    moved = case.dt * u_ref.cumsum(0)
    assert ((y_ref[1:, :3] - y_ref[:-1, :3]) / case.dt - u_ref[:-1]).abs().max() < 0.01 * 0.3 * 2 * math.pi / 10 * 2
    assert moved[249].norm() < 1e-12  # once around
    assert Quadrotor().references(3)[1].tolist() == [[0.0, 0.0, 0.0]] * 3


def test_noise_in_the_recording_is_relative_to_each_output():
    pytest.importorskip("pybullet", reason="the quadrotor simulation needs pybullet (Python <= 3.11)")
    clean, noisy = Quadrotor(), replace(Quadrotor(), noise=1e-2)
    with clean.system() as plant:
        (u, y), (v, z) = clean.record(plant, 5), noisy.record(plant, 5)
    assert torch.equal(u, v)
    torch.testing.assert_close((z - y).std(0) / y.std(0), torch.full((6,), 1e-2).double(), rtol=0.15, atol=0)
