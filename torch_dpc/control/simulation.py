"""Collect data from a plant, and run it in closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from ..checks import as_data, check_count
from .controller import DPCController


class Plant(Protocol):
    """What a plant has to offer: sizes, a sampling time [s], `reset(...) -> y` and `step(u) -> y`."""

    @property
    def n_u(self) -> int:
        """Inputs."""

    @property
    def n_y(self) -> int:
        """Outputs."""

    @property
    def dt(self) -> float:
        """Sampling time [s]."""

    def reset(self, *args: Any, **kwargs: Any) -> Tensor:
        """Start anew and return the first measurement, `(n_y,)`."""

    def step(self, u: Tensor) -> Tensor:
        """Apply u, `(n_u,)`, for one step and return the measurement after it, `(n_y,)`."""


@dataclass(frozen=True, eq=False)
class ClosedLoopLog:
    """A run in closed loop; float64.

    Attributes:
        t: time [s], `(steps,)`; 0 is the first step under control.
        u: inputs applied, `(steps, n_u)`.
        y: true outputs, `(steps, n_y)`; y[k] is measured before u[k] is applied.
        y_ref: the reference, `(steps, n_y)`.
        p: what was added to y_ini at the plan in force, `(steps, t_ini, n_y)`.
        status: of the plan in force, a :class:`torch_dpc.Status`, `(steps,)`.
    """

    t: Tensor
    u: Tensor
    y: Tensor
    y_ref: Tensor
    p: Tensor
    status: Tensor


def collect(
    plant: Plant,
    steps: int,
    *,
    generator: torch.Generator | None = None,
    amplitude: Any = 1.0,
    hold: int = 1,
    feedback: Callable[[Tensor], Tensor] | None = None,
    reset: bool | Mapping[str, Any] = True,
) -> tuple[Tensor, Tensor]:
    """Record the plant under a random input, uniform between -amplitude and amplitude.

    Args:
        plant: the system.
        steps: T, samples to record.
        generator: the source of randomness.
        amplitude: largest input, a number or `(n_u,)`, in the plant's units.
        hold: steps for which each random input is kept; more excites slow motion more.
        feedback: y -> what is added to the input at every step, `(n_u,)`; it can keep an unstable plant in place.
        reset: whether to reset the plant first, or the arguments of its reset.

    Returns:
        u `(T, n_u)` and y `(T, n_y)`, float64; u[k] is applied at y[k].

    Example:
        >>> from torch_dpc.systems import OscillatingMasses
        >>> u, y = collect(OscillatingMasses(), 5, generator=torch.Generator().manual_seed(0))
        >>> u.shape, y.shape
        (torch.Size([5, 2]), torch.Size([5, 4]))
    """
    check_count("steps", steps)
    check_count("hold", hold)
    size = torch.as_tensor(amplitude, dtype=torch.float64).expand(plant.n_u)
    y = _start(plant, reset, torch.zeros(plant.n_u, dtype=torch.float64))
    inputs, outputs = [], []
    for k in range(steps):
        if k % hold == 0:
            random = size * (2 * torch.rand(plant.n_u, dtype=torch.float64, generator=generator) - 1)
        u = random if feedback is None else random + feedback(y)
        inputs.append(u)
        outputs.append(y)
        y = plant.step(u)
    return torch.stack(inputs), torch.stack(outputs)


def simulate(
    plant: Plant,
    controller: DPCController,
    y_ref: Any,
    *,
    steps: int,
    u_ref: Any = None,
    attack: Callable[..., Tensor] | None = None,
    generator: torch.Generator | None = None,
    reset: bool | Mapping[str, Any] = True,
    u_warmup: Any = 0.0,
    progress: Callable[[int], None] | None = None,
) -> ClosedLoopLog:
    """Run the plant in closed loop.

    The plant is reset, runs `t_ini` steps at `u_warmup` to fill the first window, and is then under control. An attack
    adds its p to the measured window whenever the controller plans; the plant itself never sees p.

    Args:
        plant: the system.
        controller: it is reset first.
        y_ref: reference, `(n_y,)` or a trajectory `(>= steps, n_y)` whose last row is held beyond its end.
        steps: steps under control.
        u_ref: input reference, `(n_u,)` or a trajectory, likewise; zero by default.
        attack: `(u_ini, y_ini, *, y_ref, u_ref, generator, step)` -> p, shape of y_ini.
        generator: handed to the attack.
        reset: whether to reset the plant, or the arguments of its reset. A plant that is not reset and has no
            `measure()` makes one more step at `u_warmup`, to learn its present output.
        u_warmup: input before step 0, a number or `(n_u,)`.
        progress: called with 1 after every step.

    Raises:
        ValueError: references that do not fit.
        SolveError: from the controller.
    """
    check_count("steps", steps)
    data = controller.layer.data
    if (plant.n_u, plant.n_y) != (data.n_u, data.n_y):
        raise ValueError(
            f"the plant has {plant.n_u} inputs and {plant.n_y} outputs, the controller's data {data.n_u} and "
            f"{data.n_y}."
        )
    y_refs = _trajectory("y_ref", y_ref, steps, data.n_y, data.horizon)
    u_refs = _trajectory("u_ref", torch.zeros(data.n_u) if u_ref is None else u_ref, steps, data.n_u, data.horizon)
    controller.reset()
    us, ys, ps, statuses = [], [], [], []
    warmup = torch.as_tensor(u_warmup, dtype=torch.float64).expand(data.n_u)
    y = _start(plant, reset, warmup)
    for _ in range(data.t_ini):
        us.append(warmup)
        ys.append(y)
        y = plant.step(warmup)
    p = torch.zeros(data.t_ini, data.n_y, dtype=torch.float64)
    for k in range(steps):
        u_ini, y_ini = torch.stack(us[-data.t_ini :]), torch.stack(ys[-data.t_ini :])
        window = {"y_ref": y_refs[k : k + data.horizon], "u_ref": u_refs[k : k + data.horizon]}
        if attack is not None and controller.replans_now:
            p = attack(u_ini, y_ini, **window, generator=generator, step=k)
        u = controller.step(u_ini, y_ini + p, **window)
        us.append(u)
        ys.append(y)
        ps.append(p)
        statuses.append(int(controller.status))
        y = plant.step(u)
        if progress is not None:
            progress(1)
    return ClosedLoopLog(
        t=torch.arange(steps, dtype=torch.float64) * plant.dt,
        u=torch.stack(us[data.t_ini :]),
        y=torch.stack(ys[data.t_ini :]),
        y_ref=y_refs[:steps],
        p=torch.stack(ps),
        status=torch.tensor(statuses),
    )


def _start(plant: Plant, reset: bool | Mapping[str, Any], u: Tensor) -> Tensor:
    """Reset the plant, or read its present output; a plant without `measure()` has to make a step at u for that."""
    if isinstance(reset, Mapping):
        return plant.reset(**reset)
    if reset:
        return plant.reset()
    measure = getattr(plant, "measure", None)
    return plant.step(u) if measure is None else measure()


def _trajectory(name: str, value: Any, steps: int, channels: int, horizon: int) -> Tensor:
    """Return a reference of steps + horizon rows."""
    tensor = as_data(name, value).double()
    if tensor.ndim == 1:
        tensor = tensor[None]
    elif tensor.ndim == 2 and len(tensor) < steps:
        raise ValueError(f"`{name}` must have at least `steps` = {steps} rows, got {len(tensor)}.")
    if tensor.ndim != 2 or tensor.shape[1] != channels:
        shapes = f"({channels},) or (>= steps, {channels})"
        raise ValueError(f"`{name}` must have shape {shapes}, got {tuple(tensor.shape)}.")
    missing = max(steps + horizon - len(tensor), 0)
    return torch.cat([tensor, tensor[-1:].expand(missing, channels)])
