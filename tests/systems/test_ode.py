"""Nonlinear plants beside exact answers and an independent integrator."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from helpers import central, randn, relative
from torch_dpc.systems import CartPole, FourTanks, Ode
from torch_dpc.systems.four_tanks import AREA, GRAVITY, OUTLET

INTEGRATED = 1e-7  # of Runge-Kutta's fixed steps, against SciPy at 1e-12
SAME = 1e-13  # a batch and a single run round differently
TIGHT = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}


def spiral(x, u):
    """A damped rotation: dx/dt = -0.1 x + R x + u."""
    return -0.1 * x + torch.stack([-x[..., 1], x[..., 0]], dim=-1) + u


def test_runge_kutta_converges_with_the_fourth_order_to_the_exact_rotation():
    x0 = torch.tensor([1.0, 0.5], dtype=torch.float64)
    end = complex(1.0, 0.5) * np.exp(complex(-0.1, 1.0) * 0.4)
    exact = torch.tensor([end.real, end.imag], dtype=torch.float64)
    errors = []
    for substeps in (1, 2, 4):
        plant = Ode(spiral, n_x=2, n_u=2, dt=0.4, x0=x0, substeps=substeps)
        plant.reset()
        errors.append(float((plant.step([0.0, 0.0]) - exact).abs().max()))
    assert 12 < errors[0] / errors[1] < 20 and 12 < errors[1] / errors[2] < 20


@pytest.mark.parametrize("method", ["DOP853", "LSODA", "Radau"])
def test_an_adaptive_method_keeps_its_tolerance(method):
    plant = Ode(spiral, n_x=2, n_u=2, dt=0.4, method=method, rtol=1e-11, atol=1e-12)
    starts = randn(3, 2)
    plant.reset(starts)
    ended = torch.view_as_complex(plant.step([0.0, 0.0]).contiguous())
    exact = torch.view_as_complex(starts.contiguous()) * np.exp(complex(-0.1, 1.0) * 0.4)
    assert (ended - exact).abs().max() < 1e-8


def test_an_adaptive_method_refuses_derivatives():
    plant = Ode(spiral, n_x=2, n_u=2, dt=0.4, method="RK45")
    plant.reset()
    with pytest.raises(ValueError, match='`method="RK45"` has no derivatives'):
        plant.step(torch.zeros(2, dtype=torch.float64, requires_grad=True))


@pytest.mark.parametrize("method", ["rk4", "DOP853"])
@pytest.mark.parametrize("kind", [FourTanks, CartPole])
def test_a_batch_equals_its_single_runs(kind, method):
    plant = kind()
    plant.method = method
    us, starts = 1.0 + randn(5, 3, plant.n_u).abs(), plant.x0 + 0.1 * randn(3, 4, seed=1)
    together = torch.stack([plant.reset(starts), *[plant.step(u) for u in us]])
    for i in range(3):
        alone = torch.stack([plant.reset(starts[i]), *[plant.step(u[i]) for u in us]])
        torch.testing.assert_close(together[:, i], alone, rtol=0, atol=SAME)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"method": "euler"}, '`method` must be "rk4" or one of RK45'),
        ({"n_y": 1}, "`n_y` must be n_x = 2 where no `h` is given, got 1"),
        ({"substeps": 0}, "`substeps` must be a positive integer"),
        ({"f": lambda x, u: x[..., :1]}, r"`f` must return shape \(\*batch, n_x\) = \(3, 2\), got \(3, 1\)"),
        ({"h": lambda x, u: x, "n_y": 1}, r"`h` must return shape \(\*batch, n_y\) = \(3, 1\), got \(3, 2\)"),
    ],
    ids=lambda v: "" if isinstance(v, str) else next(iter(v)),
)
def test_bad_systems_are_named(change, says):
    with pytest.raises(ValueError, match=says):
        plant = Ode(**{"f": spiral, "n_x": 2, "n_u": 2, "dt": 0.1, **change})
        plant.reset(batch=3)
        plant.step([0.0, 0.0])


# --- four tanks -------------------------------------------------------------------------------------------------------


def tanks_in_numpy(phase):
    """Johansson's equation (1), written out tank by tank."""
    (k1, k2), (g1, g2) = {"minimum": ((3.33, 3.35), (0.7, 0.6)), "nonminimum": ((3.14, 3.29), (0.43, 0.34))}[phase]
    A1, A2, A3, A4 = 28.0, 32.0, 28.0, 32.0
    a1, a2, a3, a4 = 0.071, 0.057, 0.071, 0.057

    def f(t, h, v):
        q = np.sqrt(2 * 981.0 * h)
        return [
            -a1 / A1 * q[0] + a3 / A1 * q[2] + g1 * k1 / A1 * v[0],
            -a2 / A2 * q[1] + a4 / A2 * q[3] + g2 * k2 / A2 * v[1],
            -a3 / A3 * q[2] + (1 - g2) * k2 / A3 * v[1],
            -a4 / A4 * q[3] + (1 - g1) * k1 / A4 * v[0],
        ]

    return f


@pytest.mark.parametrize("phase", ["minimum", "nonminimum"])
def test_the_tanks_follow_an_independent_integrator(phase):
    plant, f = FourTanks(phase, all_levels=True), tanks_in_numpy(phase)
    h = plant.reset().numpy()
    for v in (3.0 + 0.5 * randn(20, 2)).numpy():
        h = solve_ivp(f, (0, plant.dt), h, args=(v,), **TIGHT).y[:, -1]
        np.testing.assert_allclose(plant.step(v).numpy(), h, rtol=0, atol=INTEGRATED)


