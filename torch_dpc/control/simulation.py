"""Run a plant in closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, check_count
from ..systems.plant import Plant, Port, per_input
from .controller import DPCController
from .log import ClosedLoopLog


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
    data, port = controller.layer.data, Port(plant)
    if (port.n_u, port.n_y) != (data.n_u, data.n_y):
        raise ValueError(
            f"the plant has {port.n_u} inputs and {port.n_y} outputs, the controller's data {data.n_u} and "
            f"{data.n_y}."
        )
    y_refs = _trajectory("y_ref", y_ref, steps, data.n_y, data.horizon)
    u_refs = _trajectory("u_ref", torch.zeros(data.n_u) if u_ref is None else u_ref, steps, data.n_u, data.horizon)
    controller.reset()
    us, ys, ps, statuses = [], [], [], []
    warmup = per_input("u_warmup", u_warmup, data.n_u)
    y = port.start(reset, warmup)
    for _ in range(data.t_ini):
        us.append(warmup)
        ys.append(y)
        y = port.step(warmup)
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
        y = port.step(u)
        if progress is not None:
            progress(1)
    return ClosedLoopLog(
        t=torch.arange(steps, dtype=torch.float64) * port.dt,
        u=torch.stack(us[data.t_ini :]),
        y=torch.stack(ys[data.t_ini :]),
        y_ref=y_refs[:steps],
        p=torch.stack(ps),
        status=torch.tensor(statuses),
    )


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
