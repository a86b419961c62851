"""Any plant behind one interface, and its recordings."""

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import generator

EXACT = 1e-14  # NumPy and torch round a product differently


class Lag:
    """A first-order lag in NumPy, with an array that it edits in place: y+ = 0.9 y + 0.1 u."""

    n_u, n_y, dt = 1, 1, 0.1

    def reset(self, y=0.0):
        self.y = np.full(1, y)
        return self.y

    def step(self, u):
        assert isinstance(u, np.ndarray)
        self.y *= 0.9
        self.y += 0.1 * u
        u[:] = 99.0  # a careless plant writes into its input
        return self.y


class ListLag(Lag):
    """The same in lists."""

    def reset(self, y=0.0):
        return super().reset(y).tolist()

    def step(self, u):
        return super().step(u).tolist()


class TensorLag(dpc.systems.OscillatingMasses):
    """A plant in torch of lower precision."""

    def measure(self):
        return super().measure().float()


def recursion(u, y0=0.0):
    y = [y0]
    for value in u[:-1, 0].tolist():
        y.append(0.9 * y[-1] + 0.1 * value)
    return torch.tensor(y, dtype=torch.float64)[:, None]


@pytest.mark.parametrize("kind", [Lag, ListLag])
def test_arrays_and_lists_are_recorded_as_they_were_at_each_step(kind):
    u, y = dpc.collect(kind(), 30, generator=generator())
    assert u.dtype == y.dtype == torch.float64 and u.abs().max() <= 1
    torch.testing.assert_close(y, recursion(u), rtol=0, atol=EXACT)


def test_lower_precision_is_raised():
    u, y = dpc.collect(TensorLag(), 5, generator=generator())
    assert y.dtype == torch.float64 and torch.equal(y, y.float().double())


def test_a_numpy_plant_under_control():
    data = dpc.HankelData.from_trajectories(*dpc.collect(Lag(), 80, generator=generator()), t_ini=2, horizon=8)
    layer = dpc.DPCLayer(data, Q=1.0, R=1e-4, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-3.0, 3.0))
    log = dpc.simulate(Lag(), dpc.DPCController(layer, replan_every=1), torch.ones(1), steps=40, u_ref=torch.ones(1))
    assert abs(float(log.y[-1]) - 1.0) < 1e-6
    torch.testing.assert_close(log.y, recursion(log.u), rtol=0, atol=EXACT)


@pytest.mark.parametrize(
    "feedback", [None, lambda y: -0.5 * y, lambda y: (-0.5 * y).numpy()], ids=["no", "torch", "numpy"]
)
def test_an_operating_point_shifts_the_random_input(feedback):
    u, y = dpc.collect(
        Lag(), 200, generator=generator(), amplitude=0.2, offset=3.0, hold=5, reset={"y": 3.0}, feedback=feedback
    )
    excitation = u if feedback is None else u + 0.5 * y
    assert (excitation - 3.0).abs().max() <= 0.2 + EXACT and (excitation - 3.0).abs().max() > 0.15
    assert excitation.unfold(0, 5, 5).diff(dim=-1).abs().max() < EXACT  # held for five steps
    torch.testing.assert_close(y, recursion(u, 3.0), rtol=0, atol=EXACT)


def test_without_an_operating_point_the_bytes_are_those_of_a_plain_draw():
    u, _ = dpc.collect(Lag(), 4, generator=generator())
    source = generator()
    drawn = torch.stack([2 * torch.rand(1, dtype=torch.float64, generator=source) - 1 for _ in range(4)])
    assert torch.equal(u, drawn)


class Wrong(Lag):
    """Answers whatever it is told to, from a step on."""

    def __init__(self, answer, at=3, **attributes):
        self.answer, self.at, self.k = answer, at, 0
        self.__dict__.update(attributes)

    def step(self, u):
        self.k += 1
        return self.answer if self.k == self.at else super().step(u)


@pytest.mark.parametrize(
    ("plant", "says"),
    [
        (Wrong(np.zeros(2)), r"`y of Wrong after step 3` must have shape \(1,\), got \(2,\)"),
        (Wrong(np.zeros((4, 1))), r"after step 3` must have shape \(1,\), got \(4, 1\)"),
        (Wrong(0.5), r"after step 3` must have shape \(1,\), got \(\)"),
        (Wrong(None), "`y of Wrong after step 3` must hold floating-point numbers, got object"),
        (Wrong([1]), "after step 3` must hold floating-point numbers, got int64"),
        (Wrong([float("nan")]), "`y of Wrong after step 3` must be finite"),
        (
            Wrong([0.5], n_y=2),
            r"`y of Wrong from reset` must have shape \(\*batch, 2\), got \(1,\): `Wrong.n_y` is 2",
        ),
        (Wrong([0.5], n_u=0), "`Wrong.n_u` must be a positive integer, got 0"),
        (Wrong([0.5], dt=0.0), r"`Wrong.dt` must be a positive sampling time \[s\], got 0.0"),
        (object(), "`object.n_u` must be a positive integer, got None"),
    ],
    ids=lambda v: "" if isinstance(v, str) else type(v).__name__,
)
def test_what_does_not_fit_is_named_with_the_class_and_the_step(plant, says):
    with pytest.raises(ValueError, match=says):
        dpc.collect(plant, 5)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"steps": 0}, "`steps` must be a positive integer"),
        ({"hold": 0}, "`hold` must be a positive integer"),
        ({"amplitude": torch.ones(3)}, r"`amplitude` must be a number or have shape \(\*batch, 1\), got \(3,\)"),
        ({"offset": float("nan")}, "`offset` must be finite"),
        ({"feedback": lambda y: torch.zeros(2)}, r"`feedback\(y\)` must have shape \(\*batch, 1\), got \(2,\)"),
    ],
    ids=lambda v: "" if isinstance(v, str) else next(iter(v)),
)
def test_bad_recordings_are_named(change, says):
    with pytest.raises(ValueError, match=says):
        dpc.collect(Lag(), **{"steps": 5, **change})
