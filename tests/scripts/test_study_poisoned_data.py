"""The study of poisoned recordings: its judge, and a small run."""

import math

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

from scripts import study_poisoned_data
from scripts.defence import poison


def test_the_error_of_a_plan_is_that_of_the_plant():
    """Noise-free recordings of a linear plant predict what it truly does."""
    case = poison.CASES["masses"]
    with case.system() as plant:
        judge = poison.judge(case, plant, 7)
        u, y = case.record(plant, 0)
        layer = case.layer(case.hankel(u, y))
        squares = []
        plans = layer(judge.u_ini, judge.y_ini, **judge.refs).u
        for u_ini, y_ini, inputs in zip(judge.u_ini, judge.y_ini, plans, strict=True):
            plant.reset(state=y_ini[-1])
            outputs = [plant.step(u_ini[-1])]
            outputs += [plant.step(one) for one in inputs[:-1]]
            off = torch.stack(outputs) - judge.refs["y_ref"]
            squares.append(float(off[:, case.channels].square().sum()))
    expected = math.sqrt(sum(squares) / len(squares) / case.horizon)
    assert judge.error(layer) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_a_small_run_leaves_its_files_and_is_not_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr(study_poisoned_data, "QUICK_COUNTS", (5,))
    arguments = ["--quick", "--plants", "masses", "--workers", "1", "--out", str(tmp_path)]
    study_poisoned_data.main(arguments)
    before = (tmp_path / "study_poisoned_data_quick.csv").read_bytes()
    assert "| greedy samples | 5 |" in (tmp_path / "study_poisoned_data_quick.md").read_text()
    study_poisoned_data.main(arguments)
    assert (tmp_path / "study_poisoned_data_quick.csv").read_bytes() == before
    assert (tmp_path / "study_poisoned_data_quick.png").stat().st_size > 10_000
