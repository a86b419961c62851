"""The study of plants: its linearised model is the plant's Jacobian, and a stopped run goes on."""

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

import torch_dpc as dpc
from scripts import study_plants
from scripts.experiments import plants

SMALL = 1e-5  # of the recorded input: the plant is linear to about this
LINEAR = 1e-3  # relative to the largest deviation


@pytest.mark.parametrize("name", plants.CASES)
def test_the_linearised_model_answers_like_the_plant_to_small_inputs(name):
    if name == "quadrotor":
        pytest.importorskip("pybullet", reason="the quadrotor needs PyBullet: pip install '.[quadrotor]'")
    case = plants.CASES[name]()
    plant, model = case.make(0 * case.noise, plants.generator_of(0)), case.model()
    u, answer = dpc.collect(model, 40, generator=plants.generator_of(1), amplitude=SMALL * case.amplitude)
    y = [plant.reset(**case.starts(0 * case.spread))]
    y += [plant.step(case.u0 + step) for step in u[:-1]]
    moved = torch.stack(y) - case.y0
    assert float(moved.abs().max()) > 0
    assert float((answer - moved).abs().max() / moved.abs().max()) < LINEAR


@pytest.mark.parametrize("name", plants.CASES)
def test_the_recording_of_the_model_is_that_of_a_linear_system(name):
    case = plants.CASES[name]()
    data = case.data_of_model(0)
    assert data.with_ones.row_space.clear and data.with_ones.rank < len(data.with_ones.stacked)
    assert data.rank <= (case.t_ini + case.horizon) * data.n_u + case.model().n_x + 1


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
