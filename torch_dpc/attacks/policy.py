"""Attacks by a trained network: one small forward pass in place of a solve and its gradient."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ..checks import as_data, check_callable, check_count, check_type, is_finite, reference, window
from ..data.hankel import HankelData
from ..reprs import shown
from .base import Attack, AttackCall
from .budgets import BallBudget, Budget, EllipsoidBudget


class AttackPolicy(nn.Module):
    """A small network from what an attacker measures to a direction of attack.

        z = x / scale,   x = (u_ini, y_ini, u_ref, y_ref, context of the step)
        d = W z + b + W_k relu(... relu(W_1 z + b_1) ...)

    Algorithm 1's direction is, before it is normalised, piecewise affine in x: the gradient of a quadratic through a
    plan that is piecewise affine. So is this map, and the way around the hidden layers is all of it where no bound
    becomes active. Build it with `for_windows`, which brings every channel to the size 1, so that units do not matter.

    Args:
        data: what the sizes of the windows are taken from.
        hidden: the width of each hidden layer.
        context: what else moves with the step and decides the attack, `(>= steps, n)`, such as the trajectory of a
            `TargetInput`, its last row held beyond the end.
        looks: at how many steps of the horizon, evenly spread, it looks at the references and the context.
        scale: of each entry of x, `(n_x,)`; by default 1.
        generator: of the first weights.

    Example:
        >>> import torch_dpc as dpc
        >>> u = torch.rand(60, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> data = dpc.HankelData.from_trajectories(u, u.cumsum(0) - u, t_ini=2, horizon=5)
        >>> policy = AttackPolicy(data, hidden=(8,), generator=torch.Generator().manual_seed(1))
        >>> policy(torch.zeros(3, 2, 1), torch.ones(3, 2, 1)).shape
        torch.Size([3, 2, 1])
    """

    scale: Tensor
    context: Tensor | None
    looks: Tensor

    def __init__(
        self,
        data: HankelData,
        *,
        hidden: Sequence[int] = (16,),
        context: Any = None,
        looks: int = 5,
        scale: Tensor | None = None,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_type("data", data, HankelData)
        check_type("hidden", hidden, (list, tuple))
        for name, count in (("looks", looks), *(("hidden", width) for width in hidden)):
            check_count(name, count)
        if context is not None and (context := as_data("context", context).double()).ndim != 2:
            raise ValueError(f"`context` must have shape (>= steps, n), got {tuple(context.shape)}.")
        looks = min(looks, data.horizon)
        self.data_sizes = data.t_ini, data.horizon, data.n_u, data.n_y
        past, ahead = (data.n_u, data.n_y), (data.n_u, data.n_y, *(() if context is None else context.shape[1:]))
        #: Channels and entries of the parts of x.
        self.channels = [*past, *ahead]
        self.sizes = [*(data.t_ini * n for n in past), *(looks * n for n in ahead)]
        n_x, out = sum(self.sizes), data.t_ini * data.n_y
        scale = torch.ones(n_x, dtype=torch.float64) if scale is None else scale
        for name, value in (("context", context), ("scale", scale)):
            self.register_buffer(name, None if value is None else value.clone(memory_format=torch.contiguous_format))
        self.register_buffer("looks", torch.linspace(0, data.horizon - 1, looks).round().long(), persistent=False)
        self.skip = _linear(n_x, out, generator)
        widths = [n_x, *hidden, out] if hidden else []
        self.hidden = nn.ModuleList(_linear(n, m, generator) for n, m in itertools.pairwise(widths))

    @classmethod
    def for_windows(cls, data: HankelData, recorded: Sequence[Any], **options: Any) -> AttackPolicy:
        """Return a policy scaled by recorded inputs: by the root mean square of each channel, an idle one by 1.

        Args:
            data: as for the constructor.
            recorded: arguments of a call: u_ini, y_ini, y_ref, u_ref, step, with one batch dimension where they vary.
            options: `hidden`, `context`, `looks` and `generator` of the constructor.
        """
        seen = {key: value for key, value in options.items() if key in ("context", "looks")}
        raw = cls(data, hidden=(), **seen)
        scales = []
        for part, channels in zip(raw._parts(*recorded), raw.channels, strict=True):
            size = part.reshape(-1, channels).square().mean(0).sqrt()
            scales.append(torch.where(size > 0, size, 1.0).repeat(part.shape[-1] // channels))
        return cls(data, scale=torch.cat(scales), **options)

    @classmethod
    def from_state_dict(cls, data: HankelData, state: Mapping[str, Tensor]) -> AttackPolicy:
        """Return the policy of a `state_dict`, whatever its widths; data as for the constructor."""
        widths = [len(tensor) for name, tensor in state.items() if re.fullmatch(r"hidden\.\d+\.bias", name)]
        context, scale = state.get("context"), state["scale"]
        channels = data.n_u + data.n_y + (0 if context is None else context.shape[1])
        looks = (len(scale) - data.t_ini * (data.n_u + data.n_y)) // channels
        policy = cls(data, hidden=widths[:-1], context=context, looks=looks, scale=scale)
        policy.load_state_dict(state)
        return policy

    def forward(self, u_ini: Any, y_ini: Any, y_ref: Any = None, u_ref: Any = None, step: Any = 0) -> Tensor:
        """Return a direction, `(*batch, t_ini, n_y)`, float64; only its direction counts.

        Args:
            u_ini, y_ini: past windows, `(*batch, t_ini, n)`.
            y_ref, u_ref: references, broadcast to `(*batch, horizon, n)`; zero by default.
            step: of the run, an integer, or one for each sample, `(*batch,)`.
        """
        layers = [self.skip, *self.hidden[:1]]
        first = (torch.cat([layer.weight for layer in layers]) / self.scale).mT  # the first layers, as a map of x
        total = torch.cat([layer.bias for layer in layers])
        for part, rows in zip(self._parts(u_ini, y_ini, y_ref, u_ref, step), first.split(self.sizes), strict=True):
            total = total + part @ rows
        direction, z = total.split((self.skip.out_features, total.shape[-1] - self.skip.out_features), dim=-1)
        for layer in self.hidden[1:]:
            z = layer(z.relu())
        if len(self.hidden):
            direction = direction + z
        return direction.unflatten(-1, (self.data_sizes[0], self.data_sizes[3]))

    def _parts(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any, step: Any) -> list[Tensor]:
        """Return the parts of x flattened, `(*batch, size)` each; the batches broadcast."""
        t_ini, horizon, n_u, n_y = self.data_sizes
        u_ini, y_ini = window("u_ini", u_ini, t_ini, n_u, "n_u"), window("y_ini", y_ini, t_ini, n_y, "n_y")
        ahead = [
            reference("u_ref", u_ref, horizon, n_u, "n_u", u_ini)[..., self.looks, :],
            reference("y_ref", y_ref, horizon, n_y, "n_y", y_ini)[..., self.looks, :],
        ]
        if self.context is not None:
            rows = torch.as_tensor(step, device=self.looks.device)[..., None] + self.looks
            ahead.append(self.context[rows.clamp(max=len(self.context) - 1)])
        return [part.flatten(-2).to(self.scale) for part in (u_ini, y_ini, *ahead)]

    def __repr__(self) -> str:
        t_ini, horizon, n_u, n_y = self.data_sizes
        widths = [layer.out_features for layer in self.hidden]
        count = sum(parameter.numel() for parameter in self.parameters())
        return f"AttackPolicy({t_ini=}, {horizon=}, {n_u=}, {n_y=}, {widths=}, {count} parameters)"


class PolicyAttack(nn.Module, Attack):
    """A network chooses the direction, the budget the size.

    The network sees what Algorithm 1 sees, the windows and the references, and returns a direction d, `(*batch, t_ini,
    n_y)`. The attack is a point of the budget that is as far out along d as the budget allows, in one of two ways:

        reach="support":     p = argmax over the budget of <d, p>, as Algorithm 1 does with d = -grad;
        reach="projection":  p = Proj(|s| d / |d|), s that support point.

    For balls the two are one, p = radius d / |d|. The support point is smooth in d where the budget has no corners
    (balls and ellipsoids, for which it is the default). Where it has, the support point is a corner whose derivative is
    zero and from which nothing could be learned; the projection still has one. At d = 0 both are 0.

    p carries the graph of the network's parameters and of the measurements, so the attack can be trained through the
    layer, and through a closed loop by `simulate` with a differentiable plant. `requires_grad_(False)` on the network
    makes it as free of graphs as the other attacks.

    Args:
        policy: (u_ini, y_ini, y_ref, u_ref, step) -> d: a :class:`torch_dpc.attacks.AttackPolicy`, or any module.
        budget: the admissible perturbations.
        reach: "support" or "projection"; by default what suits the budget.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> data = dpc.HankelData.from_trajectories(*dpc.collect(plant, 120, generator=generator), t_ini=4, horizon=10)
        >>> policy = dpc.attacks.AttackPolicy(data, generator=generator)
        >>> attack = PolicyAttack(policy, dpc.attacks.RelativeBall(0.1))
        >>> p = attack(torch.zeros(4, 2), torch.ones(4, 4))
        >>> p.shape, round(float(p.detach().norm() / torch.ones(4, 4).norm()), 6)
        (torch.Size([4, 4]), 0.1)
    """

    def __init__(self, policy: nn.Module, budget: Budget, *, reach: str | None = None):
        nn.Module.__init__(self)
        check_callable("policy", policy)
        check_type("budget", budget, Budget)
        if reach not in (None, "support", "projection"):
            raise ValueError(f'`reach` must be "support", "projection" or None, got {reach!r}.')
        self.policy = policy
        self.budget = budget
        self.reach = reach or ("support" if isinstance(budget, (BallBudget, EllipsoidBudget)) else "projection")

    def __repr__(self) -> str:
        return f"PolicyAttack({shown(self.policy)}, budget={self.budget}, reach={self.reach!r})"

    forward = Attack.__call__

    def _perturb(self, call: AttackCall) -> Tensor:
        direction = self.policy(call.u_ini, call.y_ini, call.y_ref, call.u_ref, call.step)
        if direction.shape != call.y_ini.shape:
            raise ValueError(
                f"`policy` must return a direction of the shape of y_ini, {tuple(call.y_ini.shape)}, got "
                f"{tuple(direction.shape)}."
            )
        if not is_finite(direction):
            raise ValueError(
                "`policy` returned a direction that is not finite; its weights or inputs are out of range."
            )
        return self._reach(direction.to(call.y_ini), call.y_ini)

    def _reach(self, direction: Tensor, y_ini: Tensor) -> Tensor:
        support = self.budget.minimize_linear(-direction, y_ini)
        if self.reach == "support":
            return support
        length, size = (torch.linalg.vector_norm(x, dim=(-2, -1), keepdim=True) for x in (support, direction))
        # Nothing of length 0 is projected: a budget may divide by it.
        somewhere = torch.where(size > 0, direction, 1.0) * (_or_one(length) / _or_one(size))
        return torch.where(size > 0, self.budget.project(somewhere, y_ini), 0.0)


def _or_one(size: Tensor) -> Tensor:
    return torch.where(size > 0, size, 1.0)


def _linear(n: int, m: int, generator: torch.Generator | None) -> nn.Linear:
    """Return a linear layer whose weights come from the generator, of variance 1 / n; the biases are 0."""
    layer = nn.utils.skip_init(nn.Linear, n, m, dtype=torch.float64)
    with torch.no_grad():
        layer.weight.copy_(
            math.sqrt(3 / max(n, 1)) * (2 * torch.rand(m, n, dtype=torch.float64, generator=generator) - 1)
        )
        layer.bias.zero_()
    return layer
