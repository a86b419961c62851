"""Linear systems with a known model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..batching import times
from ..checks import as_data
from .torch_plant import TorchPlant


class StateSpace(TorchPlant):
    """A linear system in discrete time, x+ = A x + B u + w,  y = C x + D u + v.

    The u in y is the input that led to x: y is sampled at the end of a step, before the next input is applied, and
    after a reset it is zero.

    Args:
        A, B: `(n_x, n_x)` and `(n_x, n_u)`.
        C: `(n_y, n_x)`; the identity by default.
        D: `(n_y, n_u)`; zero by default.
        dt: sampling time [s].
        x0: state after a reset, `(n_x,)`; zero by default.
        process_noise: standard deviation of w, a number or `(n_x,)`.
        measurement_noise: standard deviation of v, a number or `(n_y,)`.
        generator: the source of the noise; a list holds one a run.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.

    Example:
        >>> plant = StateSpace([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], [[1.0, 0.0]], dt=0.1)   # a double integrator
        >>> plant.reset(batch=3).shape
        torch.Size([3, 1])
        >>> plant.step(torch.ones(3, 1))[:, 0]
        tensor([0.0050, 0.0050, 0.0050], dtype=torch.float64)
    """

    def __init__(
        self,
        A: Any,
        B: Any,
        C: Any = None,
        D: Any = None,
        *,
        dt: float,
        x0: Any = None,
        process_noise: Any = 0.0,
        measurement_noise: Any = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ):
        self.A, self.B = as_data("A", A).double(), as_data("B", B).double()
        if self.A.ndim != 2 or self.A.shape[0] != self.A.shape[1]:
            raise ValueError(f"`A` must be square, (n_x, n_x), got {tuple(self.A.shape)}.")
        n_x = len(self.A)
        if self.B.ndim != 2 or len(self.B) != n_x:
            raise ValueError(f"`B` must have shape (n_x, n_u) = ({n_x}, *), got {tuple(self.B.shape)}.")
        n_u = self.B.shape[1]
        self.C = None if C is None else as_data("C", C).double()
        if self.C is not None and (self.C.ndim != 2 or self.C.shape[1] != n_x):
            raise ValueError(f"`C` must have shape (n_y, n_x) = (*, {n_x}), got {tuple(self.C.shape)}.")
        n_y = n_x if self.C is None else len(self.C)
        self.D = None if D is None else as_data("D", D).double()
        if self.D is not None and self.D.shape != (n_y, n_u):
            raise ValueError(f"`D` must have shape (n_y, n_u) = {(n_y, n_u)}, got {tuple(self.D.shape)}.")
        super().__init__(
            n_x, n_u, n_y, dt, x0=x0, process_noise=process_noise, measurement_noise=measurement_noise,
            generator=generator,
        )  # fmt: skip

    @classmethod
    def from_control(cls, system: Any, *, dt: float | None = None, **options: Any) -> StateSpace:
        """Return a system of the python-control package as a plant.

        Args:
            system: a `control.StateSpace` or anything `control.ss` converts, a transfer function for instance. One in
                continuous time is discretised exactly for inputs held over `dt`.
            dt: sampling time [s]; by default that of the system.
            **options: `x0`, `process_noise`, `measurement_noise` and `generator`.

        Raises:
            ValueError: no sampling time, or another than that of the system.
            ImportError: a conversion is needed, and python-control is missing.
        """
        if not all(hasattr(system, name) for name in ("A", "B", "C", "D", "dt")):
            system = _converted(system)
        A, B, C, D = (torch.as_tensor(getattr(system, name), dtype=torch.float64) for name in "ABCD")
        own = system.dt  # python-control: 0 is continuous time, True or None is discrete without a sampling time
        is_continuous = own is not None and own is not True and own == 0
        known = None if own is None or own is True or is_continuous else float(own)
        if dt is None and known is None:
            raise ValueError(f"`dt` must be given for a system whose own is {own!r}.")
        if dt is not None and known is not None and dt != known:
            raise ValueError(f"`dt` must be the system's sampling time, {known:g} s, or be left out, got {dt!r}.")
        step = known if dt is None else float(dt)
        assert step is not None
        if is_continuous:
            A, B = discretise(A, B, step)
        return cls(A, B, C, D if bool(D.any()) else None, dt=step, **options)

    def _advance(self, x: Tensor, u: Tensor) -> Tensor:
        return times(self.A, x) + times(self.B, u)

    def _outputs(self, x: Tensor, u: Tensor) -> Tensor:
        y = x if self.C is None else times(self.C, x)
        return y if self.D is None else y + times(self.D, u)


def discretise(A: Tensor, B: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return the exact discrete model of dx/dt = A x + B u for an input held over dt (Van Loan 1978)."""
    n, m = B.shape
    block = torch.zeros(n + m, n + m, dtype=A.dtype)
    block[:n, :n], block[:n, n:] = A, B
    whole = torch.linalg.matrix_exp(block * dt)
    return whole[:n, :n].clone(), whole[:n, n:].clone()


def _converted(system: Any) -> Any:
    try:
        import control
    except ImportError as error:
        raise ImportError(
            f"a {type(system).__name__} has no A, B, C, D and dt; python-control converts it: pip install control."
        ) from error
    return control.ss(system)
