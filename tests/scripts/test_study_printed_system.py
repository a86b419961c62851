"""The printed system: right settings give the layer's gradient, default cut-offs do not."""

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

from scripts import study_printed_system as study
from scripts.experiments.masses import Masses
from torch_dpc import attacks


def test_the_attack_of_the_layers_gradient_is_algorithm_1():
    case = Masses()
    layer, budget = case.planner(0), attacks.RelativeBall(0.1)
    window = {"u_ini": torch.ones(6, 2).double(), "y_ini": torch.tensor([[1.0, 0.9, 0.1, 0.0]]).double().expand(6, -1)}
    y_ref, u_ref = case.references(25)
    call = {**window, "y_ref": y_ref, "u_ref": u_ref, "step": 30}
    ours = study.GradientAttack(layer, case.target(), budget)(**call)
    torch.testing.assert_close(ours, attacks.LinearizedAttack(layer, case.target(), budget)(**call))


@pytest.mark.slow
def test_a_default_cut_off_loses_much_of_the_attack_on_the_masses(monkeypatch):
    monkeypatch.setattr(study, "WINDOWS", (60,))
    methods = (study.SCALED, study.GELSY, "torch.linalg.solve")
    scaled, gelsy, solved = study.judge_windows("masses", 6000, methods)
    assert scaled["share"] == pytest.approx(1, abs=1e-6) and solved["share"] == pytest.approx(1, abs=1e-3)
    assert gelsy["share"] < 0.5 and gelsy["cosine"] < 0.5
