"""The last resort: plans are those of the engines, proofs see what is worse, certificates exclude what is empty."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import Y_REF, small_layer, windows
from torch_dpc.sets.units import in_units
from torch_dpc.sets.values import values_of
from torch_dpc.solve.last_resort import Settled, ends_of, settled
from torch_dpc.solve.proof import excludes, prove

CPU = torch.device("cpu")
SETS = {
    "boxes": {"u_set": dpc.Box(-0.4, 0.4), "y_set": dpc.Box(-2.0, 2.0)},
    "no set": {},
    "held": {"u_set": dpc.Box(torch.tensor([0.1, -0.4]), torch.tensor([0.1, 0.4]))},
    "a ball": {"u_set": dpc.Ball(0.4)},
    "a ball per trajectory": {"u_set": dpc.Ball(0.6, per="trajectory"), "y_set": dpc.SoftBox(-1.0, 1.0, 0.5)},
    "a cone": {"u_set": dpc.SecondOrderCone()},
    "a point": {"u_set": dpc.Ball(0.0)},
    "prices": {"y_set": dpc.SoftBox(-0.5, 0.5, 3.0), "du_set": dpc.Box(-0.2, 0.2)},
}


def posed(layer, i, inputs):
    """Return the problem in extended precision, the numbers of sample i, its sets, and the unit of v."""
    solver = layer.factored(CPU).solver
    u_ini, y_ini = (x[i].flatten() for x in inputs)
    theta = torch.cat([u_ini, y_ini, torch.zeros(solver.sizes.u).double(), Y_REF.expand(6, 4).flatten().double()])
    ends = ends_of(values_of(in_units(layer.present_sets(CPU), solver.unit), torch.Size(), CPU), 0)
    problem = solver._last_resort.problem(0)
    return problem, problem.sample(theta.numpy()), ends, solver.unit.numpy()


@pytest.mark.parametrize("name", SETS)
def test_the_plan_is_that_of_the_engines(name):
    layer, inputs = small_layer(**SETS[name], on_failure="nan"), windows(3, 3)
    plan = layer(*inputs, y_ref=Y_REF)
    for i in (plan.info.status == dpc.Status.SOLVED).nonzero()[:, 0].tolist():
        problem, sample, ends, unit = posed(layer, i, inputs)
        found = settled(problem, sample, ends)
        assert isinstance(found, Settled) and found.proof.holds
        u = found.v[:12] * unit[:12]
        assert np.abs(u - plan.u[i].numpy().ravel()).max() < 1e-9
        assert found.proof.cost == pytest.approx(float(plan.value[i]), rel=1e-8)


@pytest.mark.parametrize("name", ["boxes", "a ball", "prices"])
def test_a_proof_sees_what_is_worse(name):
    layer, inputs = small_layer(**SETS[name], on_failure="nan"), windows(3, 3)
    problem, sample, ends, _ = posed(layer, 0, inputs)
    found = settled(problem, sample, ends)
    assert isinstance(found, Settled) and np.abs(found.lam).max() > 0
    assert prove(problem, sample, ends, found.v, found.lam).holds
    step = 1e-3 * np.random.default_rng(0).normal(size=problem.M.shape[1])
    assert not prove(problem, sample, ends, found.v + (problem.M @ step).astype(float), found.lam).holds
    assert not prove(problem, sample, ends, found.v, 0 * found.lam).holds  # no multipliers, no bound
    assert not prove(problem, sample, ends, found.v + 1e-3, found.lam).holds


EMPTY = {
    "bounds that contradict the changes": {"u_set": dpc.Box(-0.1, 0.1), "du_set": dpc.Box(0.3, 0.4)},
    "a ball beside a box": {"u_set": dpc.Ball(0.1), "du_set": dpc.Box(0.3, 0.4)},
    "a ball out of reach of a ball": {"u_set": dpc.Ball(0.1, 1.5), "du_set": dpc.Ball(0.1)},
}


@pytest.mark.parametrize("name", EMPTY)
def test_what_is_empty_is_proven_empty(name):
    layer, inputs = small_layer(**EMPTY[name], on_failure="nan"), windows(2, 3)
    problem, sample, ends, _ = posed(layer, 0, inputs)
    assert settled(problem, sample, ends) is dpc.Status.INFEASIBLE


@pytest.mark.parametrize("name", SETS)
def test_no_direction_excludes_a_plan_that_exists(name):
    layer, inputs = small_layer(**SETS[name], on_failure="nan"), windows(3, 3)
    draw = np.random.default_rng(1)
    for i in range(3):
        problem, sample, ends, _ = posed(layer, i, inputs)
        found = settled(problem, sample, ends)
        if isinstance(found, Settled):
            directions = [found.lam, -found.lam, *draw.normal(size=(20, len(found.lam)))]
            assert not any(excludes(problem, sample, ends, np.asarray(d, np.longdouble)) for d in directions)
