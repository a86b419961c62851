"""Attacks on what the controller is told besides the measurements: past inputs and references."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, check_generator, last_rows, to_horizon
from ..layer import DPCLayer
from .base import Attack
from .budgets.base import Budget
from .costs import bound
from .gradient import LinearizedAttack
from .loop import IterativeAttack
from .random import RandomAttack

#: What an attack may be on.
SIGNALS = ("y_ini", "u_ini", "y_ref", "u_ref")


class AttackOn(Attack):
    """The same attack on another signal: p is added to u_ini, y_ref or u_ref in place of y_ini.

    The cost is bound to the true windows and references. Budgets are budgets of the signal: a relative one is relative
    to the signal's own size. The answer has the signal's shape; a reference counts with all rows of the horizon,
    `(*batch, horizon, n)`. :func:`torch_dpc.simulate` takes attacks on y_ini alone.

    A changed u_ini must fit the data: on noise-free data only some p leave the controller a plan, and an attack keeps
    to those that do.

    Args:
        signal: "y_ini", "u_ini", "y_ref" or "u_ref".
        attack: a `LinearizedAttack`, `ProjectedGradientAttack` or `FrankWolfeAttack` of a `DPCLayer`, or a
            `RandomAttack`.

    Raises:
        ValueError: another signal, or an attack of another kind.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4)
        >>> cost = dpc.attacks.TargetInput(torch.ones(2))
        >>> attack = AttackOn("y_ref", dpc.attacks.LinearizedAttack(layer, cost, dpc.BallBudget(0.1)))
        >>> p = attack(u[:4], y[:4], y_ref=torch.zeros(4))
        >>> p.shape, bool(cost(layer(u[:4], y[:4], y_ref=p)) < cost(layer(u[:4], y[:4])))
        (torch.Size([10, 4]), True)
    """

    def __init__(self, signal: str, attack: Attack):
        if signal not in SIGNALS:
            raise ValueError(f"`signal` must be one of {', '.join(SIGNALS)}, got {signal!r}.")
        gradient = isinstance(attack, LinearizedAttack | IterativeAttack) and isinstance(attack.layer, DPCLayer)
        if not (gradient or isinstance(attack, RandomAttack)):
            raise ValueError(
                "`attack` must be a LinearizedAttack, ProjectedGradientAttack or FrankWolfeAttack of a DPCLayer, or a "
                f"RandomAttack, got {type(attack).__name__}."
            )
        super().__init__(attack.budget)
        self.on, self.attack = signal, attack

    def __call__(
        self,
        u_ini: Any,
        y_ini: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        generator: torch.Generator | None = None,
        step: Any = 0,
    ) -> Tensor:
        """Return p, the shape of the signal; arguments as of every attack."""
        u_ini, y_ini = as_data("u_ini", u_ini), as_data("y_ini", y_ini)
        check_generator(generator)
        budget = self.budget.given(u_ini)
        true = {"u_ini": u_ini, "y_ini": y_ini, "y_ref": y_ref, "u_ref": u_ref}
        signal = true[self.on] if self.on in ("u_ini", "y_ini") else self._reference(self.on, true[self.on], y_ini)
        inner = _without_window(self.attack, budget)
        options: dict[str, Any] = {"generator": generator, "step": step}
        if isinstance(inner, LinearizedAttack | IterativeAttack):
            layer: Any = inner.layer
            inner.cost = bound(inner.cost, step, u_ini.double(), y_ini.double(), y_ref, u_ref)
            inner.layer = _Redirected(layer, self.on, u_ini.shape[-1])
            rows = max(signal.shape[-2], u_ini.shape[-2])
            carried = torch.cat([u_ini.expand(*y_ini.shape[:-1], -1), y_ini], -1)
            carried = torch.nn.functional.pad(carried, (0, 0, rows - carried.shape[-2], 0))
            refs = {"y_ref": y_ref, "u_ref": u_ref}
            return inner(carried, signal, **refs, **options)
        return inner(signal, signal, **options)

    def _reference(self, name: str, value: Any, y_ini: Tensor) -> Tensor:
        layer = getattr(self.attack, "layer", None)
        if layer is None:
            if value is None:
                raise ValueError(f"`{name}` must be given: a random attack knows no horizon.")
            tensor = as_data(name, value)
            return tensor if tensor.ndim > 1 else tensor[None]
        n = layer.data.n_y if name == "y_ref" else layer.data.n_u
        tensor = to_horizon(as_data(name, torch.zeros(n) if value is None else value), layer.data.horizon)
        return tensor.to(y_ini).expand(*y_ini.shape[:-2], layer.data.horizon, n)


def _without_window(attack: Attack, budget: Budget) -> Any:
    """Return the attack with a budget that no longer asks for the past inputs."""
    inner = copy.copy(attack)
    inner.budget = budget
    return inner


class _Redirected:
    """A layer whose argument `y_ini` stands for another signal; `u_ini` carries both true windows side by side."""

    def __init__(self, layer: DPCLayer, signal: str, n_u: int):
        self.layer, self.signal, self.n_u = layer, signal, n_u

    def __call__(self, u_ini: Tensor, y_ini: Tensor, *, y_ref: Any, u_ref: Any, **options: Any) -> Any:
        windows = last_rows(u_ini, self.layer.data.t_ini)
        told = {"u_ini": windows[..., : self.n_u], "y_ini": windows[..., self.n_u :], "y_ref": y_ref, "u_ref": u_ref}
        told[self.signal] = last_rows(y_ini, self.layer.data.t_ini) if self.signal.endswith("ini") else y_ini
        return self.layer(told["u_ini"], told["y_ini"], y_ref=told["y_ref"], u_ref=told["u_ref"], **options)
