"""The regression guard of the benchmark: what it measures, and that it tells growth from noise."""

import json

import pytest
import torch

import torch_dpc as dpc
from scripts.bench import check as check_module
from scripts.bench import ratios


def test_a_ratio_that_has_grown_is_named(tmp_path, monkeypatch, capsys):
    stored = tmp_path / "ratios.json"
    stored.write_text(json.dumps({"a": 1.0, "b": 1.0, "c": 1.0}))
    rounds = iter([{"a": 1.4, "b": 1.6, "c": 9.0}, {"a": 1.0, "b": 1.2, "c": 8.0}])
    monkeypatch.setattr(check_module, "guarded", lambda: next(rounds))
    assert check_module.check(stored) == ["c"]  # b was a burst of other work
    said = capsys.readouterr().out
    assert "c: 8.00, stored 1.00: more than" in said and "b: 1.20, stored 1.00: fine" in said


def test_the_stored_ratios_are_those_that_are_measured(monkeypatch):
    monkeypatch.setattr(ratios, "milliseconds", lambda calls: dict.fromkeys(calls, 1.0))
    assert ratios.guarded().keys() == json.loads(check_module.STORED.read_text()).keys()


def test_the_no_op_has_the_shapes_of_a_plan():
    y_ini = torch.zeros(3, 4, dtype=torch.float64, requires_grad=True)
    out = ratios.NoOp.apply(y_ini.detach(), y_ini, None, None, ((6, 2), (6, 4), (36,), (36,), (5,)))
    assert [x.shape for x in out] == [(6, 2), (6, 4), (36,), (36,), (5,)] and not out[4].requires_grad
    out[0].sum().backward()
    assert y_ini.grad.shape == y_ini.shape


def test_times_are_medians_of_every_call():
    calls = []
    times = ratios.milliseconds({"a": calls.append, "b": lambda i: sum(range(2000))})
    assert times["b"] > times["a"] >= 0 and len(calls) >= ratios.BLOCKS * ratios.WARM


def test_the_ball_beside_cvxpylayers():
    pytest.importorskip("cvxpylayers")
    from scripts.bench.ball import RADIUS, ConicPeer

    layer, inputs = ratios.case("masses", 2)
    problem = ratios.take(inputs, 0)
    ball = ratios.with_sets(layer, u_set=dpc.Ball(RADIUS))
    u = ConicPeer(layer, "DIFFCP", {"solve_method": "Clarabel"})(**problem).u
    assert torch.allclose(u, ball(**problem).u, atol=1e-6)
