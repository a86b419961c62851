"""The base of plants in torch: they carry a batch of runs, draw noise, and can be differentiated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..batching import standard_normal
from ..checks import as_data, as_numbers, check_batch, check_count, check_generator, check_number


class TorchPlant:
    """A plant with the state x `(*batch, n_x)`, in float64; a subclass says how x moves and what is measured.

        x+ = advance(x, u) + w,    y = outputs(x, u) + v,

    w and v independent normal numbers. An output that depends on u uses the input that led to x: y is sampled at the
    end of a step, before the next input is applied. Steps are differentiable: an input or a state with a graph passes
    it on to the outputs.

    Args:
        n_x, n_u, n_y: sizes of the state, the input and the output.
        dt: sampling time [s].
        x0: state after a reset without `state`, `(n_x,)`; zero by default.
        process_noise: standard deviation of w, a number or `(n_x,)`.
        measurement_noise: standard deviation of v, a number or `(n_y,)`.
        generator: the source of the noise; a list of generators, one a run, gives each run its own.

    Raises:
        ValueError: sizes, a sampling time or deviations that do not fit.
    """

    def __init__(
        self,
        n_x: int,
        n_u: int,
        n_y: int,
        dt: float,
        *,
        x0: Any = None,
        process_noise: Any = 0.0,
        measurement_noise: Any = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ):
        self.n_x, self.n_u, self.n_y = check_count("n_x", n_x), check_count("n_u", n_u), check_count("n_y", n_y)
        self.dt = check_number("dt", dt, positive=True, kind="a positive sampling time [s]")
        self.x0 = torch.zeros(n_x, dtype=torch.float64) if x0 is None else self._vector("x0", x0, n_x)
        self.process_noise = _deviation("process_noise", process_noise, n_x)
        self.measurement_noise = _deviation("measurement_noise", measurement_noise, n_y)
        check_generator(generator)
        self.generator = generator
        self.x, self._u = self.x0, torch.zeros(n_u, dtype=torch.float64)

    def reset(self, state: Any = None, *, batch: int | Sequence[int] = ()) -> Tensor:
        """Start new runs and return the first measurement, `(*batch, n_y)`.

        Args:
            state: of every run, `(n_x,)`, or one a run, `(*batch, n_x)`; by default `x0`.
            batch: shape of the runs; by default that of `state`.

        Raises:
            ValueError: shapes that do not fit.
        """
        x = self.x0 if state is None else as_data("state", state).double()
        shape = check_batch("batch", batch)
        if x.shape[-1:] != (self.n_x,) or (x.ndim > 1 and shape and x.shape[:-1] != shape):
            expected = f"({', '.join(map(str, shape))}, {self.n_x})" if shape else f"(*batch, {self.n_x})"
            raise ValueError(f"`state` must have shape ({self.n_x},) or {expected}, got {tuple(x.shape)}.")
        x = x.expand(*shape, self.n_x) if shape else x
        self.restore((x, x.new_zeros(*x.shape[:-1], self.n_u)))
        return self.measure()

    def step(self, u: Any) -> Tensor:
        """Apply u, `(*batch, n_u)` or one for all runs, for one step; return the measurement after it."""
        u = as_data("u", u).double()
        batch = self.x.shape[:-1]
        if u.shape != (*batch, self.n_u):
            if u.shape != (self.n_u,):
                raise ValueError(f"`u` must have shape {(*batch, self.n_u)}, got {tuple(u.shape)}.")
            u = u.expand(*batch, self.n_u)
        self.x = self._noisy(self._advance(self.x, u), self.process_noise)
        self._u = u
        return self.measure()

    def measure(self) -> Tensor:
        """Return the present outputs, `(*batch, n_y)`, with new noise if there is any."""
        return self._noisy(self._outputs(self.x, self._u), self.measurement_noise)

    def snapshot(self) -> tuple[Tensor, ...]:
        """Return what decides the future together with the inputs to come."""
        return self.x, self._u

    def restore(self, snapshot: tuple[Tensor, ...]) -> None:
        """Continue from a snapshot; the noise goes on."""
        self.x, self._u = snapshot

    def _advance(self, x: Tensor, u: Tensor) -> Tensor:
        """Return the state one step after x `(*batch, n_x)` under u `(*batch, n_u)`."""
        raise NotImplementedError

    def _outputs(self, x: Tensor, u: Tensor) -> Tensor:
        """Return the outputs at x, reached under u, `(*batch, n_y)`."""
        raise NotImplementedError

    def _noisy(self, values: Tensor, deviation: float | Tensor) -> Tensor:
        if isinstance(deviation, (int, float)) and deviation == 0:
            return values
        return values + deviation * standard_normal(values, self.generator, tail=1)

    @staticmethod
    def _vector(name: str, value: Any, size: int) -> Tensor:
        vector = as_data(name, value).double()
        if vector.shape != (size,):
            raise ValueError(f"`{name}` must have shape ({size},), got {tuple(vector.shape)}.")
        return vector

    def __repr__(self) -> str:
        return f"{type(self).__name__}(n_x={self.n_x}, n_u={self.n_u}, n_y={self.n_y}, dt={self.dt:g} s)"


def _deviation(name: str, value: Any, size: int) -> float | Tensor:
    deviation = as_numbers(name, value)
    if deviation.shape not in ((), (size,)) or not bool((deviation >= 0).all()):
        raise ValueError(f"`{name}` must be a number or have shape ({size},), not negative, got {value!r}.")
    return float(deviation) if deviation.ndim == 0 else deviation
