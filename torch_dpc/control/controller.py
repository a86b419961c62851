"""Receding-horizon control with the layer."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, as_index, check_number, check_type
from ..errors import Status
from ..layer import DPCLayer
from ..solution import DPCSolution
from .nearest import NearestWindows
from .past import Past
from .plan_times import PlanTimes
from .soften import plan_softened, require_boxes

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ControllerState:
    """What decides the next inputs together with the windows to come.

    Attributes:
        inputs: of the plan in force, `(*batch, horizon, n_u)`; None before the first.
        age: steps since that plan was made.
        due: steps until the next one.
        status, softened_by: as the controller has them.
    """

    inputs: Tensor | None = None
    age: int = 0
    due: int = 0
    status: Status | Tensor = Status.SOLVED
    softened_by: float | Tensor = 0.0


class DPCController:
    """Plan every few steps and apply the plan open loop in between.

    At step k it knows the inputs and outputs of the steps k - t_ini ... k - 1. A plan already lies in the input set, so
    it is applied as it is. Windows with a batch in front are those of several runs, planned for in one call.

    :meth:`step` is given the windows; :meth:`act` keeps them itself, for a loop around hardware.

    Args:
        layer: the planning problem, or :class:`torch_dpc.control.nearest.NearestWindows` around it.
        replan_every: steps of a plan that are applied before the next one, at most the horizon; by default 10, or the
            horizon where that is shorter.
        on_failure: what to do when the problem has no solution:
            "raise": the layer's error;
            "hold": go on with the rest of the previous plan, its last input held beyond its end (before any plan: the
            input nearest to zero in the set);
            "soften": widen the output bounds at the price `soft_weight` (:mod:`torch_dpc.control.soften`).
        on_alarm: what to do when a detector mistrusts the window (`simulate(..., detector=)`): "ignore", or "hold": go
            on with the rest of the previous plan.
        soft_weight: price of widening the output bounds by one unit, in units of the cost. Below it the plan is the one
            without softening, so it should exceed the sum of the output multipliers of ordinary plans.
        deadline: a plan that takes longer is counted in `times.late` [s]; usually the sampling time of the plant.

    Attributes:
        plan: the last plan as posed, a :class:`torch_dpc.DPCSolution`; None before the first.
        state: the plan in force; assign it to go back to it.
        times: durations of planning, a :class:`torch_dpc.control.plan_times.PlanTimes`.

    Example:
        >>> from torch_dpc import Box, DPCController, DPCLayer, HankelData, collect, simulate, systems
        >>> plant, generator = systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> data = HankelData.from_trajectories(*collect(plant, 120, generator=generator), t_ini=4, horizon=10)
        >>> layer = DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=Box(-1.0, 1.0))
        >>> log = simulate(plant, DPCController(layer, replan_every=5), torch.zeros(4), steps=20)
        >>> log.u.shape
        torch.Size([20, 2])
    """

    def __init__(
        self,
        layer: DPCLayer | NearestWindows,
        replan_every: int | None = None,
        *,
        on_failure: str = "raise",
        on_alarm: str = "ignore",
        soft_weight: float = 1e6,
        deadline: float | None = None,
    ):
        check_type("layer", layer, (DPCLayer, NearestWindows))
        horizon = layer.data.horizon
        if replan_every is None:
            replan_every = min(10, horizon)
        rule = f"`replan_every` must be an integer from 1 to the horizon, {horizon}"
        replan_every = as_index(rule, replan_every)
        if not 1 <= replan_every <= horizon:
            raise ValueError(f"{rule}, got {replan_every!r}.")
        if on_failure not in ("raise", "hold", "soften"):
            raise ValueError(f'`on_failure` must be "raise", "hold" or "soften", got {on_failure!r}.')
        if on_alarm not in ("ignore", "hold"):
            raise ValueError(f'`on_alarm` must be "ignore" or "hold", got {on_alarm!r}.')
        if on_failure == "soften":
            require_boxes(layer)
        check_number("soft_weight", soft_weight, positive=True, kind="positive and finite")
        self.layer = layer
        self.replan_every = replan_every
        self.on_failure, self.on_alarm = on_failure, on_alarm
        self.soft_weight = soft_weight
        self.times = PlanTimes(deadline)
        self.reset()

    def reset(self, u_past: Any = None, y_past: Any = None) -> None:
        """Forget the previous plan and the durations; begin with these windows, for :meth:`act`.

        Args:
            u_past, y_past: the last `t_ini` inputs and outputs or more, `(*batch, >= t_ini, n)`. Without them the first
                `t_ini` calls of `act` fill the window, at the input nearest to zero in the set.

        Raises:
            ValueError: one without the other, or shapes that do not fit.
        """
        self.plan: DPCSolution | None = None
        self.state = ControllerState()
        self.times.clear()
        data = self.layer.data
        self._past = Past.of(data.t_ini, data.n_u, data.n_y, u_past, y_past)

    @property
    def replans_now(self) -> bool:
        """Whether the next `step` plans anew."""
        return self.state.due == 0

    @property
    def status(self) -> Status | Tensor:
        """How the last problem, as posed, ended, `(*batch,)`; what was done about it is up to `on_failure`."""
        return self.state.status

    @property
    def softened_by(self) -> float | Tensor:
        """How far the output bounds were widened for the plan in force, `(*batch,)`."""
        return self.state.softened_by

    def step(
        self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None, alarm: Tensor | None = None
    ) -> Tensor:
        """Return the input of this step, `(*batch, n_u)`, planning first where one is due.

        Args:
            u_ini, y_ini: the last `t_ini` inputs and outputs, `(*batch, t_ini, n)`.
            y_ref, u_ref: references over the horizon, as the layer takes them.
            alarm: whether a detector mistrusts the window, boolean, `(*batch,)`; see `on_alarm`.

        Raises:
            SolveError: the problem has no solution, with `on_failure="raise"`.
        """
        if self.replans_now:
            self._replan(u_ini, y_ini, y_ref, u_ref, alarm)
        state = self.state
        assert state.inputs is not None
        self.state = replace(state, age=state.age + 1, due=state.due - 1)
        return state.inputs[..., state.age, :]

    def act(self, y: Any, *, y_ref: Any = None, u_ref: Any = None) -> Tensor:
        """Return the input to apply at the measurement y; the controller keeps the window.

        The plan rests on the measurements before y, so it can be made ahead of time by :meth:`prepare`.

        Args:
            y: the present outputs, `(*batch, n_y)`.
            y_ref, u_ref: references over the horizon, as the layer takes them.

        Returns:
            The input, `(*batch, n_u)`.

        Raises:
            ValueError: shapes that do not fit, or values that are not finite.
            SolveError: the problem has no solution, with `on_failure="raise"`.
        """
        y = as_data("y", y)
        if y.shape[-1:] != (self.layer.data.n_y,):
            raise ValueError(f"`y` must have shape (*batch, n_y) = (*, {self.layer.data.n_y}), got {tuple(y.shape)}.")
        if self._past.is_full:
            u = self.step(*self._past.windows(), y_ref=y_ref, u_ref=u_ref)
        else:
            u = self._nearest_to_zero(y)[0].expand(*y.shape[:-1], -1)
        self._past.append(u, y)
        return u

    def prepare(self, *, y_ref: Any = None, u_ref: Any = None) -> None:
        """Make the plan of the next `act` now, where one is due: while the plant moves, not while it waits.

        Args:
            y_ref, u_ref: references over the horizon of the next step.

        Raises:
            SolveError: the problem has no solution, with `on_failure="raise"`.
        """
        if self._past.is_full and self.replans_now:
            self._replan(*self._past.windows(), y_ref, u_ref)

    def _replan(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any, alarm: Tensor | None = None) -> None:
        begin = time.perf_counter()
        on_failure = "raise" if self.on_failure == "raise" else "nan"
        plan = self.plan = self.layer(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref, on_failure=on_failure)
        status = plan.info.status
        inputs, solved = plan.u, status == Status.SOLVED
        widths: float | Tensor = 0.0 if status.ndim == 0 else torch.zeros(status.shape, dtype=torch.float64)
        if not bool(solved.all()):
            if self.on_failure == "soften":
                inputs, widths = self._softened((u_ini, y_ini, y_ref, u_ref), plan.u, ~solved)
                widest = float(torch.as_tensor(widths).max())
                LOGGER.warning("no plan within the output bounds: they are softened by up to %.3g", widest)
            else:
                LOGGER.warning("no plan: the previous one is held")
                inputs = torch.where(solved[..., None, None], inputs, self._rest(plan.u))
        if self.on_alarm == "hold" and alarm is not None and bool(alarm.any()):
            LOGGER.warning("the detector mistrusts the window: the previous plan is held")
            inputs = torch.where(alarm[..., None, None], self._rest(plan.u), inputs)
        self.state = ControllerState(
            inputs, 0, self.replan_every, Status(int(status)) if status.ndim == 0 else status, widths
        )
        self.times.add(time.perf_counter() - begin)

    def _rest(self, like: Tensor) -> Tensor:
        """Return what is left of the plan in force, its last input held: `(*batch, horizon, n_u)`."""
        inputs, age = self.state.inputs, self.state.age
        if inputs is None:
            return self._nearest_to_zero(like).expand_as(like)
        held = inputs[..., -1:, :].expand(*inputs.shape[:-2], age, -1)
        return torch.cat([inputs[..., age:, :], held], dim=-2)

    def _softened(self, call: tuple[Any, ...], inputs: Tensor, failed: Tensor) -> tuple[Tensor, float | Tensor]:
        """Return the inputs with those of failed samples planned anew under softened output bounds, and the widths."""
        assert isinstance(self.layer, DPCLayer)
        theta, _ = self.layer.flatten(*call)
        if failed.ndim == 0:
            softened, width = plan_softened(self.layer, theta, self.soft_weight)
            return softened.u.to(inputs.dtype), width
        inputs, widths = inputs.clone(), torch.zeros(failed.shape, dtype=torch.float64)
        for i in map(tuple, failed.nonzero().tolist()):
            softened, widths[i] = plan_softened(self.layer, theta[i], self.soft_weight)
            inputs[i] = softened.u.to(inputs)
        return inputs, widths

    def _nearest_to_zero(self, like: Tensor) -> Tensor:
        """Return the inputs nearest to zero in the set, `(horizon, n_u)`."""
        data, u_set = self.layer.data, self.layer.u_set
        zero = torch.zeros(data.horizon, data.n_u, dtype=like.dtype, device=like.device)
        with torch.no_grad():
            nearest = u_set.project(zero.reshape(-1)) if u_set.per == "trajectory" else u_set.project(zero)
        return nearest.reshape(data.horizon, data.n_u)

    def __repr__(self) -> str:
        data = self.layer.data
        return (
            f"{type(self).__name__}({data.t_ini} past and {data.horizon} future steps, n_u={data.n_u}, n_y={data.n_y}, "
            f"replan_every={self.replan_every}, on_failure={self.on_failure!r}; {self.times!r})"
        )
