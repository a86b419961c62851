"""Receding-horizon control with the layer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import as_index
from ..errors import Status
from ..layer import DPCLayer
from .soften import plan_softened


class DPCController:
    """Plan every few steps and apply the plan open loop in between.

    At step k it knows the inputs and outputs of the steps k - t_ini ... k - 1. A plan already lies in the input set, so
    it is applied as it is.

    Args:
        layer: the planning problem.
        replan_every: steps of a plan that are applied before the next one, at most the horizon; by default 10, or the
            horizon where that is shorter.
        on_failure: what to do when the problem has no solution:
            "raise": the layer's error;
            "hold": go on with the rest of the previous plan, its last input held beyond its end (before any plan: the
            input nearest to zero in the set);
            "soften": widen the output bounds at the price `soft_weight` (:mod:`torch_dpc.control.soften`).
        soft_weight: price of widening the output bounds by one unit, in units of the cost. Below it the plan is the one
            without softening, so it should exceed the sum of the output multipliers of ordinary plans.

    Attributes:
        status: how the last problem, as posed, ended; what was done about it is up to `on_failure`.
        softened_by: how far the output bounds were widened for the plan in force.

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
        self, layer: DPCLayer, replan_every: int | None = None, *, on_failure: str = "raise", soft_weight: float = 1e6
    ):
        horizon = layer.data.horizon
        if replan_every is None:
            replan_every = min(10, horizon)
        rule = f"`replan_every` must be an integer from 1 to the horizon, {horizon}"
        replan_every = as_index(rule, replan_every)
        if not 1 <= replan_every <= horizon:
            raise ValueError(f"{rule}, got {replan_every!r}.")
        if on_failure not in ("raise", "hold", "soften"):
            raise ValueError(f'`on_failure` must be "raise", "hold" or "soften", got {on_failure!r}.')
        if on_failure == "soften" and not layer.feasible_set.is_box:
            raise ValueError('`on_failure="soften"` widens boxes; give the layer a SoftBox as `y_set` instead.')
        if not soft_weight > 0:
            raise ValueError(f"`soft_weight` must be positive, got {soft_weight!r}.")
        self.layer = layer
        self.replan_every = replan_every
        self.on_failure = on_failure
        self.soft_weight = soft_weight
        self.reset()

    def reset(self) -> None:
        """Forget the previous plan."""
        self._plan: Tensor | None = None
        self._age = 0  # steps since the plan in force was made
        self._due = 0  # steps until the next one
        self.status = Status.SOLVED
        self.softened_by = 0.0

    @property
    def replans_now(self) -> bool:
        """Whether the next `step` plans anew."""
        return self._due == 0

    def step(self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None) -> Tensor:
        """Return the input of this step, `(n_u,)`, planning first where one is due.

        Args:
            u_ini, y_ini: the last `t_ini` inputs and outputs, `(t_ini, n)`.
            y_ref, u_ref: references over the horizon, as the layer takes them.

        Raises:
            SolveError: the problem has no solution, with `on_failure="raise"`.
        """
        if self.replans_now:
            self._replan(u_ini, y_ini, y_ref, u_ref)
            self._due = self.replan_every
        assert self._plan is not None
        u = self._plan[min(self._age, len(self._plan) - 1)]
        self._age += 1
        self._due -= 1
        return u

    def _replan(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any) -> None:
        on_failure = "raise" if self.on_failure == "raise" else "nan"
        solution = self.layer(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref, on_failure=on_failure)
        self.status, self.softened_by = Status(int(solution.info.status)), 0.0
        if self.status != Status.SOLVED and self.on_failure == "soften":
            theta, _ = self.layer.flatten(u_ini, y_ini, y_ref, u_ref)
            solution, self.softened_by = plan_softened(self.layer, theta, self.soft_weight)
        if int(solution.info.status) == Status.SOLVED:
            self._plan, self._age = solution.u, 0
        elif self._plan is None:
            zero = torch.zeros(self.layer.data.n_u, dtype=solution.u.dtype, device=solution.u.device)
            self._plan, self._age = self.layer.u_set.project(zero).reshape(-1, self.layer.data.n_u), 0
