"""The benchmark: its reference against central differences, one tiny row through a process of its own, resuming."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")
pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")


from baselines import PEERS
from scripts import benchmark
from scripts.bench.cases import LOOP, Row, full_rows, inputs_of, layer_of, quick_rows, read_case, record, take
from scripts.bench.docs import refresh
from scripts.bench.higher_precision import HigherPrecision, eliminate, relative
from scripts.bench.report import write_report
from scripts.shared.command import ROOT

SMALL = {"plant": "masses", "horizon": 5, "n_g": 60}
STEP = 1e-6
CENTRAL = 1e-7  # relative: the plan is piecewise linear, so a central difference loses rounding / STEP alone
OURS = 1e-8  # relative, in float64
WIDE_ERROR = 1e-12  # relative: four digits beyond what the benchmark has to tell apart
WIDER = np.finfo(np.longdouble).eps < 1e-18  # some processors have no wider float


def small_problem():
    recording = record("masses", SMALL["n_g"] + 6 + SMALL["horizon"] - 1)
    layer = layer_of("masses", *recording, SMALL["horizon"])
    return layer, inputs_of("masses", layer, *recording, count=8)


def arrays(sample):
    return {name: value.numpy() for name, value in sample.items()}


def references(layer, inputs):
    exact = HigherPrecision(layer)
    found = [exact.solve(layer(**s).lam.numpy(), **arrays(s)) for s in (take(inputs, i) for i in range(8))]
    return [(i, reference) for i, reference in enumerate(found) if reference is not None]


# --- the reference ---------------------------------------------------------------------------------------------------


def test_the_references_gradient_is_that_of_central_differences():
    layer, inputs = small_problem()
    exact, found = HigherPrecision(layer), references(layer, inputs)
    assert len(found) >= 3
    for i, reference in found[:3]:
        sample = arrays(take(inputs, i))
        lam = layer(**take(inputs, i)).lam.numpy()
        slopes = np.zeros_like(reference.gradient)
        for place in np.ndindex(slopes.shape):
            sums = []
            for sign in (1, -1):
                y_ini = sample["y_ini"].copy()
                y_ini[place] += sign * STEP
                moved = exact.solve(lam, **{**sample, "y_ini": y_ini})
                sums.append(moved.v[: 2 * SMALL["horizon"]].sum())
            slopes[place] = (sums[0] - sums[1]) / (2 * STEP)
        assert relative(slopes, reference.gradient) < CENTRAL


def test_the_layer_agrees_with_the_reference():
    layer, inputs = small_problem()
    actives = []
    for i, reference in references(layer, inputs):
        sample = take(inputs, i)
        y_ini = sample["y_ini"].clone().requires_grad_()
        sol = layer(**{**sample, "y_ini": y_ini})
        sol.u.sum().backward()
        v = torch.cat([sol.u.flatten(), sol.y.flatten()]).detach().numpy()
        assert relative(v, reference.v) < OURS
        assert relative(y_ini.grad.numpy(), reference.gradient) < OURS
        actives.append(int(sol.info.n_active))
    assert max(actives) > 0


@pytest.mark.skipif(not WIDER, reason="this processor has no float wider than 64 bits")
def test_the_reference_is_more_precise_than_float64():
    layer, inputs = small_problem()
    for _, reference in references(layer, inputs):
        assert max(reference.error) < WIDE_ERROR


def test_a_wrong_active_set_has_no_reference():
    layer, inputs = small_problem()
    i, _ = references(layer, inputs)[0]
    lam = layer(**take(inputs, i)).lam.numpy().copy()
    exact = HigherPrecision(layer)
    assert exact.solve(np.zeros_like(lam), **arrays(take(inputs, i))) is None  # nothing held: bounds are violated
    assert exact.solve(-lam, **arrays(take(inputs, i))) is None  # held at the other bounds: wrong signs


def test_elimination_needs_pivoting_and_does_it():
    generator = np.random.default_rng(0)
    matrix, right = generator.standard_normal((20, 20)), generator.standard_normal((20, 2))
    matrix[0, 0] = 0.0
    matrix[3] *= 1e12
    np.testing.assert_allclose(eliminate(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-12)
    matrix[5] = matrix[6]
    assert eliminate(matrix, right) is None


# --- rows ------------------------------------------------------------------------------------------------------------


def test_a_row_is_measured_in_its_own_process_saved_and_not_measured_again(tmp_path, monkeypatch):
    rows = [Row("torch_dpc", **SMALL, batch=4), Row(LOOP, **SMALL, batch=4)]
    ours, loop = benchmark.run(rows, tmp_path, "quick", threads=1, inputs=20)
    for line in (ours, loop):
        assert line["status"] == "ok" and line["message"] == ""
        assert 0 < float(line["forward_q1"]) <= float(line["forward_ms"]) <= float(line["forward_q3"])
        assert float(line["solution_error"]) < OURS and int(line["checked"]) >= 1
        assert line["threads"] == "1" and "daqp" in line["versions"]
    assert float(ours["gradient_error"]) < OURS
    assert float(ours["both_ms"]) > float(ours["backward_ms"]) > 0
    assert ours["kkt_size"] == str(SMALL["horizon"] * 6)
    assert loop["gradient_error"] == "" and loop["both_ms"] == ""
    assert benchmark.read_lines(tmp_path / "benchmark.csv") == [ours, loop]

    def refuse(*_):
        raise AssertionError("a row was measured twice")

    monkeypatch.setattr(benchmark, "in_a_process", refuse)
    assert benchmark.run(rows, tmp_path, "quick", threads=1) == [ours, loop]
    with pytest.raises(AssertionError, match="measured twice"):
        benchmark.run(rows, tmp_path, "full", threads=1, inputs=20)  # a quick row does not stand for a full one
    with pytest.raises(AssertionError, match="measured twice"):
        benchmark.run(rows, tmp_path, "quick", threads=1, fresh=True, inputs=20)


def test_a_row_that_hangs_or_crashes_is_reported_as_that(tmp_path, monkeypatch):
    program = tmp_path / "peer.py"
    monkeypatch.setattr(benchmark, "PROGRAM", [str(program)])
    told = 'import time, os; print(\'noise\'); print(\'@row {"status": "ok", "setup_ms": 3.0}\', flush=True)\n'
    program.write_text(told + "time.sleep(60)")
    assert benchmark.in_a_process({"threads": 1}, limit=1.0) == {
        "status": "time limit",
        "setup_ms": 3.0,
        "message": "stopped after 1 s",
    }
    program.write_text(told + "os.kill(os.getpid(), 11)")
    found = benchmark.in_a_process({"threads": 1}, limit=20.0)
    assert found["status"] == "crashed" and found["message"] == "signal SIGSEGV" and found["setup_ms"] == 3.0


def test_a_batch_is_not_tried_where_a_smaller_one_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "in_a_process", lambda *_: {"status": "failed", "message": "no"})
    rows = [Row(LOOP, **SMALL), Row(LOOP, **SMALL, batch=64)]
    first, second = benchmark.run(rows, tmp_path, "quick", threads=1, inputs=4)
    assert first["status"] == "failed"
    assert second["status"] == "not run" and second["message"] == "failed at batch 1"


def test_every_row_names_a_solver_that_exists():
    rows = [*full_rows(PEERS), *quick_rows()]
    assert {row.name for row in rows} == {*benchmark.OURS, LOOP, *PEERS}


def test_a_case_comes_back_as_it_was_written(tmp_path):
    benchmark.write_case(tmp_path / "case.npz", *Row("torch_dpc", **SMALL).problem, count=6)
    (u, y), inputs, reference = read_case(tmp_path / "case.npz")
    assert len(u) == len(y) == SMALL["n_g"] + 6 + SMALL["horizon"] - 1
    assert inputs["u_ini"].shape == (6, 6, 2) and inputs["y_ref"].shape == (4,)
    layer = layer_of("masses", u, y, SMALL["horizon"])
    assert isinstance(layer, dpc.DPCLayer) and len(reference["checked"]) == len(reference["v"])


# --- the report ------------------------------------------------------------------------------------------------------


def line(name, **values):
    told = {"name": name, "plant": "masses", "horizon": 25, "n_g": 500, "batch": 1, "scaling": False, "status": "ok"}
    return benchmark._strings({**told, "seed": 0, "threads": 2, "mode": "full", **values})


def test_the_report_gives_ratios_to_the_fastest_peer_and_to_the_loop(tmp_path):
    lines = [
        line("torch_dpc", forward_ms=0.1, both_ms=0.2, gradient_error=1e-10),
        line(LOOP, forward_ms=0.05),
        line("QPLayer (reduced)", forward_ms=1.0, both_ms=1.8, gradient_error=1e-6, message="a | b"),
        line("cvxpylayers DIFFCP SCS lsqr (paper)", both_ms=9000.0, gradient_error=2.0),
        line("qpth (paper)", status="failed", message="P is not SPD"),
    ]
    table = write_report(tmp_path, lines)
    assert (
        "| masses | 25 | 1 | 0.1 | 100 | 0.05 | 0.5 | 0.2 | 200 | 1e-10 | QPLayer (reduced) | 1.8 | 9 | 1e-06 |"
        in table
    )
    assert "takes 45,000 times as long" in table
    text = (tmp_path / "benchmark.md").read_text()
    assert "failed: P is not SPD" in text and "a / b" in text
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000


def test_the_page_takes_every_measured_part_and_keeps_the_rest(tmp_path):
    page = tmp_path / "docs" / "benchmarks.md"
    (page.parent / "images").mkdir(parents=True)
    page.write_text((ROOT / "docs" / "benchmarks.md").read_text())
    (tmp_path / "benchmark.png").write_bytes(b"a picture")
    (tmp_path / "table1_sizes.md").write_text("# Table I\n\n| CVXPYlayers | 1799 |\n")
    (tmp_path / "profile.md").write_text("# Profile\n\nmade with\n\n## Batch 1\n\n| DAQP | 1.0 |\n")
    peer = line("QPLayer (reduced)", forward_ms=1.0, both_ms=1.7, gradient_error=1e-6)
    late = line(
        "cvxpylayers DIFFCP SCS dense (paper)", status="time limit", message="stopped after 60 s", forward_ms=9000.0
    )
    lines = [line("torch_dpc", forward_ms=0.1, both_ms=0.2), line(LOOP, forward_ms=0.05), peer, late]
    lines.append(line("torch_dpc", n_g=5000, scaling=True, setup_ms=100.0, forward_ms=0.1, ratio=1.01))
    for _ in range(2):  # and again, over its own words
        refresh(page, tmp_path, lines)
    text = page.read_text()
    for part in ("| CVXPYlayers | 1799 |", "### Batch 1", "| 5000 | 0.1 |", "time limit: stopped after 60 s"):
        assert text.count(part) >= 1, part
    assert "at batch 1 the best differentiable peer, QPLayer (reduced), takes 8.5 times as long" in text
    assert text.count("1799 term by term") == 1 and text.count("<!-- end -->") == 6
    assert (page.parent / "images" / "benchmark.png").read_bytes() == b"a picture"
    page.write_text(text.replace("measured: scaling", "measured: nothing"))
    with pytest.raises(ValueError, match="must mark .*scaling"):
        refresh(page, tmp_path, lines)
