"""1'g = 1: affine systems, operating points away from zero, and data that must know it."""

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, generator, randn, relative, small_data, windows

SHIFTED = 1e-9
DRIFT = torch.tensor([0.02, -0.01, 0.3, 0.1], dtype=torch.float64)


def affine_data(t_ini=2, horizon=6, steps=150):
    """The masses under a constant force that nobody measures: x+ = A x + B u + c."""
    plant = dpc.systems.OscillatingMasses()
    u, x = 2 * torch.rand(steps, 2, dtype=torch.float64, generator=generator()) - 1, torch.zeros(4, dtype=torch.float64)
    y = []
    for step in u:
        y.append(x)
        x = plant.A @ x + plant.B @ step + DRIFT
    return dpc.HankelData.from_trajectories(u, torch.stack(y), t_ini=t_ini, horizon=horizon)


def test_predictions_are_those_of_the_affine_system():
    """One past step holds the whole state; without 1'g = 1 nothing tells the drift."""
    plant, x = dpc.systems.OscillatingMasses(), randn(4)
    errors = []
    for affine in (True, False):
        layer = dpc.DPCLayer(affine_data(1), Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e8, affine=affine)
        u_ini = torch.tensor([[0.1, -0.2]], dtype=torch.float64)
        plan = layer(u_ini, x[None], y_ref=Y_REF)
        state, true = plant.A @ x + plant.B @ u_ini[0] + DRIFT, []
        for u in plan.u:
            true.append(state)
            state = plant.A @ state + plant.B @ u + DRIFT
        errors.append(relative(plan.y, torch.stack(true)))
        assert (abs(float(plan.g.sum()) - 1) < 1e-9) == affine
    assert errors[0] < 1e-6 and errors[1] > 1e-2


@pytest.mark.parametrize("regularizer", ["projection", "identity"])
def test_a_plan_moves_with_the_zero_of_the_channels(regularizer):
    """With 1'g = 1 nothing depends on where zero is: recording, window, references and sets move together."""
    du, dy = torch.tensor([3.0, -2.0]).double(), torch.tensor([12.0, -7.0, 0.5, 1.0]).double()
    data, (u_ini, y_ini) = small_data(), (0.3 * w for w in windows(4, 3, seed=1))

    def plan(u0, y0):
        moved = dpc.HankelData(
            data.Up + u0.repeat(3)[:, None], data.Uf + u0.repeat(6)[:, None],
            data.Yp + y0.repeat(3)[:, None], data.Yf + y0.repeat(6)[:, None], 3, 6, 2, 4,
        )  # fmt: skip
        sets = {"u_set": dpc.Box(u0 - 0.5, u0 + 0.5), "y_set": dpc.Box(y0 - 0.7, y0 + 0.7)}
        layer = dpc.DPCLayer(moved, **SMALL, **sets, affine=True, regularizer=regularizer)
        sol = layer(u_ini + u0, y_ini + y0, y_ref=Y_REF + y0, u_ref=u0)
        assert (sol.info.n_active > 0).any()
        return sol.u - u0, sol.y - y0

    still, moved = plan(0 * du, 0 * dy), plan(du, dy)
    assert relative(moved[0], still[0]) < SHIFTED and relative(moved[1], still[1]) < SHIFTED


def test_the_tanks_follow_a_step_without_offset():
    """Around 12 cm and 3 V, with as many past steps as the lag: within 1 % of the step, which the plain form misses."""
    plant = dpc.systems.FourTanks()
    u, y = dpc.collect(plant, 300, generator=generator(), offset=plant.voltages, amplitude=0.5, hold=3)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=25)
    target, offsets = plant.x0[:2] + 1.0, []
    for affine in (True, False):
        layer = dpc.DPCLayer(
            data, Q=1.0, R=0.0, R_du=0.1, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(0.0, 6.0), affine=affine
        )
        log = dpc.simulate(plant, dpc.DPCController(layer, 2), target, steps=100, u_warmup=plant.voltages)
        offsets.append(float((log.y[-1] - target).abs().max()))
    assert offsets[0] < 0.005 and offsets[1] > 0.01  # of a step of 1 cm


@pytest.mark.parametrize("with_windows", [False, True])
def test_it_is_saved_with_the_data(tmp_path, with_windows):
    pytest.importorskip("safetensors", reason="layers are saved with safetensors (extra `save`)")
    layer = dpc.DPCLayer(affine_data(), **SMALL, affine=True, Q_terminal=50.0, u_set=dpc.Box(-0.5, 0.5))
    layer.save(tmp_path / "layer.safetensors", data=with_windows)
    again = dpc.DPCLayer.load(tmp_path / "layer.safetensors")
    call = {"u_ini": 0.1 * randn(2, 2), "y_ini": randn(2, 4), "y_ref": Y_REF}
    assert again.affine and again.Q_terminal == 50.0
    assert relative(again(**call).u, layer(**call).u) < 1e-10
    if not with_windows:
        with pytest.raises(ValueError, match="`affine` must be True for these data"):
            dpc.DPCLayer(again.data, **SMALL)


def test_a_batch_of_data_sets_is_affine_one_by_one():
    members = [affine_data(), affine_data(steps=140)]
    call = {"u_ini": 0.1 * randn(2, 2), "y_ini": randn(2, 4), "y_ref": Y_REF}
    together = dpc.DPCLayer(dpc.HankelBatch(members), **SMALL, affine=True)(**call)
    for i, data in enumerate(members):
        assert relative(together.u[i], dpc.DPCLayer(data, **SMALL, affine=True)(**call).u) < 1e-9


def test_what_does_not_fit_is_named():
    with pytest.raises(ValueError, match="`affine` must be True or False, got 1"):
        dpc.DPCLayer(small_data(), **SMALL, affine=1)
    with pytest.raises(ValueError, match="`affine=True` needs the recorded windows, and these data are compact"):
        dpc.DPCLayer(small_data().compressed(), **SMALL, affine=True)
    with pytest.raises(ValueError, match=r"`Q_terminal` must be a number or have shape \(4, 4\)"):
        dpc.DPCLayer(small_data(), **SMALL, Q_terminal=torch.eye(3))
    with pytest.raises(ValueError, match='backward="full" is the system of the paper'):
        layer = dpc.DPCLayer(small_data(), **SMALL, affine=True, backward="full")
        layer(torch.zeros(3, 2), torch.zeros(3, 4))
