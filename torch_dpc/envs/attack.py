"""The attacker's environment: it perturbs what a controller measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray
from torch import Tensor

from ..attacks import costs
from ..attacks.budgets import Budget
from ..checks import check_count, check_type
from ..control.controller import DPCController
from ..control.references import reference_trajectory
from ..reprs import shown
from ..systems.plant import Plant, Port, per_input

Array = NDArray[np.float64]

UNBOUNDED = float(np.finfo(np.float32).max)  # Gymnasium warns of observation spaces with infinite bounds


class AttackEnv(gymnasium.Env[Array, Array]):
    """Learn to attack a plant under data-driven control.

    One step is one plan: the attacker sees the window that the controller is about to be given and chooses p; the
    controller plans with it and applies `replan_every` steps of its plan. The plant itself never sees p.

    - action: a in [-1, 1]^(t_ini n_y); p = Proj(reach a), the nearest point of the budget, where reach is how far the
      budget goes along each entry. Every point of a convex budget is the image of some action.
    - observation: u_ini, y_ini, then u_ref and y_ref over the horizon, in physical units, then the elapsed share of the
      episode; flattened, time first.
    - reward: -psi of the plan; attackers make psi small.
    - terminated: the plant says `crashed` (a quadrotor does).
    - truncated: after `steps` steps of the plant.

    `info` of a step has `p`, `(t_ini, n_y)`, `cost` (psi), and the plant's inputs `u` and outputs `y` during the step,
    `(replan_every, n)`.

    Args:
        plant: any plant that carries one run. If it has a `generator`, the environment seeds it.
        controller: the one that is attacked.
        budget: the admissible perturbations.
        cost: psi, a callable DPCSolution -> number, such as :class:`torch_dpc.attacks.TargetInput`.
        y_ref, u_ref: references, as `simulate` takes them; zero by default.
        steps: of the plant in an episode.
        start: a NumPy generator -> arguments of the plant's reset, drawn for every episode; by default none. The
            `options` of `reset` replace it.
        u_warmup: input of the `t_ini` steps before the first plan, a number or `(n_u,)`.

    Raises:
        ValueError: arguments that do not fit.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> data = dpc.HankelData.from_trajectories(*dpc.collect(plant, 120, generator=generator), t_ini=4, horizon=10)
        >>> controller = dpc.DPCController(dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4))
        >>> cost, budget = dpc.attacks.TargetInput([1.0, 0.0]), dpc.attacks.RelativeBall(0.1)
        >>> env = AttackEnv(plant, controller, budget, cost, y_ref=[1.0, 1.0, 0.0, 0.0])
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info["p"].shape, reward < 0
        ((4, 4), True)
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self,
        plant: Plant,
        controller: DPCController,
        budget: Budget,
        cost: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        steps: int = 100,
        start: Callable[[np.random.Generator], Mapping[str, Any]] | None = None,
        u_warmup: Any = 0.0,
    ) -> None:
        check_type("controller", controller, DPCController)
        check_type("budget", budget, Budget)
        costs.check_cost(cost)
        data, port = controller.layer.data, Port(plant)
        if (port.n_u, port.n_y) != (data.n_u, data.n_y):
            raise ValueError(
                f"the plant has {port.n_u} inputs and {port.n_y} outputs, the controller's data {data.n_u} and "
                f"{data.n_y}."
            )
        self.plant, self.controller, self.budget, self.cost = plant, controller, budget, cost
        self.steps, self._start, self._port = check_count("steps", steps), start, port
        y_ref = torch.zeros(data.n_y) if y_ref is None else y_ref
        u_ref = torch.zeros(data.n_u) if u_ref is None else u_ref
        self._y_refs = reference_trajectory("y_ref", y_ref, steps, data.n_y, data.horizon)
        self._u_refs = reference_trajectory("u_ref", u_ref, steps, data.n_u, data.horizon)
        self._warmup = per_input("u_warmup", u_warmup, data.n_u)
        self._t_ini, self._horizon = data.t_ini, data.horizon
        width = (data.t_ini + data.horizon) * (data.n_u + data.n_y) + 1
        self.action_space = spaces.Box(-1.0, 1.0, (data.t_ini * data.n_y,), np.float64)
        self.observation_space = spaces.Box(-UNBOUNDED, UNBOUNDED, (width,), np.float64)
        references: dict[str, Any] = {"y_ref": y_ref, "u_ref": u_ref, "u_warmup": u_warmup}

        def again(**_: Any) -> AttackEnv:
            return AttackEnv(plant, controller, budget, cost, steps=steps, start=start, **references)

        # Checkers make a second environment from the spec. A function is not copied, so that one shares the plant and
        # the controller: a plant that owns hardware or a physics server has no copy.
        self.spec = EnvSpec("torch_dpc/Attack-v0", entry_point=again)

    def __repr__(self) -> str:
        return f"AttackEnv({self.plant}, {self.budget}, {shown(self.cost)}, steps={self.steps})"

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin a run: reset the plant and fill the first window at `u_warmup`.

        Args:
            seed: of the starts, and of the plant's generator if it has one.
            options: arguments of the plant's reset, in place of `start`.
        """
        super().reset(seed=seed)
        source = getattr(self.plant, "generator", None)
        if isinstance(source, torch.Generator):
            source.manual_seed(int(self.np_random.integers(2**62)))
        drawn = self._start(self.np_random) if self._start else {}
        self.controller.reset()
        y = self._port.start(options or drawn, self._warmup)
        if y.ndim != 1:
            raise ValueError(f"`plant` must carry one run, got outputs of shape {tuple(y.shape)}.")
        self._us: list[Tensor] = []
        self._ys = [y]
        self._step = 0
        for _ in range(self._t_ini):
            self._apply(self._warmup)
        return self._observation(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Perturb one plan and let the controller apply it.

        Args:
            action: a, `(t_ini n_y,)`.

        Raises:
            ValueError: an action of another shape, or not finite.
            SolveError: from a controller with `on_failure="raise"`.
        """
        u_ini, y_ini, refs = self.window()
        p = self.perturbation(action, y_ini)
        count = min(self.controller.replan_every, self.steps - self._step)
        with torch.no_grad():
            psi = costs.bound(self.cost, self._step, u_ini, y_ini, **refs)
            cost = float(psi(self.controller.layer(u_ini, y_ini + p, **refs, on_failure="nan")))
            for _ in range(count):
                u_ini, y_ini, refs = self.window()
                self._apply(self.controller.step(u_ini, y_ini + p, **refs))
                self._step += 1
        during = {"u": torch.stack(self._us[-count:]).numpy(), "y": torch.stack(self._ys[-count - 1 : -1]).numpy()}
        crashed = bool(getattr(self.plant, "crashed", False))
        info = {"p": p.numpy(), "cost": cost, **during}
        return self._observation(), -cost, crashed, self._step >= self.steps, info

    def perturbation(self, action: Any, y_ini: Tensor) -> Tensor:
        """Return p = Proj(reach a) for a window, `(t_ini, n_y)`, in the units of the outputs."""
        a = torch.as_tensor(np.asarray(action, dtype=np.float64))
        if a.shape != (y_ini.numel(),) or not bool(a.isfinite().all()):
            raise ValueError(f"`action` must be finite and have shape ({y_ini.numel()},), got {action!r}.")
        units = torch.eye(y_ini.numel(), dtype=y_ini.dtype).unflatten(-1, y_ini.shape)
        reach = (self.budget.minimize_linear(-units, y_ini.expand_as(units)) * units).sum(0)
        return self.budget.project(reach * a.clamp(-1.0, 1.0).reshape(y_ini.shape), y_ini)

    def _apply(self, u: Tensor) -> None:
        self._us.append(u)
        self._ys.append(self._port.step(u))

    def window(self) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Return u_ini, y_ini and the references of the next plan: what an attack is called with."""
        u_ini, y_ini = torch.stack(self._us[-self._t_ini :]), torch.stack(self._ys[-self._t_ini - 1 : -1])
        ahead = slice(self._step, self._step + self._horizon)
        return u_ini, y_ini, {"y_ref": self._y_refs[ahead], "u_ref": self._u_refs[ahead]}

    def _observation(self) -> Array:
        u_ini, y_ini, refs = self.window()
        elapsed = torch.tensor([self._step / self.steps], dtype=torch.float64)
        parts = [u_ini, y_ini, refs["u_ref"], refs["y_ref"], elapsed]
        return np.asarray(torch.cat([part.detach().reshape(-1) for part in parts]).numpy())
