"""Four plants to follow a reference on: linear, affine, unstable, flying; each with its recording and its task.

The reference for all data-driven plans is model predictive control with the true model, linearised at the operating
point by its Jacobian. It is the same problem on a noise-free recording of the linear model (Willems' lemma makes the
two the same).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import torch_dpc as dpc

FAINT = 1e-3  # deviations of the linear model, relative to the plant's: at these no feedback saturates
ATTEMPT_SEED = 1000  # of the task, apart from the recording's


def generator_of(seed: int) -> torch.Generator:
    """Return a source of randomness."""
    return torch.Generator().manual_seed(seed)


@dataclass(frozen=True)
class PlantCase:
    """A plant, how it is recorded, and what it has to follow.

    Attributes:
        name: of the setting.
        make: the plant with a noise level and its generator.
        noise: standard deviation of each measured output, `(n_y,)`.
        u0, y0: the operating point, `(n_u,)` and `(n_y,)`.
        amplitude, hold, feedback: of the recorded input around u0.
        recordings, samples: how many runs, and samples of each.
        spread: standard deviation of the states or positions at which recordings start; None starts each at rest.
        starts: (deviation) `(runs, ...)` -> arguments of the reset.
        start: deviation at which the task starts, and
        start_spread: its standard deviation over the seeds.
        twin: the plant in torch, to linearise; None where `make` returns one.
        y_ref: the reference, `(steps, n_y)`.
        steps, replan_every: of the task.
        channels: whose error counts.
        unit: of the error.
        worst: an error at which the task counts as lost; errors are cut there.
        weights: of the problem, with t_ini and horizon beside.
        k, lambda_near: windows that are selected, and what their g is charged.
    """

    name: str
    make: Callable[[Tensor, torch.Generator], Any]
    noise: Tensor
    u0: Tensor
    y0: Tensor
    amplitude: Any
    y_ref: Tensor
    channels: list[int]
    unit: str
    worst: float
    t_ini: int
    horizon: int
    weights: dict[str, Any]
    k: int
    lambda_near: float
    starts: Callable[[Tensor], dict[str, Any]]
    spread: Tensor
    hold: int = 1
    feedback: Callable[[Tensor], Tensor] | None = None
    recordings: int = 1
    samples: int = 400
    replan_every: int = 2
    start: float | Tensor = 0.0
    start_spread: Tensor = field(default_factory=lambda: torch.zeros(1, dtype=torch.float64))
    twin: Callable[[], Any] | None = None

    def data(self, seed: int) -> dpc.HankelData:
        """Return a recording."""
        source = generator_of(seed)
        starts = self.spread * torch.randn(self.recordings, len(self.spread), dtype=torch.float64, generator=source)
        return self._record(
            self.make(self.noise, source), source, offset=self.u0, feedback=self.feedback,
            reset=self.starts(starts if self.recordings > 1 else starts[0]),
        )  # fmt: skip

    def model(self) -> dpc.systems.StateSpace:
        """Return the true model, linearised at the operating point: deviations from it, without noise."""
        plant = self.make(0 * self.noise, generator_of(0)) if self.twin is None else self.twin()
        plant.reset(**self.starts(0 * self.spread))
        return linearised(plant, self.u0)

    def data_of_model(self, seed: int) -> dpc.HankelData:
        """Return a recording of the linearised model around the operating point."""
        around = self.feedback
        feedback = None if around is None else lambda y: around(self.y0 + FAINT * y) / FAINT
        reset = {"batch": self.recordings} if self.recordings > 1 else {}
        return self._record(self.model(), generator_of(seed), feedback=feedback, reset=reset, at=(self.u0, self.y0))

    def _record(self, plant: Any, source: torch.Generator, *, at: Any = (0.0, 0.0), **options: Any) -> dpc.HankelData:
        """Return a recording of a plant, moved to an operating point."""
        amplitude = torch.as_tensor(self.amplitude, dtype=torch.float64)
        u, y = dpc.collect(plant, self.samples, generator=source, amplitude=amplitude, hold=self.hold, **options)
        u, y = (w + place if w.ndim == 3 else w[None] + place for w, place in zip((u, y), at, strict=True))
        return dpc.HankelData.from_trajectories(list(u), list(y), t_ini=self.t_ini, horizon=self.horizon)

    def follow(self, planner: Any, seed: int) -> dpc.ClosedLoopLog:
        """Return one run of the task."""
        source = generator_of(ATTEMPT_SEED + seed)
        drawn = torch.randn(len(self.spread), dtype=torch.float64, generator=source)
        start = self.start + self.start_spread * drawn
        return dpc.simulate(
            self.make(self.noise, source), dpc.DPCController(planner, self.replan_every, on_failure="hold"), self.y_ref,
            steps=len(self.y_ref), u_ref=self.u0, u_warmup=self.u0, reset=self.starts(start),
        )  # fmt: skip


def linearised(plant: Any, u0: Tensor) -> dpc.systems.StateSpace:
    """Return the model of a torch plant's deviations from where it stands, under inputs around u0, by its Jacobian."""
    here = plant.snapshot()
    parts = [x for x in here if x.is_floating_point()]
    sizes = [x.numel() for x in parts]

    def flat(snapshot: tuple[Tensor, ...]) -> Tensor:
        return torch.cat([x.reshape(-1) for x in snapshot if x.is_floating_point()])

    def put(state: Tensor) -> None:
        moved = iter(x.reshape(like.shape) for x, like in zip(state.split(sizes), parts, strict=True))
        plant.restore(tuple(next(moved) if x.is_floating_point() else x for x in here))

    def step(state: Tensor, u: Tensor) -> Tensor:
        put(state)
        plant.step(u)
        return flat(plant.snapshot())

    def measure(state: Tensor) -> Tensor:
        put(state)
        y: Tensor = plant.measure()
        return y

    A, B = torch.autograd.functional.jacobian(step, (flat(here), u0))
    return dpc.systems.StateSpace(A, B, torch.autograd.functional.jacobian(measure, flat(here)), dt=plant.dt)


