"""Data that leave nothing to decide, or nothing at all: a plan or a clear status, never an exception of LAPACK."""

import pytest
import torch

import torch_dpc as dpc
from helpers import randn

WEIGHTS = {"Q": 1.0, "R": 0.1, "lambda_g": 1.0, "lambda_s": 1e3}


def data_of(u, y, t_ini=3, horizon=2):
    with pytest.warns(dpc.ExcitationWarning):
        return dpc.HankelData.from_trajectories(u, y, t_ini=t_ini, horizon=horizon)


@pytest.mark.parametrize(
    "sets", [{}, {"u_set": dpc.Box(-9.0, 9.0)}, {"u_set": dpc.Ball(9.0), "y_set": dpc.SoftBox(-1.0, 1.0, 2.0)}]
)
def test_u_ini_decides_everything(sets):
    """Two windows for three past inputs: no direction is left, and the triangle of the cost is empty."""
    u, y = randn(6, 1, seed=1), randn(6, 1, seed=2)
    layer = dpc.DPCLayer(data_of(u, y), **WEIGHTS, **sets, on_failure="nan")
    sol = layer(u[:3], y[:3])
    assert int(sol.info.status) == dpc.Status.SOLVED
    torch.testing.assert_close(sol.u, u[3:5], rtol=0, atol=1e-12)
    torch.testing.assert_close(sol.y, y[3:5], rtol=0, atol=1e-12)
    other = layer(randn(3, 1, seed=7), y[:3])
    assert int(other.info.status) == dpc.Status.INFEASIBLE


@pytest.mark.parametrize("sets", [{}, {"u_set": dpc.Ball(1.0)}])
def test_all_zero_data(sets):
    zero = torch.zeros(12, 1, dtype=torch.float64)
    layer = dpc.DPCLayer(data_of(zero, zero), **WEIGHTS, **sets, on_failure="nan")
    at_rest = layer(torch.zeros(3, 1).double(), torch.zeros(3, 1).double())
    assert int(at_rest.info.status) == dpc.Status.SOLVED and not at_rest.u.any() and not at_rest.y.any()
    assert int(layer(torch.ones(3, 1).double(), torch.zeros(3, 1).double()).info.status) == dpc.Status.INFEASIBLE


def test_the_only_input_is_idle():
    y = 0.5 ** torch.arange(12.0, dtype=torch.float64)[:, None]
    layer = dpc.DPCLayer(data_of(torch.zeros_like(y), y), **WEIGHTS, on_failure="nan")
    sol = layer(torch.zeros(3, 1).double(), y[:3])
    torch.testing.assert_close(sol.y, y[3:5], rtol=0, atol=1e-5)  # Q pulls a little against lambda_s


@pytest.mark.parametrize("R", [0.0, 1e-8])
def test_two_inputs_on_one_lag(R):
    """Half and more of these failed: the cost has a kernel (R = 0), or nearly one."""
    u = 2 * torch.rand(80, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1
    y = torch.zeros(80, 1, dtype=torch.float64)
    for k in range(79):
        y[k + 1] = 0.8 * y[k] + u[k].sum()
    data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=5)
    layer = dpc.DPCLayer(data, 1.0, R, 1.0, 1e3, u_set=dpc.Box(-0.3, 0.3), on_failure="nan")
    windows = torch.arange(2) + torch.arange(0, 60, 3)[:, None]
    sol = layer(u[windows], y[windows], y_ref=torch.ones(1))
    solved = sol.info.status == dpc.Status.SOLVED
    assert solved.sum() >= 19 and (sol.info.n_active > 0).any()  # one sample with R = 0 is marked FAILED
