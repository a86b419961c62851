"""The commands, run as a user runs them, and what they compute."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import torch_dpc as dpc
from helpers import SMALL, generator, small_layer
from torch_dpc import attacks

pytest.importorskip("typer")
pytest.importorskip("matplotlib").use("Agg")

from typer.testing import CliRunner  # noqa: E402

from torch_dpc.__main__ import app  # noqa: E402
from torch_dpc.commands.audit import audit  # noqa: E402
from torch_dpc.commands.check import check  # noqa: E402

NAMES = ("-u", "v1,v2", "-y", "h1,h2,w1,w2")


def recording(noise=1e-2, steps=200, seed=0):
    source = generator(seed)
    plant = dpc.systems.OscillatingMasses(noise=noise, damping=0.2, generator=source)
    return dpc.collect(plant, steps, generator=source)


def write_csv(path, u, y, header="v1,v2,h1,h2,w1,w2"):
    rows = (",".join(map(repr, row)) for row in torch.cat([u, y], 1).tolist())
    path.write_text("\n".join([header, *rows]))
    return str(path)


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def words(result):
    return " ".join(result.output.split())


# --- check ------------------------------------------------------------------------------------------------------------


def test_a_good_recording_passes_and_leaves_a_picture(tmp_path):
    path, picture = write_csv(tmp_path / "data.csv", *recording()), tmp_path / "check.png"
    result = run("check", path, *NAMES, "--t-ini", 4, "--horizon", 10, "--picture", picture)
    assert result.exit_code == 0, result.output
    assert "187 windows of 4 past and 10 future steps" in result.output
    assert "The recording is good enough to control with." in words(result)
    order = dpc.excitation_order([recording()[0]])
    assert order > 14 and f"order {order}, 14 needed" in words(result)
    with Image.open(picture) as image:
        assert image.size == (2100, 540)
        assert np.asarray(image.convert("L")).std() > 20


def test_a_noise_free_recording_of_a_linear_plant_is_predicted_exactly():
    u, y = recording(noise=0.0)
    verdict = check([u], [y], t_ini=4, horizon=10)
    assert verdict.errors.max() < 1e-10
    assert verdict.data.rank == 2 * 14 + 4
    assert verdict.n_held_out == 50 - 14 + 1
    # holding the last output, by hand: windows begin at samples 150 ... 186
    last, ahead = y[153:190], y[163:200]
    expected = (last - ahead).square().mean(0).sqrt() / y[:150].std(0)
    torch.testing.assert_close(verdict.holding[-1], expected)
    assert verdict.advice == []


def test_errors_are_of_the_size_of_the_noise():
    u, y = recording(noise=0.05, steps=600)
    verdict = check([u], [y], t_ini=6, horizon=10)
    noise = 0.05 / y[:450].std(0)
    assert (verdict.errors > 0.8 * noise).all()
    assert (verdict.errors < 2.5 * noise).all()
    assert verdict.is_useful


def test_too_little_excitation_is_said_and_fails(tmp_path):
    _, y = recording()
    u = torch.ones(200, 2, dtype=torch.float64)
    result = run("check", write_csv(tmp_path / "data.csv", u, y), *NAMES, "--t-ini", 4, "--horizon", 10)
    assert result.exit_code == 1
    assert "order 0 of 14" in result.output
    assert "record longer, or vary every input more and independently" in words(result)


def test_noise_that_hides_everything_is_said_and_fails():
    u, _ = recording()
    y = torch.randn(200, 2, dtype=torch.float64, generator=generator(3))
    verdict = check([u], [y], t_ini=4, horizon=10)
    assert not verdict.is_useful
    assert any("hardly better than the last output" in sentence for sentence in verdict.advice)


def test_a_longer_t_ini_is_advised_where_it_helps():
    """One measured output of four states: two past steps do not fix them, eight do."""
    u, y = recording(noise=0.0, steps=400)
    verdict = check([u], [y[:, :1]], t_ini=2, horizon=10)
    assert verdict.longer < 0.1 * float(verdict.errors.mean())
    assert any("try --t-ini 4" in sentence for sentence in verdict.advice)


def test_several_recordings(tmp_path):
    paths = [write_csv(tmp_path / f"{seed}.csv", *recording(steps=120, seed=seed)) for seed in range(2)]
    result = run("check", *paths, *NAMES, "--t-ini", 4, "--horizon", 10)
    assert result.exit_code == 0
    assert "214 windows" in result.output


# --- audit ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path):
    pytest.importorskip("safetensors")
    layer, path = small_layer(), tmp_path / "layer.safetensors"
    layer.save(path)
    return layer, path


def test_an_audit_prints_every_attack_and_leaves_a_picture(saved, tmp_path):
    path, picture = write_csv(tmp_path / "data.csv", *recording()), tmp_path / "audit.png"
    options = ("--rho", "0.02,0.1", "--windows", 20, "--y-ref", "1,1,0,0", "--picture", picture)
    result = run("audit", saved[1], path, *NAMES, *options)
    assert result.exit_code == 0, result.output
    for name in ("random noise", "Algorithm 1", "projected gradient"):
        assert result.output.count(name) == 2
    assert "Reference [1.0, 1.0, 0.0, 0.0], 20 windows" in words(result)
    assert "Measurement errors of 10 % raise the predicted error by" in words(result)
    with Image.open(picture) as image:
        assert np.asarray(image.convert("L")).std() > 10


def test_the_figures_of_an_audit_are_those_of_its_windows(saved):
    layer, (u, y), y_ref = saved[0], recording(seed=4), torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    result = audit(layer, u, y, rhos=[0.05], windows=10, y_ref=y_ref, seed=0)
    random, algorithm_1, projected = result.damages
    starts = torch.linspace(0, 197, 10).round().long()
    budget = attacks.RelativeBall(0.05)
    attack = attacks.LinearizedAttack(layer, attacks.TrackingError(layer.data, SMALL["Q"]), budget)
    predict = attacks.Predictor(layer.data)
    for i, start in enumerate(starts.tolist()):
        u_ini, y_ini = u[start : start + 3], y[start : start + 3]
        p = attack(u_ini, y_ini, y_ref=y_ref)
        plans = [layer(u_ini, window, y_ref=y_ref).u for window in (y_ini, y_ini + p)]
        errors = [
            (SMALL["Q"] * (predict(u_ini, y_ini, plan) - y_ref).square().sum(-1)).mean().sqrt() for plan in plans
        ]
        torch.testing.assert_close(result.nominal[i], errors[0])
        torch.testing.assert_close(algorithm_1.increase[i], errors[1] / errors[0] - 1, rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(algorithm_1.input_change[i], (plans[1] - plans[0]).abs().max(), rtol=1e-6, atol=1e-9)
    assert algorithm_1.increase.median() > random.increase.median()
    assert (projected.increase >= algorithm_1.increase - 1e-9).all()
    assert result.skipped == 0
    assert random.unsolved == 0


def test_an_audit_takes_references_of_the_inputs(saved):
    layer, (u, y) = saved[0], recording(seed=4)
    y_ref, u_ref = torch.zeros(4, dtype=torch.float64), torch.full((2,), 0.4, dtype=torch.float64)
    with_it, without = (audit(layer, u, y, rhos=[0.05], windows=5, y_ref=y_ref, u_ref=r, seed=0) for r in (u_ref, None))
    assert not torch.allclose(with_it.nominal, without.nominal)
    window = u[:3], y[:3]
    plan = layer(*window, y_ref=y_ref, u_ref=u_ref).u
    away = (attacks.Predictor(layer.data)(*window, plan) - y_ref).square().sum(-1)
    torch.testing.assert_close(with_it.nominal[0], (SMALL["Q"] * away).mean().sqrt())


def test_an_audit_of_another_plants_recording_is_refused(saved):
    u, y = recording()
    with pytest.raises(ValueError, match="the layer has 2 inputs and 4 outputs, the recording 2 and 3"):
        audit(saved[0], u, y[:, :3], rhos=[0.1], windows=5, y_ref=torch.zeros(3), seed=0)


# --- as a process -----------------------------------------------------------------------------------------------------


def as_process(*arguments):
    command = [sys.executable, "-m", "torch_dpc", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_bad_input_ends_with_one_line_and_status_2(tmp_path):
    path = write_csv(tmp_path / "data.csv", *recording(steps=30))
    for arguments, message in (
        (("check", tmp_path / "none.csv", *NAMES, "--t-ini", 4, "--horizon", 10), "No such file"),
        (("check", path, "-u", "v9", "-y", "h1", "--t-ini", 4, "--horizon", 10), "v9"),
        (("check", path, *NAMES, "--t-ini", 4, "--horizon", 10), "at least (t_ini + horizon) / 0.25 = 56 samples"),
        (("audit", path, path, *NAMES, "--rho", "a"), "`--rho` must be numbers separated by commas, got 'a'"),
        (("audit", path, path, *NAMES, "--y-ref", "1,2"), "`--y-ref` must have 4 numbers, got 2"),
        (("audit", path, path, *NAMES, "--u-ref", "1"), "`--u-ref` must have 2 numbers, got 1"),
    ):
        done = as_process(*arguments)
        assert done.returncode == 2
        assert message in " ".join(done.stderr.split())
        assert "Traceback" not in done.stderr


def test_help_names_the_commands():
    done = as_process("--help")
    assert done.returncode == 0
    assert "check" in done.stdout
    assert "audit" in done.stdout


def test_without_typer_the_error_says_what_to_install():
    code = "import sys, runpy; sys.modules['typer'] = None; runpy.run_module('torch_dpc', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "pip install 'torch_dpc[cli]'" in done.stderr