def row(*values: float) -> Tensor:
    """Return numbers as a float64 vector."""
    return torch.tensor(values, dtype=torch.float64)


def steps_between(levels: list[Tensor], each: int) -> Tensor:
    """Return a staircase, `(len(levels) each, n)`."""
    return torch.stack(levels).repeat_interleave(each, dim=0)


def masses() -> PlantCase:
    """The paper's masses: displaced by half a metre, and back."""
    displaced = row(0.5, 0.5, 0.0, 0.0)
    return PlantCase(
        name="oscillating masses",
        make=lambda noise, source: dpc.systems.StateSpace(
            dpc.systems.OscillatingMasses().A, dpc.systems.OscillatingMasses().B, dt=0.1, measurement_noise=noise,
            generator=source,
        ),  # fmt: skip
        noise=row(*4 * [0.01]), u0=row(0.0, 0.0), y0=row(*4 * [0.0]), amplitude=1.0,
        y_ref=steps_between([displaced, 0 * displaced], 100), channels=[0, 1], unit="m", worst=2.0,
        t_ini=4, horizon=20, k=150, lambda_near=1.0, starts=lambda x: {"state": x}, spread=row(*4 * [0.0]),
        weights={"Q": torch.diag(row(10.0, 10.0, 1.0, 1.0)), "R": 0.01, "lambda_g": 100.0, "lambda_s": 1e4,
                 "u_set": dpc.Box(-2.0, 2.0)},
    )  # fmt: skip


