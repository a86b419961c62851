"""The study of robust plans: its table, and that a finished job is not repeated."""

import pytest

for package in ("matplotlib", "tqdm", "joblib", "cvxpy", "clarabel"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts,baselines]'")

from scripts import study_robust


def test_the_table_has_every_controller_and_a_finished_job_is_not_repeated(tmp_path, monkeypatch):
    calls = []

    def run(plant, seed, controller):
        calls.append((plant, seed, controller))
        row = {"plant": plant, "seed": seed, "controller": controller, "largest": 1.0, "unsolved": 0}
        error = 0.1 + 0.01 * seed + 0.001 * len(controller)
        return [{**row, "attack": attack, "error": error} for attack in study_robust.ATTACKS]

    monkeypatch.setattr(study_robust, "run", run)
    arguments = ["--seeds", "2", "--workers", "1", "--out", str(tmp_path)]
    study_robust.main(arguments)
    assert len(calls) == 2 * (2 + len(study_robust.SHARES))
    study_robust.main(arguments)
    assert len(calls) == 2 * (2 + len(study_robust.SHARES))
    text = (tmp_path / "study_robust.md").read_text()
    assert "## Masses on a sinusoid, rho 10 %" in text and "| robust, 0.1 rho | 0.1200, +0.0040" in text


@pytest.mark.slow
def test_robust_plans_run_in_closed_loop():
    rows = study_robust.run("masses", 0, "robust, 1 rho")
    assert [row["attack"] for row in rows] == list(study_robust.ATTACKS)
    assert all(0 < row["error"] < 0.1 and row["unsolved"] == 0 for row in rows)