@pytest.mark.parametrize(
    ("phase", "published"), [("minimum", (12.4, 12.7, 1.8, 1.4)), ("nonminimum", (12.6, 13.0, 4.8, 4.9))]
)
def test_the_operating_points_are_the_published_ones(phase, published):
    """The paper prints levels of the laboratory process; its model rests within a few millimetres of them."""
    plant = FourTanks(phase, all_levels=True)
    rest = plant.reset()
    torch.testing.assert_close(plant.step(plant.voltages), rest, rtol=0, atol=1e-12)
    np.testing.assert_allclose(tanks_in_numpy(phase)(0, rest.numpy(), plant.voltages.numpy()), 0, atol=1e-12)
    assert (rest - torch.tensor(published)).abs().max() < 0.5
    torch.testing.assert_close(plant.voltages_at_rest(rest[:2]), plant.voltages, rtol=0, atol=1e-12)


def test_a_draining_tank_obeys_torricelli_exactly():
    """Without inflow sqrt(h) falls linearly: sqrt(h(t)) = sqrt(h(0)) - a sqrt(2 g) t / (2 A), until it is empty."""
    plant = FourTanks(all_levels=True)
    start = torch.tensor([0.0, 0.0, 9.0, 16.0], dtype=torch.float64)
    plant.reset(start)
    for _ in range(5):
        h = plant.step([0.0, 0.0])
    for i in (2, 3):
        root = start[i].sqrt() - OUTLET[i] * (2 * GRAVITY) ** 0.5 * 5 * plant.dt / (2 * AREA[i])
        assert abs(float(h[i]) - float(root) ** 2) < INTEGRATED
    for _ in range(200):
        h = plant.step([-1.0, -1.0])  # a pump does not run backwards
    assert (h.abs() < 1e-3).all()


def test_derivatives_of_the_tanks_stay_finite_when_empty():
    plant = FourTanks()
    plant.reset(torch.zeros(4))
    v = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
    plant.step(v)
    y = plant.step(v)
    y.sum().backward()
    assert torch.isfinite(v.grad).all() and (v.grad > 0).all()


def test_the_response_of_the_nonminimum_phase_starts_in_the_other_tank():
    """With P+ more of pump 1 reaches tank 2 at rest than tank 1; with P- less."""
    for phase, direct in (("minimum", True), ("nonminimum", False)):
        plant = FourTanks(phase)
        gain = plant.levels_at_rest(plant.voltages + torch.tensor([0.1, 0.0])) - plant.x0
        assert (gain[0] > gain[1]) == direct


def test_bad_tanks_are_named():
    with pytest.raises(ValueError, match="`phase` must be one of minimum, nonminimum, got 'P-'"):
        FourTanks("P-")
    with pytest.raises(ValueError, match="`levels` cannot be held"):
        FourTanks().voltages_at_rest(torch.tensor([1.0, 20.0]))


# --- cart and pole ----------------------------------------------------------------------------------------------------


def lagrange(t, s, force):
    """The same vehicle from its Lagrangian: mass matrix times accelerations equals forces."""
    m_c, m_p, half, g = 1.0, 0.1, 0.5, 9.8
    _, dx, angle, rate = s
    inertia = m_p * half**2 + m_p * (2 * half) ** 2 / 12  # a rod about its end
    coupling = m_p * half * np.cos(angle)
    M = np.array([[m_c + m_p, coupling], [coupling, inertia]])
    forces = np.array([force + m_p * half * rate**2 * np.sin(angle), m_p * g * half * np.sin(angle)])
    ddx, turn = np.linalg.solve(M, forces)
    return [dx, ddx, rate, turn]


def test_the_pole_follows_an_independent_integrator_of_its_lagrangian():
    plant = CartPole()
    s = plant.reset([0.1, -0.3, 2.0, 1.0]).numpy()
    for force in (10 * randn(60)).tolist():
        s = solve_ivp(lagrange, (0, plant.dt), s, args=(force,), **TIGHT).y[:, -1]
        np.testing.assert_allclose(plant.step([force]).numpy(), s, rtol=0, atol=1e-6)


def test_without_a_force_energy_and_momentum_are_kept():
    plant = CartPole()

    def invariants(s):
        _, v, angle, rate = s.unbind(-1)
        m_c, m_p, half, g = 1.0, 0.1, 0.5, 9.8
        kinetic = 0.5 * (m_c + m_p) * v**2 + m_p * half * v * rate * angle.cos() + 0.5 * m_p * half**2 * 4 / 3 * rate**2
        return torch.stack([kinetic + m_p * g * half * angle.cos(), (m_c + m_p) * v + m_p * half * rate * angle.cos()])

    start = plant.reset([0.0, 0.2, 0.7, -1.0])
    for _ in range(250):
        end = plant.step([0.0])
    torch.testing.assert_close(invariants(end), invariants(start), rtol=0, atol=1e-5)


def test_the_unstable_pole_of_the_upright_pole():
    """Linearised: theta'' = g / (l (4/3 - m_p / (m_c + m_p))) theta, so a small angle grows with cosh."""
    plant = CartPole()
    growth = (9.8 / (0.5 * (4 / 3 - 0.1 / 1.1))) ** 0.5
    plant.reset([0.0, 0.0, 1e-6, 0.0])
    for _ in range(50):
        s = plant.step([0.0])
    assert float(s[2]) == pytest.approx(1e-6 * np.cosh(growth * 1.0), rel=1e-5)


def test_derivatives_through_time_against_differences():
    for plant, u in ((CartPole(), randn(6, 1)), (FourTanks(), 3.0 + randn(6, 2))):

        def end(us, plant=plant):
            plant.reset(plant.x0 + 0.1)
            return [plant.step(one) for one in us][-1]

        (gradient,) = torch.autograd.grad(end(us := u.requires_grad_()).sum(), us)
        assert relative(gradient, central(lambda v: end(v).sum(), u)) < 1e-8
