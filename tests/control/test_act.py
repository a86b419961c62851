"""A controller that keeps its own window, for a loop around hardware."""

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, delayed_layer, randn, small_layer
from torch_dpc.control.plan_times import PlanTimes
from torch_dpc.systems import OscillatingMasses

REFS = {"y_ref": Y_REF, "u_ref": HOLDING}


def closed_loop(controller, plant, y, steps, *, prepares=False):
    us, ys = [], []
    for _ in range(steps):
        u = controller.act(y, **REFS)
        us.append(u)
        ys.append(y)
        if prepares:
            controller.prepare(**REFS)
        y = plant.step(u)
    return torch.stack(us, -2), torch.stack(ys, -2)


@pytest.mark.parametrize("prepares", [False, True])
@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("replan_every", [1, 4])
def test_acting_step_by_step_is_the_simulated_run(replan_every, batch, prepares):
    layer, plant = small_layer(), OscillatingMasses()
    expected = dpc.simulate(
        plant, dpc.DPCController(layer, replan_every), steps=12, reset={"state": 0.1 * randn(*batch, 4)}, **REFS
    )
    controller = dpc.DPCController(layer, replan_every)
    u, y = closed_loop(controller, plant, plant.reset(0.1 * randn(*batch, 4)), 3 + 12, prepares=prepares)
    assert not u[..., :3, :].any()  # the window fills at the input nearest to zero
    assert torch.equal(u[..., 3:, :], expected.u) and torch.equal(y[..., 3:, :], expected.y)


def test_a_given_window_is_used_at_once():
    layer, plant = small_layer(), OscillatingMasses()
    u, y = dpc.collect(plant, 10, amplitude=0.3)
    now = plant.step(torch.zeros(2))
    controller = dpc.DPCController(layer, 2)
    controller.reset(u.numpy(), y.numpy())
    assert torch.equal(controller.act(now, **REFS), layer(u[-3:], y[-3:], **REFS).u[0])
    controller.act(now.numpy(), **REFS)
    u_ini = torch.cat([u[-1:], controller.plan.u[:2]])
    assert torch.equal(controller.act(now, **REFS), layer(u_ini, torch.stack([y[-1], now, now]), **REFS).u[0])


def test_a_prepared_plan_costs_the_next_act_nothing():
    layer, plant, calls = small_layer(), OscillatingMasses(), []
    layer.register_forward_pre_hook(lambda module, inputs: calls.append(1))
    controller = dpc.DPCController(layer, 2)
    y = plant.reset()
    for k in range(8):
        before = len(calls)
        controller.act(y, **REFS)
        assert len(calls) == before
        controller.prepare(**REFS)
        assert len(calls) - before == (k >= 2 and k % 2 == 0)


def test_hold_and_raise_when_a_plan_is_impossible():
    layer = delayed_layer()
    window = torch.tensor([[0.0], [0.0], [0.7]]), torch.zeros(3, 2)
    controller = dpc.DPCController(layer, 2, on_failure="hold")
    controller.reset(*window)
    assert controller.act(torch.zeros(2)) == 0 and controller.status == dpc.Status.INFEASIBLE
    controller = dpc.DPCController(layer, 2)
    controller.reset(*window)
    with pytest.raises(dpc.InfeasibleError):
        controller.act(torch.zeros(2))


def test_the_plan_is_at_hand():
    controller = dpc.DPCController(small_layer(), 3)
    assert controller.plan is None
    controller.step(torch.zeros(3, 2), torch.zeros(3, 4), y_ref=Y_REF)
    assert controller.plan.u.shape == (6, 2) and torch.equal(controller.state.inputs, controller.plan.u)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda c: c.reset(u_past=torch.zeros(3, 2)), "give both `u_past` and `y_past`, or neither"),
        (lambda c: c.reset(torch.zeros(2, 2), torch.zeros(2, 4)), r"`u_past` must have shape \(\*batch, >= 3, 2\)"),
        (lambda c: c.reset(torch.zeros(3, 2), torch.zeros(3, 3)), r"`y_past` must have shape \(\*batch, >= 3, 4\)"),
        (lambda c: c.act(torch.zeros(3)), r"`y` must have shape \(\*batch, n_y\) = \(\*, 4\), got \(3,\)"),
        (lambda c: c.act(torch.tensor([0.0, torch.nan, 0.0, 0.0])), "`y` must be finite"),
    ],
    ids=["one", "u_past", "y_past", "shape", "nan"],
)
def test_bad_measurements_are_named(call, says):
    with pytest.raises(ValueError, match=says):
        call(dpc.DPCController(small_layer(), 3))


# --- durations --------------------------------------------------------------------------------------------------------


def test_durations_are_counted_against_the_deadline():
    times = PlanTimes(0.010)
    for seconds in [0.001] * 50 + [0.003] * 49 + [0.020]:
        times.add(seconds)
    assert (times.count, times.late) == (100, 1) and times.worst == 0.020
    assert times.median == pytest.approx(0.002) and 0.003 < times.p99 < 0.020
    assert "100 plans" in repr(times) and "1 later than 10 ms" in repr(times)


def test_a_controller_times_its_plans():
    controller = dpc.DPCController(small_layer(), 3, deadline=1e-9)
    dpc.simulate(OscillatingMasses(), controller, Y_REF, steps=10)
    assert controller.times.count == controller.times.late == 4 and 0 < controller.times.median < 10
    controller.reset()
    assert controller.times.count == 0 and "no plans" in repr(controller)
    with pytest.raises(ValueError, match="`deadline` must be a positive time"):
        dpc.DPCController(small_layer(), 3, deadline=0.0)
