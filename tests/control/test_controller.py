"""Receding horizon: what is known when, and the loop around a plant."""

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, SMALL, Y_REF, generator, relative, small_data, small_layer

EXACT = 1e-10
T_INI = 3


class Recorder:
    """A plant of the user's own: counts, and writes down what reaches it."""

    n_u, n_y, dt = 2, 4, 0.5

    def __init__(self):
        self.resets, self.inputs = [], []

    def reset(self, *args, **kwargs):
        self.resets.append((args, kwargs))
        self.steps = 0
        return self._y()

    def step(self, u):
        self.inputs.append(u.clone())
        self.steps += 1
        return self._y()

    def _y(self):
        return 0.01 * self.steps * torch.ones(4, dtype=torch.float64)


class SpyController(dpc.DPCController):
    """Writes down what it is told."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.told = []

    def step(self, u_ini, y_ini, **refs):
        self.told.append((u_ini.clone(), y_ini.clone(), {k: v.clone() for k, v in refs.items()}, self.replans_now))
        return super().step(u_ini, y_ini, **refs)


def add_one(u_ini, y_ini, *, y_ref=None, u_ref=None, generator=None, step=0):
    return torch.full_like(y_ini, 0.001 * (1 + step))


def test_at_step_k_it_knows_the_steps_before_k():
    plant, controller = Recorder(), SpyController(small_layer(), replan_every=2)
    log = dpc.simulate(plant, controller, Y_REF, steps=7, u_warmup=torch.tensor([0.1, -0.2]))
    y = 0.01 * torch.arange(10, dtype=torch.float64)[:, None].expand(10, 4)  # of the plant, warm-up included
    u = torch.stack(plant.inputs)
    assert u.shape == (10, 2) and relative(u[:3], torch.tensor([0.1, -0.2]).expand(3, 2).double()) < 1e-7
    for k, (u_ini, y_ini, _, replans) in enumerate(controller.told):
        torch.testing.assert_close(u_ini, u[k : k + 3], rtol=0, atol=0)
        torch.testing.assert_close(y_ini, y[k : k + 3], rtol=0, atol=0)
        assert replans == (k % 2 == 0)
    torch.testing.assert_close(log.u, u[3:], rtol=0, atol=0)
    torch.testing.assert_close(log.y, y[3:], rtol=0, atol=0)  # y[k] is measured before u[k] is applied
    torch.testing.assert_close(log.t, 0.5 * torch.arange(7, dtype=torch.float64))
    assert (log.y_ref == Y_REF).all() and log.y_ref.shape == (7, 4) and log.p.shape == (7, 3, 4) and not log.p.any()
    assert log.status.tolist() == [0] * 7 and log.replanned.tolist() == [k % 2 == 0 for k in range(7)]


@pytest.mark.parametrize("replan_every", [1, 4, 6])
def test_a_plan_is_applied_open_loop_until_the_next(replan_every):
    layer = small_layer(0.0)
    plant = dpc.systems.OscillatingMasses()
    controller = SpyController(layer, replan_every=replan_every)
    log = dpc.simulate(plant, controller, Y_REF, steps=13, u_ref=HOLDING, reset={"state": torch.ones(4)})
    for k, (u_ini, y_ini, refs, _) in enumerate(controller.told):
        if k % replan_every == 0:
            refs.pop("alarm", None)  # the controller's alone
            plan = layer(u_ini, y_ini, **refs)
            for j in range(min(replan_every, 13 - k)):
                assert torch.equal(log.u[k + j], plan.u[j])


def test_with_a_stiff_lambda_s_the_prediction_comes_true():
    layer = small_layer(0.0, lambda_s=1e9)
    log = dpc.simulate(
        dpc.systems.OscillatingMasses(), dpc.DPCController(layer, 6), Y_REF, steps=6, reset={"state": torch.ones(4)}
    )
    plant = dpc.systems.OscillatingMasses()
    ys = [plant.reset(torch.ones(4))] + [plant.step(torch.zeros(2)) for _ in range(3)]
    plan = layer(torch.zeros(3, 2, dtype=torch.float64), torch.stack(ys[:3]), y_ref=Y_REF)
    assert relative(log.y, plan.y) < 1e-6


def test_the_loop_settles_at_the_reference():
    layer = small_layer(0.0, u_set=dpc.Box(-2.0, 2.0))
    log = dpc.simulate(dpc.systems.OscillatingMasses(), dpc.DPCController(layer, 3), Y_REF, steps=300, u_ref=HOLDING)
    assert (log.y[-1] - Y_REF).abs().max() < 1e-3 and (log.u[-1] - HOLDING).abs().max() < 1e-3


def test_the_attack_is_on_the_measurement_alone():
    plant, controller = Recorder(), SpyController(small_layer(), replan_every=3)
    log = dpc.simulate(plant, controller, Y_REF, steps=7, attack=add_one)
    for k in range(7):
        made = k - k % 3  # the step of the plan in force
        torch.testing.assert_close(log.p[k], torch.full((3, 4), 0.001 * (1 + made), dtype=torch.float64))
        true_y = 0.01 * torch.arange(k, k + 3, dtype=torch.float64)[:, None]
        torch.testing.assert_close(log.y[k], true_y[-1].expand(4) + 0.01)
        if k % 3 == 0:
            torch.testing.assert_close(controller.told[k][1], true_y + log.p[k])


def test_what_reaches_the_plant_is_what_was_planned():
    """An attack changes the plans, and through them the inputs; it adds nothing to an input by itself."""
    plant, controller = Recorder(), SpyController(small_layer(), replan_every=3)
    log = dpc.simulate(plant, controller, Y_REF, steps=7, attack=add_one)
    assert log.p.abs().min() > 0 and torch.equal(torch.stack(plant.inputs[-7:]), log.u)
    controller.reset()
    u_ini = torch.stack(plant.inputs[:T_INI])
    y_ini = 0.01 * torch.arange(T_INI, dtype=torch.float64)[:, None].expand(-1, 4)
    plan = controller.layer(u_ini, y_ini + log.p[0], y_ref=Y_REF)
    torch.testing.assert_close(torch.stack(plant.inputs[T_INI : T_INI + 3]), plan.u[:3], rtol=0, atol=EXACT)


def test_the_attack_sees_the_truth_and_the_references_of_its_step():
    seen = []

    def spy(u_ini, y_ini, *, y_ref, u_ref, generator, step):
        seen.append((y_ini.clone(), y_ref.clone(), u_ref.clone(), generator, step))
        return torch.zeros_like(y_ini)

    y_ref = torch.arange(32, dtype=torch.float64).reshape(8, 4)
    source = generator()
    dpc.simulate(Recorder(), dpc.DPCController(small_layer(), 3), y_ref, steps=8, attack=spy, generator=source)
    assert [s[4] for s in seen] == [0, 3, 6] and all(s[3] is source for s in seen)
    for y_ini, window, u_ref, _, k in seen:
        torch.testing.assert_close(y_ini[:, 0], 0.01 * torch.arange(k, k + 3, dtype=torch.float64))
        held = torch.stack([y_ref[min(k + j, 7)] for j in range(6)])
        torch.testing.assert_close(window, held)
        assert u_ref.shape == (6, 2) and not u_ref.any()


def test_a_reference_is_held_beyond_its_end():
    controller = SpyController(small_layer(), 1)
    u_ref = torch.linspace(0, 1, 22).reshape(11, 2).double()
    dpc.simulate(Recorder(), controller, Y_REF, steps=5, u_ref=u_ref)
    for k, told in enumerate(controller.told):
        torch.testing.assert_close(told[2]["u_ref"], torch.stack([u_ref[min(k + j, 10)] for j in range(6)]))


def test_reset_and_its_arguments():
    plant, controller = Recorder(), dpc.DPCController(small_layer(), 3)
    dpc.simulate(plant, controller, Y_REF, steps=1)
    dpc.simulate(plant, controller, Y_REF, steps=1, reset={"position": (0, 0, 1)})
    assert plant.resets == [((), {}), ((), {"position": (0, 0, 1)})]
    masses = dpc.systems.OscillatingMasses()
    masses.reset(torch.ones(4))
    before = masses.measure()
    log = dpc.simulate(masses, dpc.DPCController(small_layer(), 3), Y_REF, steps=4, reset=False)
    expected = before
    for _ in range(T_INI):
        expected = masses.A @ expected
    torch.testing.assert_close(log.y[0], expected)


def test_a_controller_starts_every_run_anew():
    controller = dpc.DPCController(small_layer(0.0), replan_every=4)
    runs = [dpc.simulate(dpc.systems.OscillatingMasses(), controller, Y_REF, steps=6) for _ in range(2)]
    assert torch.equal(runs[0].u, runs[1].u) and torch.equal(runs[0].y, runs[1].y)


def test_progress_is_called_once_a_step():
    calls = []
    dpc.simulate(Recorder(), dpc.DPCController(small_layer(), 3), Y_REF, steps=5, progress=calls.append)
    assert calls == [1] * 5


# --- when there is no plan --------------------------------------------------------------------------------------------


def strict_layer():
    return dpc.DPCLayer(small_data(0.0), **SMALL, u_set=dpc.Box(-0.5, 0.5), y_set=dpc.Box(-1.0, 1.0))


def impossible(layer):
    layer.y_set = dpc.Box(50.0, 60.0)


def test_raise_is_the_default_and_names_the_failure():
    layer = strict_layer()
    impossible(layer)
    with pytest.raises(dpc.SolveError):
        dpc.DPCController(layer, 3).step(torch.zeros(3, 2), torch.zeros(3, 4))


def test_hold_goes_on_with_the_previous_plan():
    layer = strict_layer()
    controller = dpc.DPCController(layer, replan_every=4, on_failure="hold")
    u_ini, y_ini = torch.zeros(3, 2).double(), torch.zeros(3, 4).double()
    plan = layer(u_ini, y_ini, y_ref=Y_REF).u
    applied = []
    for k in range(10):
        if k == 4:
            impossible(layer)
        applied.append(controller.step(u_ini, y_ini, y_ref=Y_REF))
        assert (controller.status == dpc.Status.SOLVED) == (k < 4)
    torch.testing.assert_close(torch.stack(applied), torch.cat([plan, plan[-1:].expand(4, 2)]), rtol=0, atol=0)
    fresh = dpc.DPCController(layer, 3, on_failure="hold")
    assert torch.equal(fresh.step(u_ini, y_ini), torch.zeros(2, dtype=torch.float64))  # the nearest input to zero


def test_soften_plans_where_the_output_bounds_exclude_everything():
    layer = strict_layer()
    u_ini, y_ini = torch.zeros(3, 2).double(), torch.zeros(3, 4).double()
    controller = dpc.DPCController(layer, 3, on_failure="soften")
    assert torch.equal(controller.step(u_ini, y_ini, y_ref=Y_REF), layer(u_ini, y_ini, y_ref=Y_REF).u[0])
    assert controller.softened_by == 0
    impossible(layer)
    controller.reset()
    u = controller.step(u_ini, y_ini, y_ref=Y_REF)
    assert controller.status != dpc.Status.SOLVED and 0 < controller.softened_by <= 60
    assert torch.isfinite(u).all() and (u.abs() <= 0.5).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"replan_every": 0}, "`replan_every` must be an integer from 1 to the horizon, 6, got 0"),
        ({"replan_every": 7}, "got 7"),
        ({"replan_every": 2.0}, r"got 2\.0"),
        ({"replan_every": True}, "got True"),
        ({"replan_every": 3, "on_failure": "nan"}, "`on_failure` must be"),
    ],
    ids=str,
)
def test_bad_controllers_are_named(change, says):
    with pytest.raises(ValueError, match=says):
        dpc.DPCController(small_layer(), **change)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"y_ref": torch.ones(3)}, r"`y_ref` must have shape \(4,\) or \(>= steps, 4\), got \(1, 3\)|`y_ref`.*3"),
        ({"y_ref": torch.ones(4, 4)}, "`y_ref` must have at least `steps` = 5 rows, got 4"),
        ({"u_ref": torch.full((2,), torch.nan)}, "`u_ref` must be finite"),
        ({"steps": 0}, "`steps`"),
        ({"plant": dpc.systems.OscillatingMasses(3)}, "3 inputs and 6 outputs.* 2 and 4"),
    ],
    ids=lambda v: v[:20] if isinstance(v, str) else "",
)
def test_bad_runs_are_named(change, says):
    controller = dpc.DPCController(small_layer(), 3)
    with pytest.raises(ValueError, match=says):
        dpc.simulate(**{"plant": Recorder(), "controller": controller, "y_ref": Y_REF, "steps": 5, **change})


def test_a_plant_that_cannot_measure_makes_one_step_to_learn_its_output():
    class Bare:
        """Nothing but what a plant has to offer."""

        n_u, n_y, dt = 2, 4, 0.1

        def __init__(self):
            self.inner, self.steps = dpc.systems.OscillatingMasses(), 0
            self.reset = self.inner.reset

        def step(self, u):
            self.steps += 1
            return self.inner.step(u)

    plant = Bare()
    log = dpc.simulate(plant, dpc.DPCController(small_layer(), 3), Y_REF, steps=4, reset=False)
    assert plant.steps == 1 + 3 + 4 and log.y.shape == (4, 4)
