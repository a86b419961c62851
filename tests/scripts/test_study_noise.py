"""What explains the protection by noise: the sensitivity, the ridge that stands for noise, and a small run."""

import numpy as np
import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

from scripts import study_noise
from scripts.experiments.masses import Masses
from scripts.experiments.sensitivity import plan_gain, unexplained, with_noise

MANY = 400  # draws of the noise that is averaged
NEAR = 0.05  # relative: an entry of the mean of MANY noisy Gram matrices against what the ridge adds


def recording(seed=0, samples=150):
    case = Masses()
    with case.system() as plant:
        return case, *case.record(plant, seed, samples)


def test_the_gain_is_that_of_the_worst_perturbation():
    case, u, y = recording()
    layer = case.layer(case.hankel(u, y))
    far = {"u_ref": torch.zeros(2).double(), "y_ref": torch.zeros(4).double()}
    u_ini, y_ini = torch.zeros(6, 2).double(), torch.zeros(6, 4).double()  # at rest: no bound is near
    jacobian = torch.autograd.functional.jacobian(lambda y: layer(u_ini, y, **far).u.flatten(), y_ini).reshape(50, 24)
    worst = torch.linalg.svd(jacobian).Vh[0].reshape(6, 4)
    moved = layer(u_ini, 1e-3 * worst, **far).u - layer(u_ini, y_ini, **far).u
    assert plan_gain(layer) == pytest.approx(float(moved.norm()) / 1e-3, rel=1e-8)


def test_the_ridge_adds_what_noise_adds_on_average():
    case, u, y = recording()
    clean, size = case.hankel(u, y), 1.0

    def gram(data):
        D = torch.cat([data.Up, data.Yp, data.Uf, data.Yf])
        return D @ D.mT

    added = gram(case.hankel(u, y, ridge=size)) - gram(clean)
    expected = torch.zeros(len(added), dtype=torch.float64)
    expected[12:36] = clean.n_g * (size * y.std(0)).square().repeat(6)  # Yp, after 6 x 2 rows of Up
    torch.testing.assert_close(added, torch.diag(expected), rtol=1e-12, atol=1e-9)
    noisy = sum(gram(case.hankel(u, with_noise(y, size, seed))) for seed in range(MANY)) / MANY - gram(clean)
    noise_on_past = noisy[12:36, 12:36] / expected[12:36].sqrt().outer(expected[12:36].sqrt())
    assert float((noise_on_past - torch.eye(24)).abs().max()) < NEAR


def test_a_ridge_predicts_the_gain_of_noisy_recordings():
    case, u, y = recording(samples=None)  # the paper's 500 windows: with few of them the predictor fits the noise
    found = [plan_gain(case.layer(case.hankel(u, with_noise(y, 0.1, seed)))) for seed in range(20)]
    assert plan_gain(case.layer(case.hankel(u, y, ridge=0.1))) == pytest.approx(np.mean(found), rel=0.05)


def test_the_masses_have_as_many_directions_as_states():
    case, u, y = recording()
    sizes = unexplained(case.hankel(u, y), y)
    assert sizes[3] > 0.1 and sizes[4] < 1e-12


@pytest.mark.slow
def test_a_small_run_leaves_its_files_and_is_not_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr(study_noise, "CASES", {"masses": study_noise.CASES["masses"]})
    monkeypatch.setattr(study_noise, "CLOSED", {"noise": (1e-2,), "ridge": (1e-2,), "lambda_s": (1e4,)})
    arguments = ["--quick", "--workers", "1", "--out", str(tmp_path)]
    study_noise.main(arguments)
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
    assert "| ridge on clean data | 0.01 |" in (tmp_path / "study_noise.md").read_text()
    study_noise.main(arguments)
    assert (tmp_path / "study_noise.png").stat().st_size > 10_000
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
