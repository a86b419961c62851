"""A cost with a kernel: the optimum of the cost as posed first, then the least norm."""

import pytest
import torch

import torch_dpc as dpc


def over_actuated(**weights):
    """y[k+1] = 0.5 y + u1 + u2, no price on the inputs, u1 at most 0.1: u2 takes the rest."""
    u = 2 * torch.rand(60, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1
    y = torch.zeros(60, 1, dtype=torch.float64)
    for k in range(59):
        y[k + 1] = 0.5 * y[k] + u[k].sum()
    data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=4)
    upper = torch.tensor([0.1, torch.inf], dtype=torch.float64)
    layer = dpc.DPCLayer(data, R=0.0, lambda_g=1.0, **weights, u_set=dpc.Box(-torch.inf, upper))
    return layer, u, y


@pytest.mark.parametrize(("Q", "lambda_s"), [(1.0, 1e3), (0.01, 1e8)])
def test_the_charge_on_the_kernel_costs_nothing(Q, lambda_s):
    """The charge was 1e-6 of the largest singular value: the plan missed by 3e-12 lambda_s / Q, 3 % in the second."""
    layer, u, y = over_actuated(Q=Q, lambda_s=lambda_s)
    sol = layer(u[10:12], y[10:12], y_ref=2 * torch.ones(1))
    assert sol.info.is_selection and int(sol.info.status) == dpc.Status.SOLVED
    # u reaches the reference from the second output on, whatever u1 does; the first output is decided.
    assert float((sol.y[1:] - 2).abs().max()) < 1e-8
    assert float(sol.u[:, 0].max()) <= 0.1


def test_among_the_optima_the_norm_is_least():
    """Moving an input from one actuator to the other changes no cost and makes g longer."""
    layer, u, y = over_actuated(Q=1.0, lambda_s=1e3)
    sol = layer(u[10:12], y[10:12], y_ref=2 * torch.ones(1))
    data, n = layer.data, float(sol.g.norm())
    rows = torch.cat([data.Up, data.Yp, data.Yf])
    kernel = torch.linalg.svd(rows)[2][torch.linalg.matrix_rank(rows) :].T  # what no charged row sees
    moves = (data.Uf @ kernel).reshape(4, 2, -1)
    for k in range(kernel.shape[1]):
        for sign in (-1, 1):
            g = sol.g + sign * 1e-4 * kernel[:, k]
            feasible = bool((sol.u[:, 0] + sign * 1e-4 * moves[:, 0, k] <= 0.1 + 1e-12).all())
            assert not feasible or float(g.norm()) >= n - 1e-12