def four_tanks() -> PlantCase:
    """The quadruple tanks: both lower levels up by 3 cm, then down by 3 cm, from about 12.5 cm."""
    tanks = dpc.systems.FourTanks()
    y0 = tanks.x0[:2]
    return PlantCase(
        name="four tanks",
        make=lambda noise, source: dpc.systems.FourTanks(measurement_noise=noise, generator=source),
        noise=row(0.02, 0.02), u0=tanks.voltages, y0=y0, amplitude=1.5, hold=4, samples=800,
        y_ref=steps_between([y0 + 3.0, y0 - 3.0], 80), channels=[0, 1], unit="cm", worst=6.0,
        t_ini=3, horizon=20, k=250, lambda_near=1.0, starts=lambda x: {"state": tanks.x0 + 0 * x},
        spread=row(*4 * [0.0]),
        weights={"Q": 1.0, "R": 0.0, "R_du": 0.1, "lambda_g": 10.0, "lambda_s": 1e3, "u_set": dpc.Box(0.0, 8.0)},
    )  # fmt: skip


def cart_pole() -> PlantCase:
    """The pole on a cart: held upright from angles of about 0.3 rad, recorded under a clumsy feedback."""
    gain = row(1.0, 2.0, 30.0, 6.0)
    return PlantCase(
        name="cart-pole",
        make=lambda noise, source: dpc.systems.CartPole(dt=0.05, measurement_noise=noise, generator=source),
        noise=row(*4 * [1e-3]), u0=row(0.0), y0=row(*4 * [0.0]), amplitude=5.0,
        feedback=lambda y: (y @ gain).clamp(-12.0, 12.0)[..., None],
        recordings=60, samples=50, spread=row(0.5, 0.5, 0.6, 1.0), start_spread=row(0.0, 0.0, 0.3, 0.0),
        y_ref=torch.zeros(60, 4, dtype=torch.float64), channels=[2], unit="rad", worst=math.pi,
        t_ini=2, horizon=15, k=100, lambda_near=100.0, replan_every=1, starts=lambda x: {"state": x},
        weights={"Q": torch.diag(row(2.0, 0.1, 20.0, 0.1)), "R": 0.005, "lambda_g": 100.0, "lambda_s": 1e4,
                 "u_set": dpc.Box(-15.0, 15.0), "regularizer": "identity"},
    )  # fmt: skip


class Vehicle(dpc.systems.Quadrotor):
    """The quadrotor with noise on its outputs."""

    def __init__(self, noise: Tensor, source: torch.Generator):
        self.noise, self.source = noise, source
        super().__init__()

    def measure(self) -> Tensor:
        y = super().measure()
        return y + self.noise * torch.randn(y.shape, dtype=y.dtype, generator=self.source)


def quadrotor() -> PlantCase:
    """The Crazyflie of Figure 4 on a circle of 0.3 m at 1 m, 10 s around."""
    centre = row(0.0, 0.0, 1.0)
    angle = 2 * math.pi / 10.0 * 0.04 * torch.arange(250, dtype=torch.float64)
    flat = torch.zeros(250, 3, dtype=torch.float64)
    circle = torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1)
    limit = row(2.0, 2.0, 1.0, *3 * [math.pi / 8])
    y0 = torch.cat([centre, flat[0]])
    return PlantCase(
        name="quadrotor", make=Vehicle, noise=row(*3 * [1e-3], *3 * [1e-3]), u0=row(0.0, 0.0, 0.0), y0=y0,
        amplitude=0.5, hold=10, feedback=lambda y: -0.3 * y[..., :3], samples=530,
        y_ref=torch.cat([centre + 0.3 * circle, flat], dim=1), channels=[0, 1, 2], unit="m", worst=2.0,
        t_ini=6, horizon=25, k=300, lambda_near=1.0, replan_every=5, spread=row(0.0, 0.0, 0.0),
        starts=lambda x: {"position": centre + x}, start=0.3 * circle[0], twin=dpc.systems.TorchQuadrotor,
        weights={"Q": torch.diag(row(10.0, 10.0, 10.0, 0.0, 0.0, 0.0)), "R": 1.0, "lambda_g": 100.0, "lambda_s": 1e4,
                 "u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.SoftBox(y0 - limit, y0 + limit, 1e3)},
    )  # fmt: skip


CASES: dict[str, Callable[[], PlantCase]] = {
    "masses": masses, "four_tanks": four_tanks, "cart_pole": cart_pole, "quadrotor": quadrotor,
}  # fmt: skip
