"""A batch of runs: each is what it would be alone, and all are planned for at once."""

import statistics
import time

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, delayed_layer, generator, paper_layer, randn, small_layer
from torch_dpc import attacks
from torch_dpc.systems import Many, OscillatingMasses, StateSpace

SAME = 1e-12  # a batch and a single run round differently
FASTER = 20  # how many times faster 256 runs of the masses are together


def run(layer, **options):
    options = {"plant": OscillatingMasses(), "y_ref": Y_REF, "u_ref": HOLDING, "steps": 40, **options}
    return dpc.simulate(
        controller=dpc.DPCController(layer, options.pop("replan_every", 5), on_failure="hold"), **options
    )


def assert_same(one, other):
    for name in ("t", "u", "y", "y_ref", "p"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=SAME)
    assert torch.equal(one.status, other.status)


def algorithm1(layer, rho=0.05):
    trajectory = torch.sin(0.1 * torch.arange(80.0))[:, None].expand(-1, 2)
    return attacks.LinearizedAttack(layer, attacks.TargetInput(trajectory=trajectory), attacks.RelativeBall(rho))


@pytest.mark.parametrize("kind", ["none", "algorithm 1", "random", "gradient"])
def test_each_run_is_what_it_would_be_alone(kind):
    layer, starts = paper_layer(), 0.3 * randn(6, 4)
    attack = {
        "none": lambda: None,
        "algorithm 1": lambda: algorithm1(layer),
        "random": lambda: attacks.RandomAttack(attacks.RelativeBall(0.05)),
        "gradient": lambda: attacks.ProjectedGradientAttack(
            layer, attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(0.05), steps=3
        ),
    }[kind]()
    together = run(layer, attack=attack, reset={"state": starts}, generator=[generator(i) for i in range(6)])
    assert together.y.shape == (6, 40, 4) and together.p.shape == (6, 40, 6, 4) and together.status.shape == (6, 40)
    for i in range(6):
        alone = run(layer, attack=attack, reset={"state": starts[i]}, generator=generator(i))
        assert_same(together[i], alone)
    assert (kind == "none") == (not together.p.any())


def test_what_differs_between_runs_has_the_batch_in_front():
    layer, rhos = small_layer(), torch.tensor([0.0, 0.02, 0.05])
    y_ref, u_ref = torch.stack([a * Y_REF for a in (0.5, 0.7, 0.9)])[:, None], randn(3, 50, 2)
    many = OscillatingMasses(noise=0.01, generator=[generator(i) for i in range(3)])
    cost = attacks.TargetInput(torch.ones(2))
    together = run(
        layer, plant=many, batch=3, y_ref=y_ref, u_ref=u_ref,
        attack=attacks.LinearizedAttack(layer, cost, attacks.RelativeBall(rhos)),
    )  # fmt: skip
    for i in range(3):
        one = OscillatingMasses(noise=0.01, generator=generator(i))
        attack = attacks.LinearizedAttack(layer, cost, attacks.RelativeBall(rhos[i]))
        assert_same(together[i], run(layer, plant=one, y_ref=y_ref[i, 0], u_ref=u_ref[i], attack=attack))


def test_a_list_of_attacks_is_one_a_run():
    layer = small_layer()
    kinds = [algorithm1(layer), attacks.RandomAttack(attacks.RelativeBall(0.1))]
    together = run(layer, attack=kinds, batch=2, generator=[generator(0), generator(1)], u_warmup=0.3)
    for i, attack in enumerate(kinds):
        assert_same(together[i], run(layer, attack=attack, generator=generator(i), u_warmup=0.3))


def test_runs_may_have_any_shape():
    layer, starts = small_layer(), 0.2 * randn(2, 3, 4)
    together = run(layer, reset={"state": starts}, attack=algorithm1(layer))
    assert together.y.shape == (2, 3, 40, 4) and together.batch == (2, 3)
    assert_same(together[1, 2], run(layer, reset={"state": starts[1, 2]}, attack=algorithm1(layer)))


@pytest.mark.parametrize("mode", ["hold", "soften"])
def test_a_run_without_a_plan_is_held_or_softened_alone(mode):
    """The last input of a plan is free; where its reference draws it beyond 0.5, no plan follows."""
    layer, plant = delayed_layer(), StateSpace([[0.8, 0.0], [0.0, 0.0]], [[0.2], [1.0]], dt=1.0)
    u_refs = torch.tensor([0.0, 0.9, 0.2], dtype=torch.float64)[:, None, None]

    def simulate(u_ref, **batch):
        controller = dpc.DPCController(layer, 6, on_failure=mode)
        log = dpc.simulate(plant, controller, torch.tensor([0.1, 0.0]), steps=15, u_ref=u_ref, **batch)
        return log, controller.softened_by

    together, widths = simulate(u_refs, batch=3)
    assert (together.status[1, 6:] != dpc.Status.SOLVED).all() and (together.status[::2] == dpc.Status.SOLVED).all()
    assert torch.isfinite(together.u).all() and together.u[1, 5] > 0.5
    for i in range(3):
        alone, width = simulate(u_refs[i, 0])
        assert_same(together[i], alone)
        assert float(widths[i]) == pytest.approx(width, abs=SAME) and (width > 0) == (mode == "soften" and i == 1)


