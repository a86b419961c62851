"""Attacks through time: a signal on the sensors, chosen for what the closed loop will do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..checks import as_index, check_callable, check_count, check_number, check_type
from ..control.controller import DPCController
from ..errors import Status
from ..reprs import Described
from ..systems.plant import Port
from .base import Attack, AttackCall
from .budgets import Budget
from .budgets.base import direction, euclidean

#: What a stretch of a run is worth to the attacker, to be made small: (u, y, u_ref, y_ref) -> `(*batch,)`.
RunCost = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]

#: Factors on the step size after a round that helped, and after one that did not.
LONGER, SHORTER = 1.5, 0.5


class RunError(Described):
    """psi = -(mean over the steps of |(y - y_ref)[channels]|^2): drive the run away from its reference.

    Args:
        channels: of the outputs; all by default.
    """

    def __init__(self, channels: list[int] | None = None):
        if channels is not None:
            check_type("channels", channels, (list, tuple, range))
            rule = "`channels` must be integers, 0 or more, at least one"
            if not channels or min(as_index(rule, channel) for channel in channels) < 0:
                raise ValueError(f"{rule}, got {channels!r}.")
        self.channels = channels

    def __call__(self, u: Tensor, y: Tensor, u_ref: Tensor, y_ref: Tensor) -> Tensor:
        """Return psi, `(*batch,)`, of outputs `(*batch, steps, n_y)`."""
        error = y - y_ref
        error = error if self.channels is None else error[..., self.channels]
        return -error.square().sum(-1).mean(-1)


class _Rollout(NamedTuple):
    """What the attacker foresees.

    Attributes:
        cost: of the run, `(*batch,)`; infinity where a plan fails.
        used: what was added to the window of each plan, `(plans, *batch, t_ini, n_y)`.
    """

    cost: Tensor
    used: Tensor


class SignalAttack(Attack):
    """Choose the sensor signal of the plans to come by gradient through the plans and the plant; apply the first.

    At every plan the attacker foresees `plans` plans of the closed loop, with the plant from its present state, and
    descends on the cost of that run over everything it has yet to report. What was reported before stays: where two
    windows overlap, the later one repeats the earlier. The budget holds for the window of each plan;
    :class:`torch_dpc.attacks.PerSampleBudget` makes it one for each sample.

    Args:
        plant: the plant itself, in torch; its state is read and put back (`snapshot`, `restore`).
        controller: its layer and `replan_every` are what the attacker foresees.
        cost: of a run, see :data:`RunCost`; for instance `RunError()`.
        budget: the admissible perturbations of a window.
        plans: how many plans it looks ahead.
        steps: gradient steps at each plan.
        step_size: of the first, as a fraction of the budget.
        first_guess: another attack, such as Algorithm 1, whose answers along the foreseen run are one more start,
            beside zero and a random signal. The best run of all is kept.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-1.0, 1.0))
        >>> controller = dpc.DPCController(layer, 5)
        >>> attack = SignalAttack(plant, controller, RunError([0, 1]), dpc.attacks.Ball(0.1), plans=2, steps=5)
        >>> attacked = dpc.simulate(plant, controller, torch.zeros(4), steps=10, attack=attack)
        >>> bool(attacked.y.abs().max() > 0.01)
        True
    """

    def __init__(
        self,
        plant: Any,
        controller: DPCController,
        cost: RunCost,
        budget: Budget,
        *,
        plans: int = 3,
        steps: int = 20,
        step_size: float = 0.5,
        first_guess: Attack | None = None,
    ):
        super().__init__(budget)
        if not (hasattr(plant, "snapshot") and hasattr(plant, "restore")):
            raise ValueError("`plant` must have `snapshot()` and `restore(...)`, as plants in torch have.")
        check_type("controller", controller, DPCController)
        check_callable("cost", cost)
        check_number("step_size", step_size, positive=True)
        self.plant, self.controller, self.cost, self.first_guess = plant, controller, cost, first_guess
        self.plans, self.steps, self.step_size = check_count("plans", plans), check_count("steps", steps), step_size
        self._reported: list[tuple[int, Tensor]] = []  # step and answer of the last plan; of this run alone

    def _perturb(self, call: AttackCall) -> Tensor:
        before = self._before(call)
        generator = getattr(self.plant, "generator", None)
        noise = None if generator is None else generator.get_state()
        present = self.plant.snapshot()
        call = call._replace(u_ini=call.u_ini.detach().double(), y_ini=call.y_ini.detach().double())
        try:
            p = self._best(call, before, tuple(x.detach() for x in present))
        finally:  # the run goes on as if nobody had looked ahead
            self.plant.restore(present)
            if generator is not None:
                generator.set_state(noise)
        self._reported[:] = [(int(call.step), p)]
        return p

    def _before(self, call: AttackCall) -> Tensor:
        """Return the part of this window that was reported already, `(*batch, rows, n_y)`, the oldest rows."""
        nothing = call.y_ini[..., :0, :]
        if not self._reported or not self._reported[0][0] < int(call.step):
            return nothing
        step, p = self._reported[0]
        rows = call.y_ini.shape[-2] - (int(call.step) - step)
        return p[..., -rows:, :] if rows > 0 and p.shape == call.y_ini.shape else nothing

    def _best(self, call: AttackCall, before: Tensor, present: tuple[Tensor, ...]) -> Tensor:
        """Return the first perturbation of the best run that the walks found."""
        zero = torch.zeros(self.plans, *call.y_ini.shape, dtype=torch.float64)
        source = torch.Generator().manual_seed(0) if call.generator is None else call.generator
        # From perfect tracking no direction leads down at first order: a random start does.
        random = self.budget.given(call.u_ini).random(call.y_ini.expand(zero.shape), source)
        guesses: list[Tensor | Attack] = [zero, random, *([] if self.first_guess is None else [self.first_guess])]
        seen: list[_Rollout] = []
        for guess in guesses:
            with torch.no_grad():
                seen.append(self._predict_run(call, before, present, guess))
            seen += self._walk(call, before, present, seen[-1].used)
        costs = torch.stack([run.cost for run in seen])
        best = costs.argmin(0)
        first = torch.stack([run.used[0] for run in seen])
        return first.gather(0, best[None, ..., None, None].expand(1, *first.shape[1:]))[0]

    def _walk(self, call: AttackCall, before: Tensor, present: tuple[Tensor, ...], start: Tensor) -> list[_Rollout]:
        """Descend from a start by normalised gradients that shrink where they do not help; return all runs seen."""
        signal, best = start, torch.full(call.y_ini.shape[:-2], torch.inf, dtype=torch.float64)
        kept, gradient = start, torch.zeros_like(start)
        size, seen = torch.full((*best.shape, 1, 1), self.step_size, dtype=torch.float64), []
        for _ in range(self.steps):
            with torch.enable_grad():
                free = signal.detach().requires_grad_()
                run = self._predict_run(call, before, present, free)
                finite = torch.where(run.cost.isfinite(), run.cost, 0.0).sum()
                (slope,) = torch.autograd.grad(finite, free)
            run = _Rollout(run.cost.detach(), run.used.detach())
            seen.append(run)
            better = run.cost < best
            best = torch.where(better, run.cost, best)
            kept = torch.where(better[..., None, None], run.used, kept)
            gradient = torch.where(better[..., None, None], slope, gradient)
            size = size * torch.where(better, LONGER, SHORTER)[..., None, None]
            vertex = self.budget.minimize_linear(gradient, call.y_ini.expand(gradient.shape))
            signal = kept - size * euclidean(vertex) * direction(gradient)
        return seen

    def _predict_run(
        self, call: AttackCall, before: Tensor, present: tuple[Tensor, ...], signal: Tensor | Attack
    ) -> _Rollout:
        """Return the run under a signal, `(plans, *batch, t_ini, n_y)`, projected onto the budget on the way."""
        self.plant.restore(present)
        port, layer, every = Port(self.plant), self.controller.layer, self.controller.replan_every
        u_ini, y_ini = call.u_ini, call.y_ini
        us, ys, used, solved = [], [], [], torch.ones(y_ini.shape[:-2], dtype=torch.bool)
        y = self.plant.measure()
        for k in range(self.plans):
            refs = {name: _from(ref, k * every) for name, ref in (("y_ref", call.y_ref), ("u_ref", call.u_ref))}
            if isinstance(signal, Tensor):
                wanted = signal[k]
            else:
                wanted = signal(u_ini, y_ini, **refs, generator=call.generator, step=int(call.step) + k * every)
            p = self.budget.given(u_ini).project(torch.cat([before, wanted[..., before.shape[-2] :, :]], -2), y_ini)
            used.append(p)
            plan = layer(u_ini, y_ini + p, **refs, on_failure="nan")
            ok = plan.info.status == Status.SOLVED
            solved = solved & ok
            u = torch.where(ok[..., None, None], plan.u, u_ini[..., -1:, :])[..., :every, :]
            outputs = []
            for step in u.unbind(-2):
                outputs.append(y)
                y = port.step(step)
            us.append(u)
            ys.append(torch.stack(outputs, -2))
            rows = y_ini.shape[-2]
            u_ini, y_ini = (torch.cat([w, new], -2)[..., -rows:, :] for w, new in ((u_ini, us[-1]), (y_ini, ys[-1])))
            before = p[..., -max(rows - every, 0) :, :] if every < rows else p[..., :0, :]
        u, y_all = torch.cat(us, -2), torch.cat(ys, -2)
        cost = self.cost(u, y_all, _like(call.u_ref, u), _like(call.y_ref, y_all))
        return _Rollout(torch.where(solved, cost, torch.inf), torch.stack(used))


def _from(reference: Any, row: int) -> Any:
    """Return a reference from a later row on, its last row held."""
    if reference is None or reference.ndim < 2 or reference.shape[-2] == 1:
        return reference
    rows = torch.arange(row, row + reference.shape[-2]).clamp_max(reference.shape[-2] - 1)
    return reference[..., rows, :]


def _like(reference: Any, run: Tensor) -> Tensor:
    """Return a reference with the rows of a run; zero for None, the last row held."""
    if reference is None:
        return torch.zeros_like(run)
    reference = reference.to(run)
    if reference.ndim < 2 or reference.shape[-2] == 1:
        return reference.expand(run.shape)
    rows = torch.arange(run.shape[-2]).clamp_max(reference.shape[-2] - 1)
    return reference[..., rows, :].expand(run.shape)
