"""What a plant is, and how the package talks to one: sizes, `reset`, `step`, and `collect` to record it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from ..checks import as_data, as_numbers, check_callable, check_count, check_flag, check_generator


class Plant(Protocol):
    """What a plant has to offer.

    Outputs may be tensors, NumPy arrays or lists of floats, `(n_y,)`, or `(*batch, n_y)` if the plant carries several
    runs. A plant that answers in tensors is given tensors; one that answers in arrays or lists is given arrays.
    A method `measure() -> y` is optional: it returns the present outputs without advancing time.

    Example:
        >>> import numpy as np
        >>> class Lag:
        ...     n_u, n_y, dt = 1, 1, 0.1
        ...     def reset(self):
        ...         self.y = np.zeros(1)
        ...         return self.y
        ...     def step(self, u):
        ...         self.y = 0.9 * self.y + 0.1 * u
        ...         return self.y
        >>> u, y = collect(Lag(), 40, generator=torch.Generator().manual_seed(0))
        >>> y.shape
        torch.Size([40, 1])
    """

    @property
    def n_u(self) -> int:
        """Inputs."""

    @property
    def n_y(self) -> int:
        """Outputs."""

    @property
    def dt(self) -> float:
        """Sampling time [s]."""

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        """Start a new run and return the first measurement, `(*batch, n_y)`."""

    def step(self, u: Any) -> Any:
        """Apply u, `(*batch, n_u)`, for one step and return the measurement after it, `(*batch, n_y)`."""


@runtime_checkable
class Resumable(Protocol):
    """A plant that can go back to where it was; plants in torch can."""

    def snapshot(self) -> tuple[Tensor, ...]:
        """Return what decides the future together with the inputs to come."""

    def restore(self, snapshot: tuple[Tensor, ...]) -> None:
        """Continue from a snapshot."""


class Port:
    """One interface to every plant: float64 tensors in and out, with every answer checked.

    Outputs are copied, so that a plant may reuse its arrays; a graph behind tensor outputs is kept.

    Args:
        plant: any :class:`Plant`.

    Attributes:
        batch: shape in front of `(n_y,)` of the plant's outputs; known after the first answer.

    Raises:
        ValueError: sizes or a sampling time that are missing or not positive; outputs that do not fit, with the plant's
            class and the step.
    """

    def __init__(self, plant: Plant):
        self.plant, self.name = plant, type(plant).__name__
        for size in ("n_u", "n_y"):
            check_count(f"{self.name}.{size}", getattr(plant, size, None))
        dt = getattr(plant, "dt", None)
        if not isinstance(dt, Real) or not 0 < float(dt) < math.inf:
            raise ValueError(f"`{self.name}.dt` must be a positive sampling time [s], got {dt!r}.")
        self.n_u, self.n_y, self.dt = int(plant.n_u), int(plant.n_y), float(dt)
        self.batch: torch.Size | None = None
        self._answers_in_tensors = True
        self._steps = 0

    def start(self, reset: bool | Mapping[str, Any], u: Tensor) -> Tensor:
        """Reset the plant or read its present outputs.

        Args:
            reset: whether to reset, or the arguments of the reset.
            u: input of one step that a plant without `measure()` makes if it is not reset, `(n_u,)`.
        """
        self.batch, self._steps = None, 0
        if not isinstance(reset, Mapping):
            check_flag("reset", reset)
        if isinstance(reset, Mapping):
            return self._accept(self.plant.reset(**reset), "from reset")
        if reset:
            return self._accept(self.plant.reset(), "from reset")
        measure = getattr(self.plant, "measure", None)
        return self.step(u) if measure is None else self._accept(measure(), "from measure")

    def step(self, u: Tensor) -> Tensor:
        """Apply u, `(*batch, n_u)`, and return the outputs after the step, `(*batch, n_y)`."""
        # An array of its own: a plant may write into its input.
        y = self.plant.step(u if self._answers_in_tensors else u.detach().cpu().numpy().copy())
        self._steps += 1
        return self._accept(y, f"after step {self._steps}")

    def _accept(self, answer: Any, when: str) -> Tensor:
        y = as_data(f"y of {self.name} {when}", answer)
        batch = y.shape[:-1] if self.batch is None else self.batch
        if y.shape != (*batch, self.n_y):
            expected = f"(*batch, {self.n_y})" if self.batch is None else f"{(*batch, self.n_y)}"
            raise ValueError(
                f"`y of {self.name} {when}` must have shape {expected}, got {tuple(y.shape)}: "
                f"`{self.name}.n_y` is {self.n_y}."
            )
        self.batch, self._answers_in_tensors = batch, isinstance(answer, Tensor)
        return y.clone() if y.dtype == torch.float64 else y.double()


def collect(
    plant: Plant,
    steps: int,
    *,
    generator: torch.Generator | None = None,
    amplitude: Any = 1.0,
    offset: Any = None,
    hold: int = 1,
    feedback: Callable[[Tensor], Any] | None = None,
    reset: bool | Mapping[str, Any] = True,
) -> tuple[Tensor, Tensor]:
    """Record the plant under a random input, uniform between offset - amplitude and offset + amplitude.

    A progress bar appears on a terminal if the recording takes longer than two seconds and tqdm is installed.

    Args:
        plant: the system.
        steps: T, samples to record.
        generator: the source of randomness.
        amplitude: largest deviation of the random input, a number or `(n_u,)`, in the plant's units.
        offset: the input of the operating point, a number or `(n_u,)`; zero by default.
        hold: steps for which each random input is kept; more excites slow motion more.
        feedback: y -> what is added to the input at every step, `(*batch, n_u)`; it can keep an unstable plant in
            place.
        reset: whether to reset the plant first, or the arguments of its reset.

    Returns:
        u `(*batch, T, n_u)` and y `(*batch, T, n_y)`, float64; u[k] is applied at y[k].

    Raises:
        ValueError: arguments or outputs that do not fit.

    Example:
        >>> from torch_dpc.systems import OscillatingMasses
        >>> u, y = collect(OscillatingMasses(), 5, generator=torch.Generator().manual_seed(0))
        >>> u.shape, y.shape
        (torch.Size([5, 2]), torch.Size([5, 4]))
    """
    check_count("steps", steps)
    check_count("hold", hold)
    port = Port(plant)
    check_callable("feedback", feedback, optional=True)
    check_generator(generator)
    size = per_input("amplitude", amplitude, port.n_u)
    if not bool((size >= 0).all()):
        raise ValueError(f"`amplitude` must be zero or more, got {amplitude!r}.")
    centre = per_input("offset", 0.0 if offset is None else offset, port.n_u)
    y = port.start(reset, centre)
    assert port.batch is not None
    inputs, outputs = [], []
    for k in _with_progress(range(steps), f"recording {port.name}"):
        if k % hold == 0:
            draw = torch.rand(*port.batch, port.n_u, dtype=torch.float64, generator=generator)
            random = size * (2 * draw - 1)
            random = random if offset is None else centre + random
        u = random if feedback is None else random + _fed_back(feedback(y), port)
        inputs.append(u)
        outputs.append(y)
        y = port.step(u)
    return torch.stack(inputs, dim=-2), torch.stack(outputs, dim=-2)


def per_input(name: str, value: Any, n_u: int) -> Tensor:
    """Return a number or `(*batch, n_u)` as a tensor `(*batch, n_u)`, float64.

    Raises:
        ValueError: another shape, or values that are not finite.
    """
    tensor = as_data(name, as_numbers(name, value))
    if tensor.ndim and tensor.shape[-1] not in (1, n_u):
        raise ValueError(f"`{name}` must be a number or have shape (*batch, {n_u}), got {tuple(tensor.shape)}.")
    return tensor.expand(*tensor.shape[:-1], n_u)


def _fed_back(value: Any, port: Port) -> Tensor:
    u = as_data("feedback(y)", value).double()
    if u.shape[-1:] != (port.n_u,):
        raise ValueError(f"`feedback(y)` must have shape (*batch, {port.n_u}), got {tuple(u.shape)}.")
    return u


def _with_progress(steps: range, title: str) -> Any:
    """Return the steps, with a bar on a terminal if tqdm is installed and they take longer than two seconds."""
    try:
        from tqdm import tqdm
    except ImportError:
        return steps
    return tqdm(steps, desc=title, unit="step", delay=2.0, leave=False, disable=None)
