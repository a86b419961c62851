"""The quadrotor: physics with known answers, exact repetition, independence, and errors."""

import copy
import math
import pickle
import subprocess
import sys
from collections import namedtuple

import numpy as np
import pytest
import torch

from torch_dpc.systems import crazyflie_pid as pid

pybullet = pytest.importorskip("pybullet", reason="the quadrotor simulation needs pybullet (Python <= 3.11)")

from torch_dpc.systems import bullet_world  # noqa: E402
from torch_dpc.systems.quadrotor import Quadrotor  # noqa: E402

DRIFT = 0.01  # [m] in 10 s
SETTLED = 0.02  # [m/s]
HOVER = (0.0, 0.0, 0.0)


@pytest.fixture
def plant():
    with Quadrotor() as quadrotor:
        yield quadrotor


def fly(plant, commands):
    """Return the outputs before and after each command, (len(commands) + 1, 6)."""
    return torch.stack([plant.measure()] + [plant.step(u) for u in commands])


def commands(seed, steps, amplitude=0.3, hold=10):
    """Return random commands held for `hold` steps, (steps, 3)."""
    draws = np.random.default_rng(seed).uniform(-amplitude, amplitude, size=(-(-steps // hold), 3))
    return np.repeat(draws, hold, axis=0)[:steps]


# --- the vehicle -----------------------------------------------------------------------------------------------------


def test_it_is_a_plant_with_float64_outputs(plant):
    y = plant.reset(position=(0, 0, 1))  # whole numbers will do
    np.testing.assert_allclose(y, [0, 0, 1, 0, 0, 0], atol=1e-15)
    y = plant.reset(position=(0.1, -0.2, 1.5))
    assert (plant.n_u, plant.n_y, plant.dt) == (3, 6, 0.04)
    assert y.dtype == torch.float64
    np.testing.assert_allclose(y, [0.1, -0.2, 1.5, 0, 0, 0], atol=1e-15)


def test_urdf_and_constants_agree(plant):
    mass, inertia = plant._world.inertia()
    assert mass == pid.MASS
    assert inertia == pytest.approx(pid.INERTIA, rel=1e-12)


def test_thrust_at_hover_speed_is_the_weight():
    thrust, *torque = pid.wrench(np.full(4, pid.HOVER_RPM))
    assert thrust == pytest.approx(pid.MASS * pid.GRAVITY, rel=1e-14)
    assert np.abs(torque).max() < 1e-18
    assert pid.HOVER_RPM == pytest.approx(14468.43, abs=0.01)  # the figure known for this vehicle
    level = pid.CrazyfliePID(0.004).rpm(np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3))
    np.testing.assert_allclose(level, pid.HOVER_RPM, rtol=1e-14)


@pytest.mark.parametrize(
    "motor, signs", [(0, (-1, -1, -1)), (1, (-1, 1, 1)), (2, (1, 1, -1)), (3, (1, -1, 1))]
)  # front right, rear right, rear left, front left; 0 and 2 turn one way, 1 and 3 the other
def test_each_motor_turns_the_simulated_body_the_right_way(plant, motor, signs):
    rpm = np.full(4, pid.HOVER_RPM)
    rpm[motor] *= 1.02
    plant.reset()
    for _ in range(10):
        plant._world.advance(pid.wrench(rpm))
    np.testing.assert_array_equal(np.sign(plant._world.state().rpy), signs)


def test_angular_acceleration_is_torque_over_inertia(plant):
    torque = np.array([2e-5, -3e-5, 1e-5])
    plant._world.advance(np.array([pid.MASS * pid.GRAVITY, *torque]))
    # One step from rest at 250 Hz: angle = torque / inertia * dt^2, less the damping (1.6e-4) and the second order.
    np.testing.assert_allclose(plant._world.state().rpy, torque / pid.INERTIA * 0.004**2, rtol=1e-3)


def test_mixer_and_propellers_agree_in_sign():
    """A torque asked for about one axis gives that sign about that axis and (nearly) nothing about the others."""
    for axis in range(3):
        asked = np.zeros(3)
        asked[axis] = 1000.0
        pwm = 40000.0 + pid.MIXER @ asked
        torque = pid.wrench(pid.RPM_PER_PWM * pwm + pid.RPM_AT_ZERO_PWM)[1:]
        assert torque[axis] > 0
        assert np.abs(np.delete(torque, axis)).max() < 1e-10 < torque[axis]


def test_attitude_law_against_its_formula():
    dt, yaw = 0.004, 0.01
    rotation = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    rpy = np.array([0.0, 0.0, yaw])
    controller = pid.CrazyfliePID(dt)
    controller.reset(rpy)  # at rest there: no rate in the first step
    error = 2 * math.sin(yaw)
    hover_pwm = (pid.HOVER_RPM - 4070.3) / 0.2685
    for turned, integral in ((0.0, -dt * error), (0.001, -2 * dt * error)):
        rpm = controller.rpm(np.zeros(3), np.zeros(3), rotation, rpy + [0, 0, turned])
        torque = -60000 * error - 12000 * turned / dt + 500 * integral
        expected = 0.2685 * (hover_pwm + max(torque, -3200) * np.array([-1, 1, -1, 1])) + 4070.3
        np.testing.assert_allclose(rpm, expected, rtol=1e-12)


def test_free_fall_follows_gravity(plant):
    for _ in range(50):
        plant._world.advance(np.zeros(4))
    state = plant._world.state()
    assert state.velocity[2] == pytest.approx(-pid.GRAVITY * 0.2, rel=0.01)  # 0.4 % less: Bullet's damping
    np.testing.assert_allclose(state.velocity[:2], 0.0, atol=1e-15)


# --- the closed loop -------------------------------------------------------------------------------------------------


def test_hover_stays_for_ten_seconds(plant):
    y = fly(plant, [HOVER] * 250)
    assert (y[:, :3] - y[0, :3]).norm(dim=1).max() < DRIFT
    assert y[:, 3:].abs().max() < 1e-6
    assert not plant.crashed


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("speed", [0.3, -0.3])
def test_velocity_command_settles(plant, axis, speed):
    u = np.zeros(3)
    u[axis] = speed
    y = fly(plant, [u] * 60)
    velocity = (y[1:, :3] - y[:-1, :3]) / plant.dt
    np.testing.assert_allclose(velocity[35:], np.tile(u, (25, 1)), atol=SETTLED)
    assert velocity[0, axis].abs() < 0.5 * abs(speed)  # a vehicle with mass, not an integrator


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle", [0.3, -0.3])
def test_attitude_disturbance_is_brought_back(plant, axis, angle):
    rpy = np.zeros(3)
    rpy[axis] = angle
    start = plant.reset(rpy=rpy)
    np.testing.assert_allclose(start[3:], rpy, atol=1e-12)
    y = fly(plant, [HOVER] * 100)
    assert 0 < y[1, 3 + axis] / angle < 1  # towards zero from the first step on
    assert y[-1, 3:].abs().max() < 2e-3
    assert not plant.crashed


def test_refining_the_physics_step_converges():
    ends = []
    for physics_hz in (250, 500, 1000, 2000):
        with Quadrotor(physics_hz=physics_hz) as plant:
            ends.append(fly(plant, commands(0, 50)))
    gaps = [(fine - coarse)[:, :3].abs().max().item() for coarse, fine in zip(ends, ends[1:], strict=False)]
    assert gaps[0] < 1e-3  # [m], over a flight of 2 s
    # First order in the step: each gap is about half the one before.
    assert gaps[1] / gaps[0] == pytest.approx(0.5, abs=0.1)
    assert gaps[2] / gaps[1] == pytest.approx(0.5, abs=0.1)


# --- crashes ---------------------------------------------------------------------------------------------------------


def test_flying_into_the_ground_is_a_crash(plant):
    plant.reset(position=(0.0, 0.0, 0.2))
    y = plant.measure()
    while y[2] > 0.028:  # 0.012 m a step
        y = plant.step((0.0, 0.0, -0.3))
    assert y[2] > 0.0135  # where it would rest: close, but free
    assert not plant.crashed
    for _ in range(20):
        y = plant.step((0.0, 0.0, -0.3))
    assert plant.crashed
    assert y.isfinite().all()
    assert y[2] > 0  # the ground holds it
    plant.reset()
    assert not plant.crashed


def test_turning_over_in_the_air_is_a_crash(plant):
    plant.reset(position=(0.0, 0.0, 8.0))
    y = fly(plant, [(5.0, 0.0, 0.0)] * 5)
    assert not plant.crashed
    y = fly(plant, [(-5.0, 0.0, 2.0)] * 20)
    assert plant.crashed
    assert y[:, 2].min() > 1.0  # far from the ground
    assert y.isfinite().all()


def test_starting_upside_down_is_a_crash(plant):
    plant.reset(rpy=(math.pi, 0.0, 0.0))
    assert plant.crashed


# --- repetition and independence -------------------------------------------------------------------------------------


def test_same_commands_after_reset_give_the_same_bytes(plant):
    first = fly(plant, commands(1, 60))
    plant.step((2.0, -2.0, -2.0))  # leave integrators, rates and contacts in another state
    fly(plant, [(0.0, 0.0, -1.0)] * 80)
    assert plant.crashed
    plant.reset()
    assert fly(plant, commands(1, 60)).numpy().tobytes() == first.numpy().tobytes()
    with Quadrotor() as other:
        assert fly(other, commands(1, 60)).numpy().tobytes() == first.numpy().tobytes()


def test_interleaved_instances_fly_as_if_alone():
    scripts = [commands(2, 40), commands(3, 40)]
    alone = []
    for script in scripts:
        with Quadrotor() as plant:
            alone.append(fly(plant, script))
    with Quadrotor() as one, Quadrotor() as two:
        together = [[one.measure()], [two.measure()]]
        for u_one, u_two in zip(*scripts, strict=True):
            together[0].append(one.step(u_one))
            together[1].append(two.step(u_two))
        one.close()
        assert two.step(HOVER).isfinite().all()  # closing one leaves the other
    for lone, pair in zip(alone, together, strict=True):
        assert torch.stack(pair).numpy().tobytes() == lone.numpy().tobytes()
    assert not torch.equal(alone[0], alone[1])


def test_inputs_of_every_kind_are_the_same_command(plant):
    u = [0.1, -0.2, 0.3]
    outputs = []
    for value in (u, tuple(u), np.array(u), torch.tensor(u, dtype=torch.float64, requires_grad=True)):
        plant.reset()
        outputs.append(plant.step(value))
    assert all(torch.equal(y, outputs[0]) for y in outputs)


def test_outputs_and_inputs_are_not_shared(plant):
    u = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    y = plant.step(u)
    kept = y.clone()
    y.zero_()
    assert torch.equal(plant.measure(), kept)
    assert torch.equal(u, torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))


# --- pictures --------------------------------------------------------------------------------------------------------


def test_render_shows_the_vehicle_and_leaves_the_flight_alone(plant):
    script = commands(4, 20)
    unseen = fly(plant, script)
    plant.reset()
    seen = [plant.measure()]
    for k, u in enumerate(script):
        if k % 10 == 0:
            picture = plant.render(width=96, height=64)
        seen.append(plant.step(u))
    assert torch.equal(torch.stack(seen), unseen)
    assert picture.shape == (64, 96, 3)
    assert picture.dtype == np.uint8
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    assert (red - blue > 50).any()  # the orange front propellers; the ground is blue and white
    empty = plant.render(width=96, height=64, target=(5.0, 5.0, 1.0)).astype(int)
    assert not (empty[..., 0] - empty[..., 2] > 50).any()


# --- life cycle and errors -------------------------------------------------------------------------------------------


def test_close_is_idempotent_and_use_after_it_says_so():
    with Quadrotor() as plant:
        server = plant._world._server
        assert pybullet.isConnected(physicsClientId=server)
    assert plant.closed
    assert not pybullet.isConnected(physicsClientId=server)
    plant.close()
    for use in (plant.reset, plant.measure, plant.render, plant.__enter__, lambda: plant.step(HOVER)):
        with pytest.raises(RuntimeError, match="closed"):
            use()


def test_a_dropped_instance_gives_its_server_back():
    plant = Quadrotor()
    server = plant._world._server
    del plant
    assert not pybullet.isConnected(physicsClientId=server)


def test_an_open_instance_does_not_disturb_interpreter_exit():
    code = "from torch_dpc.systems.quadrotor import Quadrotor; plant = Quadrotor(); plant.step([0.0, 0.0, 0.0])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    assert "Error" not in done.stderr + done.stdout
    assert "Exception" not in done.stderr


@pytest.mark.parametrize("operation", [copy.deepcopy, copy.copy, pickle.dumps])
def test_copying_is_refused(plant, operation):
    with pytest.raises(TypeError, match="build one in each process"):
        operation(plant)


@pytest.mark.parametrize(
    "u, message",
    [
        ([0.0, 0.0], r"`u` must have shape \(3,\), got \(2,\)\."),
        (torch.zeros(1, 3), r"`u` must have shape \(3,\), got \(1, 3\)\."),
        ([0.0, math.nan, 0.0], "`u` must be finite, got"),
        (np.array([0.0, math.inf, 0.0]), "`u` must be finite, got"),
        (torch.zeros(3, dtype=torch.int64), r"`u` must hold floating-point numbers, got torch\.int64"),
        (np.zeros(3, dtype=bool), "`u` must hold floating-point numbers, got bool"),
        ([True, False, True], "`u` must hold floating-point numbers"),
        (["a", "b", "c"], "`u` must hold floating-point numbers"),
        ([0.0, [0.0], 0.0], "`u` must be a rectangular array of floats"),
        (None, "`u` must hold floating-point numbers"),
        (0.3, r"`u` must have shape \(3,\), got \(\)\."),
    ],
)
def test_a_bad_command_is_refused_and_changes_nothing(plant, u, message):
    before = plant.measure()
    with pytest.raises(ValueError, match=message):
        plant.step(u)
    assert torch.equal(plant.measure(), before)


def test_bad_arguments_are_refused(plant):
    with pytest.raises(ValueError, match=r"`position` must have shape \(3,\), got \(2,\)\."):
        plant.reset(position=(0.0, 1.0))
    with pytest.raises(ValueError, match="above the ground, got z = 0.05"):
        plant.reset(position=(0.0, 0.0, 0.05))
    with pytest.raises(ValueError, match="`rpy` must be finite"):
        plant.reset(rpy=(0.0, 0.0, math.nan))
    with pytest.raises(ValueError, match="got 0, 240"):
        plant.render(width=0)
    for physics_hz in (240, 0, -250, 250.0, True):
        with pytest.raises(ValueError, match="`physics_hz` must be a positive multiple of 25"):
            Quadrotor(physics_hz=physics_hz)


@pytest.mark.parametrize(
    ("python", "hint"),
    [((3, 11), r"pip install 'torch_dpc\[quadrotor\]'"), ((3, 13), r"up to Python 3\.11, .*TorchQuadrotor")],
)
def test_missing_pybullet_gives_the_install_hint(monkeypatch, python, hint):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with monkeypatch.context() as context, pytest.raises(ImportError, match=hint):
        context.setattr(sys, "version_info", namedtuple("Version", "major minor")(*python))
        Quadrotor()


def test_import_of_the_module_does_not_import_pybullet():
    code = "import sys, torch_dpc.systems.quadrotor; assert 'pybullet' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only X11 is looked for beforehand")
def test_gui_without_a_display_is_an_error_not_the_end_of_the_process(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="needs a display"):
        Quadrotor(gui=True)


def test_gui_opens_the_window_and_keeps_real_time(monkeypatch):
    """Checked without a display: the window's server is replaced by a headless one."""
    import time

    asked = []
    connect = pybullet.connect
    monkeypatch.setenv("DISPLAY", ":none")
    monkeypatch.setattr(pybullet, "connect", lambda mode: (asked.append(mode), connect(pybullet.DIRECT))[1])
    with Quadrotor(gui=True) as plant:
        begin = time.monotonic()
        fly(plant, [HOVER] * 5)
        assert time.monotonic() - begin >= 4 * plant.dt
    assert asked == [pybullet.GUI]


def test_a_refused_connection_is_an_error(monkeypatch):
    monkeypatch.setattr(pybullet, "connect", lambda mode: -1)
    with pytest.raises(RuntimeError, match="no physics server"):
        Quadrotor()
    assert bullet_world._import_pybullet() is pybullet
