"""What a run leaves: pieces of it, numbers, tables."""

import pickle

import pytest
import torch

import torch_dpc as dpc
from helpers import Y_REF, randn, small_layer
from torch_dpc import attacks


@pytest.fixture(scope="module")
def log():
    attack = attacks.RandomAttack(attacks.RelativeBall(0.1))
    source = torch.Generator().manual_seed(0)
    return dpc.simulate(
        dpc.systems.OscillatingMasses(), dpc.DPCController(small_layer(), 3), Y_REF, steps=9, attack=attack,
        reset={"state": 0.1 * randn(4, 4)}, generator=source,
    )  # fmt: skip


def test_runs_are_taken_by_index(log):
    assert len(log) == 4 and log.batch == (4,) and log.steps == 9
    one, some = log[2], log[1:3]
    assert torch.equal(one.y, log.y[2]) and torch.equal(one.p, log.p[2]) and one.t.shape == (9,) and one.batch == ()
    assert torch.equal(some.status, log.status[1:3]) and torch.equal(some[1].u, one.u)
    assert [run.y.shape for run in log] == [(9, 4)] * 4
    with pytest.raises(IndexError, match="this log is a single run"):
        one[0]
    with pytest.raises(TypeError, match="this log is a single run"):
        len(one)
    with pytest.raises(IndexError, match=r"the runs have shape \(4,\), got an index of 2"):
        log[0, 1]


def test_the_summary_is_that_of_the_numbers(log):
    summary = log.summary()
    for i in range(4):
        error = (log.y[i] - Y_REF).abs()
        assert torch.equal(summary.mean_error[i], error.mean(0)) and torch.equal(
            summary.largest_error[i], error.max(0)[0]
        )
        assert torch.equal(summary.last_error[i], error[-1]) and torch.equal(summary.u_max[i], log.u[i].max(0)[0])
        assert float(summary.largest_p[i]) == pytest.approx(max(float(p.norm()) for p in log.p[i]))
        assert torch.equal(log[i].summary().mean_error, summary.mean_error[i])
    assert not summary.unsolved.any()
    assert "median" in str(summary) and "mean_error[3]" in str(summary) and "value" in str(log[0].summary())


def test_a_run_without_plans_is_counted():
    layer = small_layer(0.0, y_set=dpc.Box(50.0, 60.0))
    log = dpc.simulate(dpc.systems.OscillatingMasses(), dpc.DPCController(layer, 3, on_failure="hold"), Y_REF, steps=6)
    assert float(log.summary().unsolved) == 1.0 and "100 % of the steps without a plan" in repr(log)


def test_it_says_what_it_is(log):
    assert repr(log).startswith("ClosedLoopLog((4,) runs, 9 steps of 0.1 s, n_u=2, n_y=4; mean |y - y_ref| 0.")
    assert repr(log[0]).startswith("ClosedLoopLog(9 steps of 0.1 s")
    assert "replan_every=3, on_failure='raise'" in repr(dpc.DPCController(small_layer(), 3))
    assert repr(dpc.systems.FourTanks()) == "FourTanks(n_x=4, n_u=2, n_y=2, dt=5 s)"


def test_it_pickles_moves_and_drops_its_graph():
    signal = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    log = dpc.simulate(
        dpc.systems.OscillatingMasses(), dpc.DPCController(small_layer(), 3), Y_REF, steps=4,
        attack=lambda u_ini, y_ini, **_: signal.expand_as(y_ini),
    )  # fmt: skip
    assert log.y.requires_grad and not log.detach().y.requires_grad and torch.equal(log.detach().u, log.u)
    again = pickle.loads(pickle.dumps(log.detach()))
    assert torch.equal(again.y, log.y) and torch.equal(again.status, log.status)
    single = log.to(torch.float32)
    assert single.y.dtype == single.t.dtype == torch.float32 and single.status.dtype == torch.int64


def test_tables_hold_one_row_a_step(log):
    pytest.importorskip("pandas", reason="tables need pandas (extra `pandas`)")
    table = log.to_pandas()
    assert list(table.columns) == [*("u0 u1 y0 y1 y2 y3 y_ref0 y_ref1 y_ref2 y_ref3 p status".split())]
    assert table.index.names == ["run", "t"] and len(table) == 36
    assert table.loc[2]["y3"].to_list() == log.y[2, :, 3].tolist()
    assert table.loc[1]["p"].iloc[0] == pytest.approx(float(log.p[1, 0].norm()))
    assert log[2].to_pandas().equals(table.loc[2])
