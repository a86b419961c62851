"""Linear plants beside the matrix exponential, and systems of python-control."""

import numpy as np
import pytest
import scipy.linalg
import torch

import torch_dpc as dpc
from helpers import generator, randn
from torch_dpc.systems import OscillatingMasses, StateSpace

EXACT = 1e-12
SAME = 1e-13  # a batch and a single run round differently
A, B, C, D = randn(3, 3), randn(3, 2, seed=1), randn(2, 3, seed=2), randn(2, 2, seed=3)
A = 0.9 * A / torch.linalg.eigvals(A).abs().max()


def test_outputs_are_the_sum_of_the_impulse_response():
    """y[k] = C A^k x0 + sum_j C A^(k-1-j) B u[j] + D u[k-1], with NumPy's matrix powers."""
    plant = StateSpace(A, B, C, D, dt=0.1, x0=[1.0, -1.0, 0.5])
    us = randn(12, 2, seed=4)
    ys = torch.stack([plant.reset(), *[plant.step(u) for u in us]])
    a, b, c, d = (m.numpy() for m in (A, B, C, D))
    for k, y in enumerate(ys):
        x = np.linalg.matrix_power(a, k) @ np.array([1.0, -1.0, 0.5])
        x = x + sum(np.linalg.matrix_power(a, k - 1 - j) @ b @ us[j].numpy() for j in range(k))
        exact = c @ x + (d @ us[k - 1].numpy() if k else 0.0)
        np.testing.assert_allclose(y.numpy(), exact, rtol=0, atol=EXACT)


def test_masses_follow_the_matrix_exponential():
    """dx/dt = M x + N u over a step: (M, N, 0) exponentiated by SciPy, the spring forces written out by hand."""
    M = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-2 * 3 / 2, 3 / 2, -0.2, 0], [3 / 2, -2 * 3 / 2, 0, -0.2]])
    N = np.vstack([np.zeros((2, 2)), np.eye(2) / 2])
    plant = OscillatingMasses(dt=0.3, mass=2.0, spring=3.0, damping=0.4)
    x, u = randn(4), randn(2, seed=1)
    plant.reset(x)
    whole = scipy.linalg.expm(0.3 * np.block([[M, N], [np.zeros((2, 6))]]))
    np.testing.assert_allclose(plant.step(u).numpy(), whole[:4] @ np.concatenate([x, u]), rtol=0, atol=EXACT)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_batch_equals_its_single_runs(noise):
    def plant(source):
        return StateSpace(A, B, C, D, dt=0.1, process_noise=noise, measurement_noise=noise / 2, generator=source)

    us, starts = randn(9, 5, 2, seed=4), randn(5, 3, seed=5)
    many = plant([generator(i) for i in range(5)])
    together = torch.stack([many.reset(starts), *[many.step(u) for u in us]])
    for i in range(5):
        one = plant(generator(i))
        alone = torch.stack([one.reset(starts[i]), *[one.step(u[i]) for u in us]])
        torch.testing.assert_close(together[:, i], alone, rtol=0, atol=SAME)


def test_noise_has_the_deviations_asked_for():
    plant = StateSpace(
        torch.zeros(2, 2), torch.zeros(2, 1), dt=1.0, process_noise=[0.3, 0.0], measurement_noise=[0.4, 0.2],
        generator=generator(),
    )  # fmt: skip
    plant.reset(batch=20000)
    y = plant.step([0.0])
    torch.testing.assert_close(y.std(0), torch.tensor([0.5, 0.2], dtype=torch.float64), rtol=0.03, atol=0)
    assert not torch.equal(plant.measure(), plant.measure())


def test_noise_is_the_generators():
    def run():
        plant = OscillatingMasses(noise=0.1, generator=generator(3))
        return torch.stack([plant.reset(), plant.step([0.0, 0.0])])

    assert torch.equal(run(), run())
    source = generator(3)
    drawn = torch.randn(4, dtype=torch.float64, generator=source)
    assert torch.equal(run()[0], 0.1 * drawn)


