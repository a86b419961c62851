"""Units do not matter: a plan in other units is the same plan."""

import pytest
import torch

import torch_dpc as dpc
from helpers import generator, randn

#: Relative to each channel.
SAME = 1e-9
T_INI, HORIZON, STEPS = 3, 6, 140


def recording(seed=0, noise=1e-2):
    """Two inputs, three outputs of a random stable system."""
    A, B, C = randn(4, 4, seed=seed), randn(4, 2, seed=seed + 1), randn(3, 4, seed=seed + 2)
    A = 0.9 * A / torch.linalg.eigvals(A).abs().max()
    u = 2 * torch.rand(STEPS, 2, dtype=torch.float64, generator=generator(seed + 3)) - 1
    x, ys = torch.zeros(4, dtype=torch.float64), []
    for step in u:
        ys.append(C @ x)
        x = A @ x + B @ step
    y = torch.stack(ys)
    return u, y + noise * randn(*y.shape, seed=seed + 4)


def plan(unit_u, unit_y, sets="box", noise=1e-2, **options):
    """Return the plan in the units of the test, made by a layer in other units; y has one unit for all channels."""
    unit_u = torch.as_tensor(unit_u, dtype=torch.float64).expand(2)
    u, y = recording(noise=noise)
    data = dpc.HankelData.from_trajectories(u * unit_u, y * unit_y, t_ini=T_INI, horizon=HORIZON)
    R = torch.tensor([[1.0, 0.3], [0.3, 0.5]], dtype=torch.float64)
    per = 1 / unit_u
    weights = {
        "Q": 10.0 / unit_y**2,
        "R": R * per * per[:, None],
        "lambda_g": 1.0,
        "lambda_s": 1e3 / unit_y**2,
    }
    held = {
        "box": {"u_set": dpc.Box(-0.4 * unit_u, 0.4 * unit_u), "y_set": dpc.Box(-2.0 * unit_y, 2.0 * unit_y)},
        "ball": {"u_set": dpc.Box(-0.6 * unit_u, 0.6 * unit_u), "y_set": dpc.Ball(2.0 * unit_y)},
        "soft": {
            "u_set": dpc.Box(-0.6 * unit_u, 0.6 * unit_u),
            "y_set": dpc.SoftBox(-0.5 * unit_y, 0.5 * unit_y, 3.0 / unit_y),
        },
    }[sets]
    layer = dpc.DPCLayer(data, **weights, **held, **options)
    windows = torch.arange(3) + torch.tensor([[20], [60]])
    y_ref = torch.ones(3, dtype=torch.float64) if not options.get("terminal_steps") else 0.05 * torch.ones(3).double()
    sol = layer(u[windows] * unit_u, y[windows] * unit_y, y_ref=y_ref * unit_y)
    return sol.u / unit_u, sol.y / unit_y, sol


def differ(a, b):
    """Return the largest difference relative to each channel."""
    size = b.abs().amax((0, 1)).clamp_min(1e-300)
    return float(((a - b).abs() / size).max())


@pytest.mark.parametrize("sets", ["box", "ball", "soft"])
@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e6])
def test_one_unit_for_all_channels(unit, sets):
    u, y, sol = plan(unit, unit, sets)
    u_0, y_0, sol_0 = plan(1.0, 1.0, sets)
    assert differ(u, u_0) < SAME and differ(y, y_0) < SAME
    assert torch.equal(sol.info.n_active, sol_0.info.n_active) and (sol.info.n_active > 0).all()


@pytest.mark.parametrize("sets", ["box", "ball", "soft"])
@pytest.mark.parametrize("units", [(1e-6, 1.0), (1.0, 1e6), (1e6, 1e-6), (1e-6, 1e6)])
def test_a_unit_for_each_input(units, sets):
    u, y, _ = plan(units, 1.0, sets)
    u_0, y_0, _ = plan(1.0, 1.0, sets)
    assert differ(u, u_0) < SAME and differ(y, y_0) < SAME


@pytest.mark.parametrize("unit", [1e-10, 1e-6, 1e6])
def test_terminal_outputs_in_any_unit(unit):
    """Equality rows were ranked without units: outputs at 1e-10 missed their terminal reference by 0.17."""
    _, y, _ = plan(1.0, unit, terminal_steps=1)
    _, y_0, _ = plan(1.0, 1.0, terminal_steps=1)
    assert float((y[:, -1] - 0.05).abs().max()) < 1e-9 and differ(y, y_0) < SAME


def test_a_small_second_input_is_not_ignored():
    """A second input at 1e-10 was left out of Up g = u_ini."""
    u, y, sol = plan((1.0, 1e-10), 1.0)
    u_0, y_0, _ = plan(1.0, 1.0)
    assert differ(u, u_0) < SAME and differ(y, y_0) < SAME and (sol.info.status == dpc.Status.SOLVED).all()


@pytest.mark.parametrize("unit", [1e-8, 1e6])
def test_gradients_in_any_unit(unit):
    """The weakly-active rule was absolute: with inputs in units of 1e-8 the gradient was 12 % off."""
    grads = []
    for one in (unit, 1.0):
        y_ref = torch.ones(3, dtype=torch.float64, requires_grad=True)
        u, y = recording()
        data = dpc.HankelData.from_trajectories(u * one, y * one, t_ini=T_INI, horizon=HORIZON)
        box = dpc.Box(-0.4 * one, 0.4 * one)
        layer = dpc.DPCLayer(data, 10.0, 1.0, one**2, 1e3, u_set=box)
        sol = layer(u[20:23] * one, y[20:23] * one, y_ref=y_ref * one)
        assert (sol.info.n_active > 0).all()
        (sol.y / one).sum().backward()
        grads.append(y_ref.grad)
    assert float((grads[0] - grads[1]).abs().max() / grads[1].abs().max()) < 1e-9
