"""Run a plant in closed loop, or thousands of them side by side."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..checks import (
    check_batch,
    check_callable,
    check_count,
    check_generator,
    check_has,
    check_type,
    warn_of_two_readings,
)
from ..systems.plant import Plant, Port, per_input
from .checkpoints import advance_with_checkpoints
from .controller import DPCController
from .log import ClosedLoopLog
from .loop import Attack, Detector, Loop, side_by_side
from .references import reference_trajectory


def simulate(
    plant: Plant,
    controller: DPCController,
    y_ref: Any,
    *,
    steps: int,
    u_ref: Any = None,
    attack: Attack | Sequence[Attack] | None = None,
    detector: Detector | None = None,
    generator: torch.Generator | Sequence[torch.Generator] | None = None,
    reset: bool | Mapping[str, Any] = True,
    batch: int | Sequence[int] | None = None,
    u_warmup: Any = 0.0,
    progress: Callable[[int], None] | None = None,
    checkpoint_every: int | None = None,
) -> ClosedLoopLog:
    """Run the plant in closed loop.

    The plant is reset, runs `t_ini` steps at `u_warmup` to fill the first window, and is then under control. An attack
    adds its p to the measured window whenever the controller plans; the plant itself never sees p.

    A plant whose outputs have a batch in front, `(*batch, n_y)`, is a batch of runs: all plans of a step are one call,
    and so are all attacks. Plants in torch carry a batch by `batch=`; :class:`torch_dpc.systems.Many` runs others side
    by side. Each run is what it would be alone, to rounding. What differs between runs has the batch in front: the
    arguments of the reset, the references, `u_warmup`, the sizes of a budget; a list of attacks or generators holds one
    a run.

    The log carries a graph to what the plant, the layer and the attack are made of, if the plant is differentiable.

    Args:
        plant: the system.
        controller: it is reset first.
        y_ref: reference, a number, `(n_y,)` or a trajectory `(*batch, >= steps, n_y)` whose last row is held beyond its
            end; for a batch of constants `(*batch, 1, n_y)`.
        steps: steps under control.
        u_ref: input reference, likewise; zero by default.
        attack: `(u_ini, y_ini, *, y_ref, u_ref, generator, step)` -> p, shape of y_ini, the windows `(*batch, t_ini,
            n)`; or a list of attacks, one a run.
        detector: judges every window that is planned from, after the attack; `log.alarm` tells, and a controller with
            `on_alarm="hold"` does not use the window.
        generator: handed to the attack; a list holds one a run.
        reset: whether to reset the plant, or the arguments of its reset. A plant that is not reset and has no
            `measure()` makes one more step at `u_warmup`, to learn its present output.
        batch: runs, a number or a shape: handed to the reset of the plant. By default the runs that the plant has.
        u_warmup: input before step 0, a number or `(*batch, n_u)`.
        progress: called with 1 after every step.
        checkpoint_every: with a graph, keep only the state every so many steps, and compute the steps in between again
            in the backward pass (:func:`torch.utils.checkpoint.checkpoint`): memory of `steps / checkpoint_every`
            states and `checkpoint_every` steps. The plant needs `snapshot()` and `restore(...)`, as plants in torch
            have, and an attack must depend on its arguments alone.

    Raises:
        ValueError: references that do not fit, or a batch that the plant does not carry.
        SolveError: from the controller.

    Example:
        >>> from torch_dpc import Box, DPCController, DPCLayer, HankelData, collect, simulate, systems
        >>> plant, generator = systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> data = HankelData.from_trajectories(*collect(plant, 120, generator=generator), t_ini=4, horizon=10)
        >>> layer = DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=Box(-1.0, 1.0))
        >>> starts = torch.randn(8, 4, generator=generator)
        >>> log = simulate(plant, DPCController(layer, 5), torch.zeros(4), steps=20, reset={"state": starts})
        >>> log.y.shape, log[3].y.shape
        (torch.Size([8, 20, 4]), torch.Size([20, 4]))
    """
    check_count("steps", steps)
    check_type("controller", controller, DPCController)
    check_generator(generator)
    check_callable("progress", progress, optional=True)
    data, port = controller.layer.data, Port(plant)
    if (port.n_u, port.n_y) != (data.n_u, data.n_y):
        raise ValueError(
            f"`plant` has {port.n_u} inputs and {port.n_y} outputs, which must be those of the controller's data, "
            f"{data.n_u} and {data.n_y}."
        )
    y_refs = reference_trajectory("y_ref", y_ref, steps, data.n_y, data.horizon)
    u_refs = reference_trajectory(
        "u_ref", torch.zeros(data.n_u) if u_ref is None else u_ref, steps, data.n_u, data.horizon
    )
    controller.reset()
    if isinstance(attack, str) or not isinstance(attack, Sequence):
        check_callable("attack", attack, optional=True)
        if (on := getattr(attack, "on", "y_ini")) != "y_ini":
            raise ValueError(f"`attack` must be an attack on y_ini, got one on {on}.")
    else:
        attack = side_by_side(attack)
    if detector is not None:
        check_has("detector", detector, "a detector, such as a ConsistencyDetector or a Cusum", "monitor")
    if detector is not None and checkpoint_every is not None:
        raise ValueError("`detector` must be left out with `checkpoint_every`: a detector may have a memory.")
    loop = Loop(port, controller, y_refs, u_refs, attack, generator, detector)
    loop.warm_up(_with_batch(plant, reset, batch), per_input("u_warmup", u_warmup, data.n_u))
    _share_references(loop, batch, y_ref, u_ref)
    if checkpoint_every is None:
        u, y, p, status, replanned, alarm = loop.advance(range(steps), progress)
    else:
        u, y, p, status, replanned, alarm = advance_with_checkpoints(
            loop, steps, check_count("checkpoint_every", checkpoint_every), progress
        )
    return ClosedLoopLog(
        t=torch.arange(steps, dtype=torch.float64) * port.dt,
        u=u,
        y=y,
        y_ref=y_refs[..., :steps, :].expand(y.shape),
        p=p,
        status=status,
        replanned=replanned,
        alarm=alarm,
    )


def _with_batch(
    plant: Plant, reset: bool | Mapping[str, Any], batch: int | Sequence[int] | None
) -> bool | Mapping[str, Any]:
    """Return the arguments of the reset with the batch among them."""
    if batch is None or reset is False:
        return reset
    accepted = inspect.signature(plant.reset).parameters
    if "batch" not in accepted and not any(p.kind is p.VAR_KEYWORD for p in accepted.values()):
        raise ValueError(
            f"`batch` must be left out for {type(plant).__name__}, whose reset takes no batch: put several plants side "
            "by side with torch_dpc.systems.Many."
        )
    arguments = dict(reset) if isinstance(reset, Mapping) else {}
    return {**arguments, "batch": check_batch("batch", batch)}


def _share_references(loop: Loop, batch: int | Sequence[int] | None, y_ref: Any, u_ref: Any) -> None:
    """Give every run its references.

    Raises:
        ValueError: the plant, the references and what was asked for differ in their runs.
    """
    runs = loop.batch
    if batch is not None and runs != check_batch("batch", batch):
        raise ValueError(f"`batch` is {batch!r}, and the plant runs {tuple(runs)}.")
    loop.y_refs = _of_runs("y_ref", y_ref, loop.y_refs, runs)
    loop.u_refs = _of_runs("u_ref", u_ref, loop.u_refs, runs)


def _of_runs(name: str, given: Any, reference: Tensor, runs: torch.Size) -> Tensor:
    """Return a reference with the runs of the plant in front, `(*runs, rows, n)`.

    Raises:
        ValueError: it has other runs.
    """
    if isinstance(given, Tensor) and given.ndim == 2 and runs and len(given) == runs[-1] > 1:
        warn_of_two_readings(name, given, "runs", stacklevel=5)
    try:
        return reference.expand(*runs, *reference.shape[-2:])
    except RuntimeError as error:
        own = tuple(reference.shape[:-2])
        raise ValueError(f"`{name}` has the runs {own} in front, and the plant runs {tuple(runs)}.") from error
