"""The studies of attacks: small runs, and what they claim about them."""

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")
pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")


from scripts import study_attacks, study_transfer
from scripts.experiments import surrogates
from scripts.shared.rows import read_rows

FEW = {
    "everything": {},
    "other recording, 1 % noise": {"other": True, "noise": 1e-2},
    "all of it off": surrogates.SURROGATES["all of it off"],
}


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_surrogates_differ_from_the_controller_in_what_they_say():
    plant = surrogates.load("masses", 0, 100)
    victim = surrogates.surrogate(plant)
    other = surrogates.surrogate(plant, other=True)
    assert torch.equal(victim.data.Up, surrogates.surrogate(plant, lambda_s=10.0).data.Up)
    assert not torch.equal(victim.data.Up, other.data.Up) and other.data.rank == victim.data.rank
    assert surrogates.surrogate(plant, lambda_s=10.0, lambda_g=0.1, Q=2.0).lambda_s == 1e7
    assert surrogates.surrogate(plant, n_g=150).data.n_g == 150
    short = surrogates.surrogate(plant, t_ini=4, horizon=10).data
    assert (short.t_ini, short.horizon) == (4, 10)
    noisy = surrogates.surrogate(plant, noise=0.1).data.Yp
    spread = plant.own[1].std(0).repeat(6)
    assert torch.allclose((noisy - victim.data.Yp).std(1) / spread, torch.tensor(0.1).double(), rtol=0.15)
    u_held, y_held = plant.windows
    assert u_held.shape == (6, 6, 2) and y_held.shape == (6, 6, 4)
    assert not any(torch.equal(y_held[0], recording[1][:6]) for recording in (plant.own, plant.other))


@pytest.mark.slow
def test_transfer_on_the_masses(tmp_path, monkeypatch):
    monkeypatch.setattr(study_transfer, "SURROGATES", FEW)
    monkeypatch.setattr(study_transfer, "SEARCHES", (5, 50))
    monkeypatch.setattr(study_transfer, "PLANTS", ("masses", "masses"))  # the picture has two panels
    study_transfer.main(["--quick", "--workers", "1", "--out", str(tmp_path)])
    rows = read_rows(tmp_path / "transfer.csv")

    def share(knows, method, column="decrease"):
        return study_transfer.share(rows, "masses", knows, method, column).value / 100

    assert share("everything", "Algorithm 1") == share("everything", "Algorithm 1", "error") == 1.0
    assert share("everything", "projected gradient") > 1.0
    assert 0.5 < share("all of it off", "Algorithm 1") < 1.0
    assert abs(share("differences of every entry", "differences") - 1) < 1e-3
    asked = study_transfer.pick(rows, "masses", "differences of every entry", "differences", "queries")
    assert (asked == 1 + 2 * 24 + 1).all()
    assert share("random search, 5 queries", "search") < share("random search, 50 queries", "search") < 1.05
    assert abs(share("nothing: random noise", "nothing: random noise")) < 0.2
    text = (tmp_path / "transfer.md").read_text()
    assert "| everything | 0 | 1.00 | 100 % (100 to 100) |" in text
    assert (tmp_path / "transfer.png").stat().st_size > 10_000


@pytest.mark.slow
def test_attacks_on_the_masses_are_never_worse_than_algorithm_1(tmp_path, monkeypatch):
    monkeypatch.setattr(study_attacks, "PLANTS", {"masses": "Oscillating masses"})
    few = {name: study_attacks.BUDGETS[name] for name in ("Euclidean ball, rho", "2 sensors, rho")}
    monkeypatch.setattr(study_attacks, "BUDGETS", few)
    monkeypatch.setattr(study_attacks, "IN_LOOP", (study_attacks.FIRST, "5 restarts"))
    study_attacks.main(["--quick", "--workers", "1", "--out", str(tmp_path)])
    rows = read_rows(tmp_path / "attacks.csv")
    assert len(rows["attack"]) == study_attacks.QUICK_SEEDS * 2 * len(few) * len(study_attacks.ATTACKS)
    assert rows["worst"].max() < 1e-9 and rows["outside"].max() < 1e-9 and rows["unsolved"].sum() == 0
    first = rows["attack"] == study_attacks.FIRST
    decrease = rows["decrease"].reshape(-1, len(study_attacks.ATTACKS))
    np.testing.assert_array_equal(decrease[:, 0], rows["decrease"][first])
    assert (decrease[:, 1:] > decrease[:, :1] * (1 - 1e-9)).all() and (decrease[:, 1] > 1.001 * decrease[:, 0]).any()
    assert "| target input | Euclidean ball, rho |" in (tmp_path / "attacks.md").read_text()

    runs = read_rows(tmp_path / "attacks_closed_loop.csv")
    error = dict(zip(zip(runs["cost"], runs["attack"], strict=True), runs["error"], strict=True))
    assert error["-", "no attack"] < 1e-9 and error["tracking error", study_attacks.FIRST] < 1e-9
    assert error["-", "random noise"] < error["target input", study_attacks.FIRST]
    assert error["tracking error", "5 restarts"] > 2 * error["target input", study_attacks.FIRST]
