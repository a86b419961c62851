"""TorchQuadrotor against PyBullet, its derivatives, its batches and what it refuses."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch

from helpers import generator, randn, relative
from torch_dpc.systems import TorchQuadrotor, torch_quadrotor
from torch_dpc.systems.rigid_body import euler_angles, quaternion_of, rotation_matrix
from torch_dpc.systems.torch_quadrotor import GroundContactError

STEPS = 100  # 4 s
#: Rounding of 1000 physics steps [m, rad]; a vehicle that turns over amplifies it some 1e6 times in 4 s.
ROUNDING, TUMBLING = 1e-12, 1e-5


def commands(seed, amplitude, hold):
    draws = np.random.default_rng(seed).uniform(-amplitude, amplitude, size=(-(-STEPS // hold), 3))
    return torch.as_tensor(np.repeat(draws, hold, axis=0)[:STEPS])


def fly(plant, u):
    return torch.stack([plant.step(command) for command in u.unbind(-2)], dim=-2)


def gap(a, b):
    """Return the largest difference in position [m] and, across the wrap at +-pi, in attitude [rad]."""
    change = (a - b).abs()
    turn = torch.remainder(a[..., 3:] - b[..., 3:] + math.pi, 2 * math.pi) - math.pi
    return float(change[..., :3].max()), float(turn.abs().max())


@pytest.fixture
def bullet():
    quadrotor = pytest.importorskip("torch_dpc.systems.quadrotor")
    pytest.importorskip("pybullet")
    with quadrotor.Quadrotor() as plant:
        yield plant


# --- against PyBullet -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("amplitude", "hold", "height", "crashes", "tolerance"),
    [
        (0.3, 10, 1.0, 0, ROUNDING),
        (0.5, 10, 2.0, 0, ROUNDING),
        (1.0, 10, 4.0, 0, ROUNDING),
        (1.0, 1, 8.0, 0, 1e-9),  # redrawn every step: motors at their limits most of the time
        (5.0, 3, 60.0, 8, TUMBLING),  # turns over
    ],
)
def test_flights_are_those_of_pybullet(bullet, amplitude, hold, height, crashes, tolerance):
    source, seeds = np.random.default_rng(0), range(8)
    u = torch.stack([commands(seed, amplitude, hold) for seed in seeds])
    rpy = torch.as_tensor(source.uniform(-0.3, 0.3, (len(seeds), 3)))
    twin = TorchQuadrotor()
    start = twin.reset((0.1, -0.2, height), rpy)
    y = fly(twin, u)
    for seed in seeds:
        assert max(gap(start[seed], bullet.reset((0.1, -0.2, height), rpy[seed]))) < 1e-15
        assert max(gap(y[seed], fly(bullet, u[seed]))) < tolerance
        assert bool(twin.crashed[seed]) == bullet.crashed
    assert int(twin.crashed.sum()) == crashes


@pytest.mark.parametrize("physics_hz", [200, 500])
def test_other_rates_agree_too(physics_hz):
    pytest.importorskip("pybullet")
    from torch_dpc.systems import Quadrotor

    u = commands(0, 0.5, 10)
    with Quadrotor(physics_hz=physics_hz) as bullet:
        bullet.reset((0.0, 0.0, 2.0))
        expected = fly(bullet, u)
    twin = TorchQuadrotor(physics_hz)
    twin.reset((0.0, 0.0, 2.0))
    assert max(gap(fly(twin, u), expected)) < ROUNDING


def test_ground_contact_is_reported_when_pybullet_first_acts(bullet, monkeypatch):
    """Forty landings, level and tilted, slow and fast: exact until the report, which is at most one step early."""
    monkeypatch.setattr(torch_quadrotor, "_stopped", lambda grounded, after, before: after)  # flies on after a report
    landings, source = range(40), np.random.default_rng(0)
    u = torch.stack([commands(k, (0.3, 0.6, 1.0, 2.0)[k % 4], 5) for k in landings])
    u = (u - torch.tensor([0.0, 0.0, 0.3])).repeat_interleave(10, dim=1)
    rpy = torch.as_tensor(np.append(source.uniform(-0.5, 0.5, (len(landings), 2)), np.zeros((len(landings), 1)), 1))
    twin = TorchQuadrotor(ground="stop")
    twin.reset((0.0, 0.0, 0.25), rpy)
    places, reports = [], []
    for command in u.unbind(1):
        twin.state = twin._physics_step(twin.state, command)
        places.append(twin.measure())
        reports.append(twin.grounded)
    assert reports[-1].all()
    reported = torch.stack(reports).int().argmax(0).tolist()
    for k in landings:
        bullet.reset((0.0, 0.0, 0.25), rpy[k])
        gaps = []
        for step in range(reported[k] + 2):
            bullet._physics_step(u[k, step].numpy())
            gaps.append(max(gap(places[step][k], bullet.measure())))
        assert max(gaps[:-2]) < ROUNDING
        assert gaps[-1] > 1e-6


def test_free_fall_is_the_recursion_of_the_damped_fall():
    """With motors at their least thrust the fall is one scalar recursion, written down here on its own."""
    twin = TorchQuadrotor()
    twin.reset((0.0, 0.0, 50.0))
    y = fly(twin, torch.tensor([[0.0, 0.0, -0.5]], dtype=torch.float64).expand(25, 3))
    z, v = 50.0, 0.0
    for _ in range(250):
        thrust = max(0.5 * (-0.5 - v) + 0.027 * 9.8, 0.0)
        pwm = min(max((math.sqrt(thrust / (4 * 3.16e-10)) - 4070.3) / 0.2685, 20000.0), 65535.0)
        thrust = 4 * 3.16e-10 * (0.2685 * pwm + 4070.3) ** 2
        v += 0.004 * (thrust / 0.027 - 9.8 - v * (0.04 + 0.04 * abs(v)))
        z += 0.004 * v
    assert float(y[-1, 2]) == pytest.approx(z, abs=1e-11)


# --- attitudes --------------------------------------------------------------------------------------------------------


def test_angles_and_matrices_are_those_of_pybullet():
    pybullet = pytest.importorskip("pybullet")
    rpy = (2 * torch.rand(200, 3, dtype=torch.float64, generator=generator()) - 1) * torch.tensor([3.1, 1.5, 3.1])
    vertical = torch.tensor([[0.4, math.pi / 2, 0.1], [0.4, -math.pi / 2, 0.1]], dtype=torch.float64)
    for angles in torch.cat([rpy, vertical]):
        q = quaternion_of(angles)
        np.testing.assert_allclose(q, pybullet.getQuaternionFromEuler(angles.tolist()), atol=1e-15)
        matrix = np.reshape(pybullet.getMatrixFromQuaternion(q.tolist()), (3, 3))
        np.testing.assert_allclose(rotation_matrix(q), matrix, atol=1e-15)
        np.testing.assert_allclose(euler_angles(q), pybullet.getEulerFromQuaternion(q.tolist()), atol=1e-12)


def test_angles_have_finite_derivatives_everywhere():
    special = [[0.0, 0.0, 0.0], [math.pi, 0.0, 0.0], [0.3, math.pi / 2, 0.2], [0.3, -math.pi / 2, 0.2]]
    q = quaternion_of(torch.tensor(special, dtype=torch.float64)).requires_grad_()
    (gradient,) = torch.autograd.grad(euler_angles(q).sum(), q)
    assert gradient.isfinite().all()


# --- derivatives ------------------------------------------------------------------------------------------------------


def flight(start, u):
    """Return the outputs after the commands u `(*batch, steps, 3)` from `start` `(*batch, 6)`."""
    twin = TorchQuadrotor()
    twin.reset(start[..., :3], start[..., 3:])
    return fly(twin, u)[..., -1, :]


def check_gradients(start, u, step, tolerance):
    """Compare d end / d (start, u) with central differences: rows and differences are vehicles of a batch."""
    x = torch.cat([start, u.reshape(-1)])
    n = len(x)

    def end(vehicles):
        return flight(vehicles[:, :6], vehicles[:, 6:].unflatten(1, u.shape))

    copies = x.expand(6, n).clone().requires_grad_()
    (exact,) = torch.autograd.grad(end(copies).diagonal().sum(), copies)
    with torch.no_grad():
        change = step * torch.eye(n, dtype=x.dtype)
        differences = (end(x + change) - end(x - change)).T / (2 * step)
    assert exact.isfinite().all()
    assert relative(exact, differences) < tolerance


def test_gradients_of_a_flight_are_those_of_central_differences():
    for seed in range(3):
        start = 0.1 * randn(6, seed=seed) + torch.tensor([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
        check_gradients(start, commands(seed, 0.4, 5)[:20], 1e-6, 1e-7)


def test_gradients_at_hover_are_finite_and_right():
    """At rest speeds, rates and attitude errors are 0: norms and quotients of every kind have their kinks there."""
    start = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    check_gradients(start, torch.zeros(10, 3, dtype=torch.float64), 1e-5, 1e-6)


def test_a_vehicle_on_the_ground_has_no_influence_of_later_commands():
    twin = TorchQuadrotor(ground="stop")
    twin.reset(torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 1.0]]))
    down = torch.tensor([0.0, 0.0, -0.5], dtype=torch.float64).expand(20, 2, 3)
    fly(twin, down.transpose(0, 1))
    assert twin.grounded.tolist() == [True, False]
    u = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    before = twin.measure()
    after = twin.step(u)
    assert torch.equal(after[0], before[0])
    (gradient,) = torch.autograd.grad(after.sum(), u)
    assert not gradient[0].any()
    assert gradient[1].all()


# --- batches ----------------------------------------------------------------------------------------------------------


def test_a_batch_is_its_single_flights():
    u = torch.stack([commands(seed, 0.5, 5) for seed in range(6)])[:, :30].unflatten(0, (2, 3))
    twin = TorchQuadrotor()
    y = twin.reset((0.0, 0.0, 1.0), batch=(2, 3))
    assert y.shape == (2, 3, 6)
    together = fly(twin, u)
    for i, j in np.ndindex(2, 3):
        twin.reset()
        assert (fly(twin, u[i, j]) - together[i, j]).abs().max() < 1e-13


def test_batches_of_one_and_none_keep_their_shape():
    twin = TorchQuadrotor()
    assert twin.reset(batch=1).shape == twin.step(torch.zeros(3)).shape == (1, 6)
    assert twin.reset(batch=(0,)).shape == twin.step(torch.zeros(0, 3)).shape == (0, 6)
    assert twin.reset().shape == twin.step([0, 0, 0]).shape == (6,)
    assert twin.crashed.shape == ()


@pytest.mark.slow
def test_a_thousand_vehicles_fly_500_steps_with_planning_in_a_minute_of_processor_time():
    import time

    import torch_dpc as dpc

    twin = TorchQuadrotor()
    pull = {"feedback": lambda y: -0.3 * (y[:3] - torch.tensor([0.0, 0.0, 1.0])), "amplitude": 0.5, "hold": 10}
    u, y = dpc.collect(twin, 530, generator=generator(), **pull)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=6, horizon=25)
    Q = torch.diag(torch.tensor([10.0, 10.0, 10.0, 0.0, 0.0, 0.0]))
    layer = dpc.DPCLayer(data, Q, R=1.0, lambda_g=100.0, lambda_s=1e6, u_set=dpc.Box(-1.0, 1.0))
    angle = 2 * math.pi * (torch.rand(1000, 1, generator=generator()) + torch.arange(525) / 250)
    y_ref = torch.stack([0.3 * angle.cos(), 0.3 * angle.sin(), torch.ones_like(angle), *[0 * angle] * 3], dim=-1)
    begin = time.process_time()
    with torch.no_grad():
        log = dpc.simulate(twin, dpc.DPCController(layer), y_ref, steps=500, reset={"position": y_ref[:, 0, :3]})
    assert time.process_time() - begin < 60
    assert not twin.crashed.any()
    assert (log.y - log.y_ref)[:, 100:, :3].norm(dim=-1).mean() < 0.05


def test_the_state_can_be_kept_and_put_back():
    twin = TorchQuadrotor()
    u = commands(1, 0.5, 5)
    fly(twin, u[:20])
    kept = twin.snapshot()
    first = fly(twin, u[20:40])
    for other in (copy.deepcopy(twin), pickle.loads(pickle.dumps(twin)), twin):
        other.restore(kept)
        assert torch.equal(fly(other, u[20:40]), first)


# --- what is refused --------------------------------------------------------------------------------------------------


def test_contact_raises_and_names_the_vehicles():
    twin = TorchQuadrotor()
    twin.reset(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.08]]))
    before = twin.measure()
    with pytest.raises(GroundContactError, match=r"vehicles \[\[1\]\] of the batch touched the ground") as caught:
        for _ in range(20):
            before = twin.measure()
            twin.step([0.0, 0.0, -0.5])
    assert caught.value.vehicles.tolist() == [False, True]
    assert torch.equal(twin.measure(), before)


BAD_CALLS = {
    "rate": (lambda: TorchQuadrotor(240), "`physics_hz` must be a positive multiple of 25, .* got 240"),
    "ground": (lambda: TorchQuadrotor(ground="bounce"), '`ground` must be "raise" or "stop", got \'bounce\''),
    "low": (lambda: TorchQuadrotor().reset((0.0, 0.0, 0.05)), "above the ground, got z = 0.05"),
    "batch": (lambda: TorchQuadrotor().reset(torch.ones(4, 3), batch=(5,)), r"got batch \(5,\), position \(4,\)"),
    "one": (lambda: TorchQuadrotor().reset(torch.ones(4, 3), batch=1), r"must broadcast to `batch` = \(1,\)"),
    "command": (lambda: TorchQuadrotor().step([0.0, 0.0]), r"`u` must have shape \(3,\) or \(\*batch, 3\), got \(2,\)"),
    "commands": (lambda: TorchQuadrotor().step(torch.zeros(2, 3)), r"`u` must have shape \(3,\).*got \(2, 3\)"),
    "nan": (lambda: TorchQuadrotor().step([0.0, 0.0, math.nan]), "`u` must be finite"),
    "integers": (lambda: TorchQuadrotor().step(torch.zeros(3, dtype=torch.int64)), "floating-point"),
}


@pytest.mark.parametrize("case", BAD_CALLS)
def test_bad_input_is_named(case):
    call, message = BAD_CALLS[case]
    with pytest.raises(ValueError, match=message):
        call()


def test_it_says_what_it_is():
    twin = TorchQuadrotor(ground="stop")
    twin.reset(batch=(4,))
    assert "4 of 4 fly" in repr(twin)
