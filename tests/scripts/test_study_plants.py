"""The study of plants: its linearised model is the plant's Jacobian, and a stopped run goes on."""

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

from scripts import study_plants
from scripts.experiments import plants

LINEAR = 1e-6  # relative to the largest deviation


def test_the_linearised_recording_follows_the_jacobian_of_the_plant():
    case = plants.cart_pole()
    data = case.data(0, plants.SMALL)
    plant = case.make(0 * case.noise, None)
    x = torch.cat([case.y0, case.u0]).requires_grad_()
    jacobian = torch.autograd.functional.jacobian(lambda v: plant._advance(v[:4], v[4:]), x)
    u, y = data.Uf.reshape(case.horizon, 1, -1), data.Yf.reshape(case.horizon, 4, -1)
    predicted = torch.einsum("ij,tjn->tin", jacobian, torch.cat([y, u], dim=1))[:-1]
    assert float((predicted - y[1:]).abs().max() / y.abs().max()) < LINEAR
    real = case.data(0)
    assert not torch.allclose(real.Yf, data.Yf, rtol=0.05)


def test_a_run_leaves_its_table_and_goes_on_where_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(study_plants, "CASES", {"cart_pole": plants.cart_pole})
    study_plants.main(["--seeds", "1", "--workers", "1", "--out", str(tmp_path)])
    first = (tmp_path / "study_plants.csv").read_text()
    assert len(first.splitlines()) == 5 and (tmp_path / "study_plants.png").exists()
    monkeypatch.setattr(study_plants, "attempt", lambda *job: pytest.fail("it runs again"))
    study_plants.main(["--seeds", "1", "--workers", "1", "--out", str(tmp_path)])
    assert (tmp_path / "study_plants.csv").read_text() == first
    rows = {line.split(",")[2]: line.split(",") for line in first.splitlines()[1:]}
    assert rows["nearest"][5] == rows["model"][5] == "0" and rows["paper"][5] == rows["affine"][5] == "1"  # lost
    assert "| cart-pole | nearest windows |" in (tmp_path / "study_plants.md").read_text()
