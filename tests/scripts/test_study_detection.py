"""The study of detectors: its noisy plant, its ROC, what a run tells a monitor, and a small run."""

import pytest
import torch

for package in ("matplotlib", "tqdm", "joblib"):
    pytest.importorskip(package, reason=f"the script needs {package}: pip install '.[scripts]'")

import torch_dpc as dpc
from scripts import study_detection
from scripts.defence import detection
from scripts.defence.noisy import Noisy
from torch_dpc import attacks


def test_noise_is_on_the_measurements_alone():
    plant = dpc.systems.OscillatingMasses()
    noisy = Noisy(dpc.systems.OscillatingMasses(), torch.tensor([0.1, 0.0, 0.2, 0.0]))
    state = torch.tensor([0.3, -0.1, 0.0, 0.2]).double()
    measured, true = [noisy.reset(state=state)], [plant.reset(state)]
    for _ in range(400):
        measured.append(noisy.step(torch.ones(2).double()))
        true.append(plant.step(torch.ones(2).double()))
    assert torch.equal(torch.stack(noisy.truth), torch.stack(true))
    noise = torch.stack(measured) - torch.stack(true)
    assert (noise[:, [1, 3]] == 0).all() and 0.09 < noise[:, 0].std() < 0.11 and 0.18 < noise[:, 2].std() < 0.22


def test_detection_at_a_share_of_false_alarms_by_hand():
    clean = torch.arange(1000.0)  # 5 % of them exceed 949
    attacked = torch.tensor([948.0, 949.5, 2000.0, -1.0])
    seen = dict(zip(detection.GRID, detection.detection(attacked, clean), strict=True))
    assert seen[0.05] == 0.5 and seen[0.001] == 0.25 and seen[1.0] == 1.0


@pytest.fixture(scope="module")
def setting():
    case = detection.CASES["masses"]
    with case.system() as system:
        yield detection.Setting(case, system, 1e-3, 0)


def test_a_monitor_sees_the_windows_that_the_controller_plans_from(setting):
    seen = []

    class Spy(attacks.RandomAttack):
        def _perturb(self, call):
            p = super()._perturb(call)
            seen.append((call.u_ini, call.y_ini, p))
            return p

    run = setting.run(5, Spy(attacks.RelativeBallBudget(0.05)))
    assert len(run.u_ini) == len(seen) - 1  # the first window is that of the warm-up
    for (u_ini, y_ini, p), u, y, clean in zip(seen[1:], run.u_ini, run.y_ini, run.clean, strict=True):
        assert torch.equal(u, u_ini) and torch.equal(clean, y_ini)
        torch.testing.assert_close(y, y_ini + p)


def test_a_stealthy_attack_raises_no_alarm_and_the_error_is_that_of_the_truth(setting):
    usual = [setting.run(20_000 + i, every=1) for i in range(4)]
    detector = detection.calibrated(setting.data, usual, 0.05)
    budget = attacks.RelativeBallBudget(0.1)
    cost = setting.case.target()
    plain = setting.run(0, attacks.LinearizedAttack(setting.layer, cost, budget))
    quiet = setting.run(0, attacks.LinearizedAttack(setting.layer, cost, attacks.StealthyBudget(budget, detector)))
    rows = {
        name: detection.loop_rows(name, 0.1, None, run, {0.05: detector})[0]
        for name, run in (("plain", plain), ("quiet", quiet))
    }
    assert rows["quiet"]["raised"] == 0 < rows["plain"]["raised"]
    still = setting.run(0)
    assert still.error < quiet.error


@pytest.mark.slow
def test_a_small_run_leaves_its_files_and_is_not_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr(detection, "NOISES", (0.0,))
    monkeypatch.setattr(study_detection, "NOISES", (0.0,))
    monkeypatch.setattr(study_detection, "QUICK_RUNS", {"masses": (3, 2)})
    arguments = ["--quick", "--plants", "masses", "--workers", "1", "--out", str(tmp_path)]
    study_detection.main(arguments)
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
    assert (
        "Windows that alarm under the stealthy attack and not without it: 0 of"
        in (tmp_path / "study_detection_quick.md").read_text()
    )
    study_detection.main(arguments)
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
    for name in ("roc", "damage"):
        assert (tmp_path / f"study_detection_quick_{name}.png").stat().st_size > 10_000
