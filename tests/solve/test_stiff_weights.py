"""Derivatives in weights that leave their own term near zero."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import masses_data, randn, windows
from torch_dpc.solve.cone_program import Ends, outcome_of


@pytest.mark.parametrize("lambda_s", [1e8])
def test_the_derivative_in_a_stiff_weight_keeps_its_digits(lambda_s):
    """Against differences of plans in extended precision: Yp g - y_ini, near zero, had no digits left."""
    data = masses_data(1e-2, t_ini=6, horizon=25)
    n_u = 25 * data.n_u
    inputs, weight = windows(1, 6, scale=0.3, noise=1e-2), torch.linspace(-1.0, 1.0, n_u, dtype=torch.float64)
    y_ref, fixed = 0.5 + 0.3 * randn(25, data.n_y), {"Q": 10.0 * torch.eye(data.n_y), "R": torch.eye(data.n_u)}
    stiff = torch.tensor(lambda_s, dtype=torch.float64, requires_grad=True)
    bounded = dpc.Box(-1.0, 1.0)
    plan = dpc.DPCLayer(data, **fixed, lambda_g=100.0, lambda_s=stiff, u_set=bounded)(*inputs, y_ref=y_ref)
    assert plan.info.n_active > 0
    (bar,) = torch.autograd.grad((plan.u.flatten() * weight).sum(), stiff)

    def along(change):
        layer = dpc.DPCLayer(data, **fixed, lambda_g=100.0, lambda_s=lambda_s * (1 + change), u_set=bounded)
        problem = layer.factored(torch.device("cpu")).solver._last_resort.problem(0)
        theta = [inputs[0].flatten(), inputs[1].flatten(), torch.zeros(n_u).double(), y_ref.flatten().double()]
        sample = problem.sample(torch.cat(theta).numpy())
        ends = Ends(*(np.full(len(problem.unit), end) for end in (-np.inf, np.inf, np.inf)), [])
        ends.lower[:n_u], ends.upper[:n_u] = (end / problem.unit[:n_u].astype(float) for end in (-1.0, 1.0))
        x, _ = outcome_of(problem, sample, ends, np.zeros(0, np.longdouble)).candidates[0]
        return ((sample.c + problem.M @ x) * problem.unit)[:n_u] @ weight.numpy()

    step = 1e-4  # the difference of long doubles keeps 1e-19 / 1e-4 of what does not move
    expected = float((along(step) - along(-step)) / (2 * np.longdouble(step) * lambda_s))
    assert float(bar) == pytest.approx(expected, rel=1e-6)