def test_the_input_before_the_first_step_may_differ_too():
    layer, before = small_layer(), randn(3, 2)
    together = run(layer, batch=3, u_warmup=before)
    assert_same(together[2], run(layer, u_warmup=before[2]))


def test_256_runs_of_the_masses_are_at_least_20_times_faster_together():
    layer, starts = paper_layer(), 0.3 * randn(256, 4)
    singles = 8

    def seconds(states, runs):
        begin = time.process_time()
        for state in states:
            run(layer, reset={"state": state}, steps=60, replan_every=10)
        return (time.process_time() - begin) / runs

    seconds([starts], 256)
    together = statistics.median(seconds([starts], 256) for _ in range(3))
    alone = statistics.median(seconds(starts[:singles], singles) for _ in range(3))
    assert alone > FASTER * together


# --- what does not fit ------------------------------------------------------------------------------------------------


class Bare:
    """A plant that carries no batch."""

    n_u, n_y, dt = 2, 4, 0.1

    def reset(self, height=0.0):
        self.height = height
        return np.full(4, height)

    def step(self, u):
        return np.full(4, self.height + u.sum())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"plant": Bare(), "batch": 3}, "`batch` must be left out for Bare, whose reset takes no batch.*systems.Many"),
        (
            {"batch": 3, "y_ref": torch.zeros(2, 1, 4)},
            r"`y_ref` has the runs \(2,\) in front, and the plant runs \(3,\)",
        ),
        ({"y_ref": torch.zeros(2, 1, 4)}, r"`y_ref` has the runs \(2,\) in front, and the plant runs \(\)"),
        ({"batch": 3, "u_ref": torch.zeros(3, 2, 2)}, "`u_ref` must have at least `steps` = 40 rows, got 2"),
        (
            {"batch": 3, "reset": {"state": torch.zeros(2, 4)}},
            r"`state` must have shape \(4,\) or \(3, 4\), got \(2, 4\)",
        ),
        ({"batch": 3, "attack": [None]}, r"`attack` must hold one attack a run, got 1 for runs \(3,\)"),
        ({"batch": 3, "reset": False}, r"`batch` is 3, and the plant runs \(\)"),
    ],
    ids=lambda v: "" if isinstance(v, str) else "-".join(v),
)
def test_what_does_not_fit_is_named(change, says):
    with pytest.raises(ValueError, match=says):
        run(small_layer(), **change)


# --- many plants ------------------------------------------------------------------------------------------------------


def test_many_plants_are_planned_for_in_one_call():
    layer, calls = small_layer(), []
    layer.register_forward_pre_hook(lambda module, inputs: calls.append(inputs[0].shape))
    plants = [OscillatingMasses(damping=d) for d in (0.0, 0.1, 0.5)]
    starts = 0.2 * randn(3, 4)
    together = run(layer, plant=Many(plants), reset={"each": [{"state": s} for s in starts]}, steps=10)
    assert calls == [(3, 3, 2)] * 2
    for i in range(3):
        assert_same(together[i], run(layer, plant=plants[i], reset={"state": starts[i]}, steps=10))


def test_many_plants_of_different_kinds_with_shared_arguments():
    together = run(small_layer(), plant=Many([Bare(), Bare()]), reset={"height": 0.1}, steps=7, batch=2)
    assert_same(together[1], run(small_layer(), plant=Bare(), reset={"height": 0.1}, steps=7))


def test_processes_return_what_the_plants_return():
    commands = randn(3, 5, 2)
    outputs = []
    for plant in (Many([OscillatingMasses] * 5, processes=2), Many([OscillatingMasses() for _ in range(5)])):
        with plant:
            first = plant.reset(each=[{"state": 0.1 * i * torch.ones(4)} for i in range(5)])
            outputs.append(torch.stack([first, *[plant.step(u) for u in commands]]))
            assert len(plant) == 5 and "5 plants" in repr(plant)
    assert torch.equal(*outputs)


def test_processes_that_have_ended_say_so():
    plant = Many([OscillatingMasses], processes=1)
    plant.close()
    with pytest.raises(RuntimeError, match="have ended"):
        plant.reset()


def test_an_error_in_a_process_arrives_with_its_traceback():
    plant = Many([OscillatingMasses] * 2, processes=2)
    with pytest.raises(RuntimeError, match=r"(?s)a process that holds plants failed.*`state` must have shape"):
        plant.reset(state=torch.ones(3))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Many([]), "`plants` must be a list of one plant or more"),
        (lambda: Many([OscillatingMasses]), r"`plants\[0\]` must be a plant.*need `processes`"),
        (lambda: Many([OscillatingMasses(), OscillatingMasses(3)]), r"must be alike in \(n_u, n_y, dt\)"),
        (lambda: Many([OscillatingMasses()]).reset(batch=(2,)), r"`batch` must be \(1,\), the number of plants"),
        (lambda: Many([OscillatingMasses()]).reset(each=[{}, {}]), "`each` must hold one mapping a plant, 1, got 2"),
        (lambda: Many([OscillatingMasses()]).step(torch.ones(2, 2)), r"`u` must have shape \(1, 2\), got \(2, 2\)"),
    ],
    ids=["none", "class", "sizes", "batch", "each", "input"],
)
def test_bad_plants_are_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()
