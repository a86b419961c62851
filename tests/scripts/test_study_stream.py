"""The study of streams: its plants, its measurements in small, and a controller whose plant changes."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")
pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")
pytest.importorskip("safetensors", reason="saving needs safetensors")


from scripts import study_stream
from scripts.experiments import stream_adaptation as adaptation


@pytest.mark.parametrize(("name", "order", "n_u"), [("masses", 4, 2), ("quadrotor", 12, 3)])
def test_a_recording_is_one_trajectory_across_its_chunks(name, order, n_u, monkeypatch):
    monkeypatch.setattr(study_stream, "NOISE", 0.0)
    monkeypatch.setattr(study_stream, "CHUNK", 70)
    data = dpc.HankelData.from_stream(study_stream.recorder(name, 900), t_ini=6, horizon=10)
    assert data.n_windows == 900 - 15
    assert data.rank == order + 16 * n_u  # a seam that breaks the trajectory would add to it
    assert data.row_space.clear


def test_the_rounding_it_reports_is_that_of_the_factor():
    row = study_stream.stream("masses", 3000)
    assert row["windows"] == 2970
    assert 0 < row["rounding of row norms"] < 1e-13


def test_updates_and_files_are_measured():
    row = study_stream.updates("masses", 20)
    assert row["rows"] == 186 and 0 < row["update [ms]"] < row["reduction [ms]"]
    row = study_stream.files("masses", 500)
    assert row["compact, change of u"] == 0 and row["compact [kB]"] < row["with windows [kB]"]


def test_an_updated_controller_regains_tracking_when_the_plant_changes(monkeypatch):
    """The springs double at step 200: the input that holds the masses at 0.5 m is another."""
    monkeypatch.setattr(adaptation, "STEPS", 600)
    fixed, updated = (np.array(adaptation.track(forgetting)) for forgetting in (0.0, 0.95))
    assert fixed[100:200].mean() < 0.01 and updated[100:200].mean() < 0.01  # the noise and the dither alone
    assert fixed[-200:].mean() > 0.2
    assert updated[-200:].mean() < 0.01


def test_a_stopped_run_goes_on_where_it_was(tmp_path, monkeypatch):
    asked = []

    def measured(function, given):
        asked.append(given)
        if function is study_stream.adaptation:
            return {f"error {k}": 0.1 + k for k in range(adaptation.STEPS)}
        return {"windows": 970.0 + len(asked)}

    monkeypatch.setattr(study_stream, "in_a_process", measured)
    study_stream.main(["--out", str(tmp_path), "--quick"])
    first, report = list(asked), (tmp_path / "stream.md").read_text()
    assert ("masses", 100_000) in first and "| masses | 971 |" in report and "| fixed |" in report
    assert (tmp_path / "stream_adaptation.png").stat().st_size > 10_000
    lines = (tmp_path / "stream.csv").read_text().splitlines(keepends=True)
    (tmp_path / "stream.csv").write_text("".join(lines[:4]))  # three rows were made before it was stopped
    study_stream.main(["--out", str(tmp_path), "--quick"])
    assert asked == first + first[3:]
    study_stream.main(["--out", str(tmp_path), "--quick", "--fresh"])
    assert asked == first + first[3:] + first


def test_the_plants_are_stable():
    for name in ("masses", "quadrotor"):
        A, _, C = study_stream.plant(name)
        assert np.abs(np.linalg.eigvals(A)).max() < 1
        assert torch.linalg.matrix_rank(torch.from_numpy(np.vstack([C, C @ A, C @ A @ A]))) == len(A)
