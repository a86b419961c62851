"""Output bounds that exclude every trajectory, widened at a price."""

import pytest
import torch

import torch_dpc as dpc
from helpers import PAPER, SMALL, Y_REF, masses_data, windows
from torch_dpc.control.soften import plan_softened

EXACT = 1e-6  # of the price, which is found by sections
SAME = 1e-11  # a batch and a single call round differently


@pytest.fixture(scope="module")
def far_out():
    """The positions cannot stay between 2 and 3 m with forces of 1 N."""
    box = dpc.Box(torch.tensor([2.0, 2.0, -0.1, -0.1]), torch.tensor([3.0, 3.0, 0.1, 0.1]))
    return dpc.DPCLayer(masses_data(), **PAPER, u_set=dpc.Box(-1.0, 1.0), y_set=box)


def theta_of(layer, sample=0):
    u_ini, y_ini = windows(sample + 1, seed=3)
    return layer.flatten(u_ini[sample], y_ini[sample], Y_REF, None)[0]


@pytest.mark.parametrize("weight", [1.0, 1e3, 1e6])
def test_the_price_of_widening_is_what_the_multipliers_pay(far_out, weight):
    """At the optimum of cost + weight t with t > 0 the slope of the cost, -sum |lam_y|, is -weight."""
    theta = theta_of(far_out)
    plan, width = plan_softened(far_out, theta, weight)
    assert width > 0 and plan.info.status == dpc.Status.SOLVED
    assert plan.lam[far_out.sizes.u :].abs().sum().item() == pytest.approx(weight, rel=EXACT)
    lower, upper = far_out.y_set.bounds(plan.y)
    assert torch.relu(lower - plan.y).max().item() == pytest.approx(width, rel=1e-9)
    assert (plan.y <= upper + width).all() and (plan.u.abs() <= 1).all()


def test_widths_shrink_with_the_weight_to_the_least_that_is_feasible(far_out):
    theta = theta_of(far_out)
    widths = [plan_softened(far_out, theta, weight)[1] for weight in (1.0, 1e2, 1e4, 1e6)]
    assert widths == sorted(widths, reverse=True)


def test_a_problem_with_a_solution_is_left_alone():
    layer = dpc.DPCLayer(masses_data(), **PAPER, u_set=dpc.Box(-1.0, 1.0), y_set=dpc.Box(-5.0, 5.0))
    theta = theta_of(layer)
    plan, width = plan_softened(layer, theta, 1e6)
    hard = layer.plan(theta, *layer.bounds(theta.device))
    assert width == 0.0 and (plan.u - hard.u).abs().max() < SAME


@pytest.mark.parametrize("mode", ["hold", "soften"])
def test_the_controller_goes_on_and_says_so(far_out, mode):
    plant = dpc.systems.OscillatingMasses()
    with pytest.raises(dpc.InfeasibleError):
        dpc.simulate(plant, dpc.DPCController(far_out, 10), Y_REF, steps=5)
    controller = dpc.DPCController(far_out, 10, on_failure=mode)
    log = dpc.simulate(plant, controller, Y_REF, steps=25)
    assert (log.status == dpc.Status.INFEASIBLE).all() and torch.isfinite(log.u).all() and (log.u.abs() <= 1).all()
    assert (controller.softened_by > 0) == (mode == "soften")
    assert bool(log.u.abs().sum() > 0) == (mode == "soften")  # hold has no plan to go on with: zero input


def test_softening_cannot_mend_an_input_the_data_cannot_produce():
    """An idle actuator in the data: no width of the output bounds helps."""
    u = torch.rand(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    u[:, 1] = 0.0
    with pytest.warns(dpc.ExcitationWarning):
        data = dpc.HankelData.from_trajectories(u, u.cumsum(0), t_ini=2, horizon=4)
    layer = dpc.DPCLayer(data, 1.0, 1.0, 1.0, 1e3, dpc.Box(-1.0, 1.0), dpc.Box(-9.0, 9.0))
    theta, _ = layer.flatten(torch.ones(2, 2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64), None, None)
    with pytest.raises(dpc.SolveError, match="does not help"):
        plan_softened(layer, theta, 1e3)


def test_limits_on_changes_of_the_input_are_not_widened():
    layer = dpc.DPCLayer(
        masses_data(1e-2), **SMALL, u_set=dpc.Box(-1.0, 1.0), y_set=dpc.Box(-0.05, 0.05), du_set=dpc.Box(-0.1, 0.1)
    )
    u_ini, y_ini = (w[0] for w in windows(1, seed=3))
    u_ini = 0.0 * u_ini
    theta, _ = layer.flatten(u_ini, y_ini, None, None)
    plan, width = plan_softened(layer, theta, 10.0)
    changes = torch.cat([u_ini[-1:], plan.u]).diff(dim=0)
    assert width > 0.05 and float(changes.abs().max()) <= 0.1 + 1e-9


def test_sets_that_are_no_boxes_have_their_own_softening():
    layer = dpc.DPCLayer(masses_data(1e-2), **SMALL, y_set=dpc.Ball(1.0))
    with pytest.raises(ValueError, match="give the layer a SoftBox"):
        dpc.DPCController(layer, on_failure="soften")