def test_steps_are_differentiable():
    plant = StateSpace(A, B, C, D, dt=0.1)

    def outputs(x0, us):
        plant.reset(x0)
        return torch.stack([plant.step(u) for u in us])

    x0, us = randn(3).requires_grad_(), randn(4, 2, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(outputs, (x0, us))


def test_snapshots_bring_a_run_back():
    plant = StateSpace(A, B, C, D, dt=0.1)
    plant.reset(batch=(2, 3))
    plant.step([1.0, 2.0])
    kept, y = plant.snapshot(), plant.measure()
    after = plant.step([0.3, -0.1])
    plant.restore(kept)
    assert torch.equal(plant.measure(), y) and torch.equal(plant.step([0.3, -0.1]), after)
    assert y.shape == (2, 3, 2)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"A": torch.ones(2, 3)}, r"`A` must be square, \(n_x, n_x\), got \(2, 3\)"),
        ({"B": torch.ones(2, 2)}, r"`B` must have shape \(n_x, n_u\) = \(3, \*\), got \(2, 2\)"),
        ({"C": torch.ones(2, 2)}, r"`C` must have shape \(n_y, n_x\) = \(\*, 3\), got \(2, 2\)"),
        ({"D": torch.ones(3, 2)}, r"`D` must have shape \(n_y, n_u\) = \(2, 2\), got \(3, 2\)"),
        ({"dt": 0.0}, "`dt` must be a positive"),
        ({"x0": [1.0]}, r"`x0` must have shape \(3,\), got \(1,\)"),
        ({"process_noise": -1.0}, "`process_noise` must be a number"),
        ({"measurement_noise": [1.0, 1.0, 1.0]}, r"`measurement_noise` must be a number or have shape \(2,\)"),
    ],
    ids=lambda v: "" if isinstance(v, str) else next(iter(v)),
)
def test_bad_models_are_named(arguments, says):
    with pytest.raises(ValueError, match=says):
        StateSpace(**{"A": A, "B": B, "C": C, "dt": 0.1, **arguments})


def test_bad_runs_are_named():
    plant = StateSpace(A, B, C, dt=0.1)
    with pytest.raises(ValueError, match=r"`state` must have shape \(3,\) or \(\*batch, 3\), got \(2,\)"):
        plant.reset(torch.ones(2))
    with pytest.raises(ValueError, match=r"`state` must have shape \(3,\) or \(4, 3\), got \(5, 3\)"):
        plant.reset(torch.ones(5, 3), batch=4)
    plant.reset(batch=4)
    with pytest.raises(ValueError, match=r"`u` must have shape \(4, 2\), got \(3, 2\)"):
        plant.step(torch.ones(3, 2))
    noisy = StateSpace(A, B, C, dt=0.1, measurement_noise=1.0, generator=[generator()] * 3)
    with pytest.raises(ValueError, match="`generator` must hold one generator a sample, got 3 for a batch of 4"):
        noisy.reset(batch=4)


# --- python-control ---------------------------------------------------------------------------------------------------


def test_a_python_control_system_under_control():
    control = pytest.importorskip("control", reason="the systems of python-control (extra `control`)")
    plant = StateSpace.from_control(control.tf([2.0], [1.0, 0.6, 1.0]), dt=0.2)
    data = dpc.HankelData.from_trajectories(*dpc.collect(plant, 100, generator=generator()), t_ini=3, horizon=15)
    layer = dpc.DPCLayer(data, Q=1.0, R=1e-4, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-2.0, 2.0))
    log = dpc.simulate(plant, dpc.DPCController(layer, 1), torch.ones(1), steps=80, u_ref=torch.tensor([0.5]))
    assert abs(float(log.y[-1]) - 1.0) < 1e-6


def test_a_continuous_system_is_discretised_as_python_control_does():
    control = pytest.importorskip("control", reason="the systems of python-control (extra `control`)")
    system = control.ss(*(m.numpy() for m in (A - torch.eye(3), B, C, D)))
    sampled = control.sample_system(system, 0.25, method="zoh")
    plant = StateSpace.from_control(system, dt=0.25, measurement_noise=0.0)
    np.testing.assert_allclose(plant.A.numpy(), sampled.A, rtol=0, atol=EXACT)
    np.testing.assert_allclose(plant.B.numpy(), sampled.B, rtol=0, atol=EXACT)
    again = StateSpace.from_control(sampled)
    assert again.dt == 0.25 and torch.equal(again.A, torch.as_tensor(sampled.A)) and again.D is not None
    with pytest.raises(ValueError, match=r"`dt` must be the system's sampling time, 0.25 s, or be left out, got 0.1"):
        StateSpace.from_control(sampled, dt=0.1)
    with pytest.raises(ValueError, match="`dt` must be given for a system whose own is 0"):
        StateSpace.from_control(system)
    with pytest.raises(ValueError, match="`dt` must be given for a system whose own is True"):
        StateSpace.from_control(control.ss(*(m.numpy() for m in (A, B, C, D)), dt=True))
