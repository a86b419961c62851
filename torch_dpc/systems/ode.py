"""Nonlinear systems from a differential equation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..checks import check_callable, check_count, check_type
from .torch_plant import TorchPlant

#: f(x, u) or h(x, u): (*batch, n_x) and (*batch, n_u) to (*batch, n).
Map = Callable[[Tensor, Tensor], Tensor]

#: Methods of scipy.integrate.solve_ivp.
ADAPTIVE = ("RK45", "RK23", "DOP853", "Radau", "BDF", "LSODA")


class Ode(TorchPlant):
    """A system in continuous time, dx/dt = f(x, u),  y = h(x, u), with the input held over each step.

    With the classical Runge-Kutta method of fourth order (`method="rk4"`) it carries a batch and is differentiable
    through time. An adaptive method of SciPy solves each run on its own to a tolerance, without derivatives.

    Args:
        f: the right-hand side, of tensors `(*batch, n_x)` and `(*batch, n_u)`; index channels by `x[..., i]`.
        h: what is measured, of x and the input that led to it; x itself by default.
        n_x, n_u, n_y: sizes of the state, the input and the output; `n_y` is `n_x` by default.
        dt: sampling time [s].
        x0: state after a reset, `(n_x,)`; zero by default.
        method: "rk4", or one of scipy.integrate.solve_ivp: "RK45", "DOP853", "Radau", "LSODA", ...
        substeps: Runge-Kutta steps in one `dt`.
        rtol, atol: tolerances of an adaptive method.
        process_noise: standard deviation of what is added to the state after each step, a number or `(n_x,)`.
        measurement_noise: standard deviation of the noise on the outputs, a number or `(n_y,)`.
        generator: the source of the noise; a list holds one a run.

    Raises:
        ValueError: sizes or settings that do not fit, or f and h that return other shapes.

    Example:
        >>> pendulum = Ode(
        ...     lambda x, u: torch.stack([x[..., 1], u[..., 0] - 9.81 * x[..., 0].sin()], dim=-1),
        ...     lambda x, u: x[..., :1],
        ...     n_x=2, n_u=1, n_y=1, dt=0.05, x0=[0.1, 0.0],
        ... )
        >>> pendulum.reset(batch=2).shape, pendulum.step([0.0]).shape
        (torch.Size([2, 1]), torch.Size([2, 1]))
    """

    def __init__(
        self,
        f: Map,
        h: Map | None = None,
        *,
        n_x: int,
        n_u: int,
        n_y: int | None = None,
        dt: float,
        x0: Any = None,
        method: str = "rk4",
        substeps: int = 1,
        rtol: float = 1e-9,
        atol: float = 1e-12,
        process_noise: Any = 0.0,
        measurement_noise: Any = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ):
        check_callable("f", f)
        check_callable("h", h, optional=True)
        if method not in ("rk4", *ADAPTIVE):
            raise ValueError(f'`method` must be "rk4" or one of {", ".join(ADAPTIVE)}, got {method!r}.')
        if h is None and n_y not in (None, n_x):
            raise ValueError(f"`n_y` must be n_x = {n_x} where no `h` is given, got {n_y!r}.")
        self.f, self.h, self.method, self.rtol, self.atol = f, h, method, rtol, atol
        self.substeps = check_count("substeps", substeps)
        super().__init__(
            n_x, n_u, n_x if n_y is None else n_y, dt, x0=x0, process_noise=process_noise,
            measurement_noise=measurement_noise, generator=generator,
        )  # fmt: skip

    def _advance(self, x: Tensor, u: Tensor) -> Tensor:
        if self.method == "rk4":
            for _ in range(self.substeps):
                x = self._runge_kutta(x, u, self.dt / self.substeps)
            return x
        if torch.is_grad_enabled() and (x.requires_grad or u.requires_grad):
            raise ValueError(f'`method="{self.method}"` has no derivatives; use method="rk4".')
        runs = zip(x.reshape(-1, self.n_x), u.reshape(-1, self.n_u), strict=True)
        return torch.stack([self._integrate(*run) for run in runs]).reshape(x.shape) if x.numel() else x

    def _runge_kutta(self, x: Tensor, u: Tensor, dt: float) -> Tensor:
        k1 = self._slope(x, u)
        k2 = self._slope(x + dt / 2 * k1, u)
        k3 = self._slope(x + dt / 2 * k2, u)
        k4 = self._slope(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def _integrate(self, x: Tensor, u: Tensor) -> Tensor:
        from scipy.integrate import solve_ivp

        def slope(_: float, values: Any) -> Any:
            return self._slope(torch.as_tensor(values, dtype=torch.float64), u).numpy()

        with torch.no_grad():
            run = solve_ivp(slope, (0.0, self.dt), x.numpy(), method=self.method, rtol=self.rtol, atol=self.atol)
        if not run.success:
            raise RuntimeError(f"{self.method} did not integrate {type(self).__name__} over a step: {run.message}")
        return torch.as_tensor(run.y[:, -1], dtype=torch.float64)

    def _slope(self, x: Tensor, u: Tensor) -> Tensor:
        slope = self.f(x, u)
        check_type("f", slope, Tensor)
        if slope.shape != x.shape:
            raise ValueError(f"`f` must return shape (*batch, n_x) = {tuple(x.shape)}, got {tuple(slope.shape)}.")
        return slope

    def _outputs(self, x: Tensor, u: Tensor) -> Tensor:
        if self.h is None:
            return x
        y = self.h(x, u)
        check_type("h", y, Tensor)
        if y.shape != (*x.shape[:-1], self.n_y):
            raise ValueError(
                f"`h` must return shape (*batch, n_y) = {(*x.shape[:-1], self.n_y)}, got {tuple(y.shape)}."
            )
        return y
