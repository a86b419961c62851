"""What the package logs under "torch_dpc": decisions and failures, and nothing where all goes well."""

import logging
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

import torch_dpc as dpc
from helpers import small_data, small_layer
from torch_dpc.data.row_space import RowSpace

CPU = torch.device("cpu")


@pytest.fixture
def log(caplog):
    caplog.set_level(logging.DEBUG, logger="torch_dpc")
    return caplog


def window(layer, value=0.1):
    data = layer.data
    return torch.zeros(data.t_ini, data.n_u), torch.full((data.t_ini, data.n_y), value)


def of(log, name):
    return [record for record in log.records if record.name == name]


def test_a_rank_decision_is_told_once(log):
    data = small_data(noise=0.0, seed=1234)  # of no other test: its rank is decided here
    assert data.rank == data.row_space.rank
    (record,) = of(log, "torch_dpc.data.row_space")
    assert record.levelno == logging.INFO
    assert f"rank {data.rank} of {data.row_space.n_rows} rows" in record.getMessage()


def test_a_rank_without_a_clear_gap_is_a_warning(log):
    data = small_data(noise=1e-2)
    singular = torch.linalg.svdvals(data.stacked / data.row_space.units[:, None])
    in_the_noise = float(singular[-3] / singular[0])
    log.clear()
    space = RowSpace.of(data.matrices, data.n_u, data.n_y, n_windows=data.n_windows, tolerance=in_the_noise)
    assert space.rank < space.n_rows and not space.clear
    (record,) = of(log, "torch_dpc.data.row_space")
    assert record.levelno == logging.WARNING and "no clear gap" in record.getMessage()


def test_a_second_engine_is_told(log):
    """Newton in torch does not converge in one step from a far window, and DAQP solves what it leaves."""
    layer = small_layer(solver="newton")
    solver = layer.factored(CPU).solver
    engines = solver.in_units.engines
    found = engines.newton
    lost = lambda v0, *rest: replace(found(v0, *rest), lam=torch.full_like(v0, torch.nan))  # noqa: E731
    object.__setattr__(engines, "newton", lost)
    object.__setattr__(solver, "compiled", None)
    object.__setattr__(solver, "single", None)
    u_ini, y_ini = window(layer)
    plan = layer(u_ini.expand(4, -1, -1), y_ini)
    assert (plan.info.status == dpc.Status.SOLVED).all()
    (record,) = of(log, "torch_dpc.solve")
    assert record.getMessage() == "newton left 4 of 4 samples, daqp solves them"


def infeasible(**options):
    """A layer whose positions and velocities must all be 10 to 11: no motion has both."""
    return small_layer(noise=0.0, y_set=dpc.Box(10.0, 11.0), **options)


def test_marked_failures_are_told(log):
    layer = infeasible(on_failure="nan")
    u_ini, y_ini = window(layer)
    plans = layer(u_ini.expand(2, -1, -1), y_ini)
    assert plans.info.status.tolist() == [dpc.Status.INFEASIBLE] * 2
    messages = [record.getMessage() for record in of(log, "torch_dpc.solve")]
    assert "no plan for 2 samples: 2 proven infeasible, 0 failed" in messages


@pytest.mark.parametrize(("answer", "said"), [("hold", "the previous one is held"), ("soften", "softened by up to")])
def test_what_a_controller_does_without_a_plan_is_a_warning(log, answer, said):
    controller = dpc.DPCController(infeasible(), 2, on_failure=answer)
    u_ini, y_ini = window(controller.layer)
    controller.step(u_ini, y_ini)
    (record,) = of(log, "torch_dpc.control.controller")
    assert record.levelno == logging.WARNING and said in record.getMessage()


def test_a_held_plan_after_an_alarm_is_a_warning(log):
    controller = dpc.DPCController(small_layer(), 2, on_alarm="hold")
    controller.step(*window(controller.layer), alarm=torch.tensor(True))
    (record,) = of(log, "torch_dpc.control.controller")
    assert record.levelno == logging.WARNING and "mistrusts" in record.getMessage()


def test_a_plan_of_one_window_does_not_ask_the_loggers(monkeypatch):
    """Where all goes well, logging costs nothing: not even the question whether it is wanted."""
    layer = small_layer()
    u_ini, y_ini = window(layer)
    layer(u_ini, y_ini)
    asked = []
    for method in ("isEnabledFor", "debug", "info", "warning", "log"):
        monkeypatch.setattr(logging.Logger, method, lambda self, *args: asked.append((self.name, args)))
    layer(u_ini, y_ini)
    assert not [name for name, _ in asked if name.startswith("torch_dpc")]


def test_nothing_is_printed_unless_asked_for():
    code = (
        "import logging, torch, torch_dpc as dpc\n"
        "logging.getLogger('torch_dpc').warning('a warning')\n"
        "u = torch.rand(60, 1, generator=torch.Generator().manual_seed(0))\n"
        "print(dpc.HankelData.from_trajectories(u, u.cumsum(0), t_ini=2, horizon=5).rank)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stderr == "" and done.stdout.strip().isdigit()
