"""What an attacker sees when a controller plans, and many closed loops at once, differentiably."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

import torch_dpc as dpc

TRAINING, HELD_OUT = 100, 200  # seeds of the trained controller's data, and of what is kept back


@dataclass(frozen=True, eq=False)
class Windows:
    """What an attacker sees when a controller plans.

    Attributes:
        u_ini, y_ini: `(n, t_ini, n_u)`, `(n, t_ini, n_y)`.
        y_ref, u_ref: `(n, horizon, n)`, or `(horizon, n)` where all are the same.
        step: of the run, `(n,)`.
    """

    u_ini: Tensor
    y_ini: Tensor
    y_ref: Tensor
    u_ref: Tensor
    step: Tensor

    def __len__(self) -> int:
        return len(self.step)

    def __getitem__(self, index: Any) -> Windows:
        """Return some of the windows; references that all share are not indexed."""
        return Windows(**{k: v if v.ndim == 2 else v[index] for k, v in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def attacked_by(self, attack: Any, **options: Any) -> Tensor:
        """Return what an attack adds."""
        return attack(self.u_ini, self.y_ini, y_ref=self.y_ref, u_ref=self.u_ref, **options)

    def plan(self, layer: dpc.DPCLayer, p: Tensor | float = 0.0) -> dpc.DPCSolution:
        """Return what the controller plans when p is added."""
        return layer(self.u_ini, self.y_ini + p, y_ref=self.y_ref, u_ref=self.u_ref)

    @staticmethod
    def joined(parts: Sequence[Windows]) -> Windows:
        """Return all windows of several recordings; what is shared stays shared."""
        first = parts[0].tensors()
        return Windows(
            **{k: v if v.ndim == 2 else torch.cat([part.tensors()[k] for part in parts]) for k, v in first.items()}
        )


def closed_loops(
    layer: dpc.DPCLayer,
    attack: Any,
    model: Callable[[list[Tensor], list[Tensor]], Tensor],
    past: tuple[list[Tensor], list[Tensor]],
    references: Callable[[int], dict[str, Tensor]],
    *,
    steps: int,
    replan_every: int,
) -> tuple[Tensor, Windows]:
    """Run many closed loops at once, each as `dpc.simulate` runs one; with the graph of the attack.

    Args:
        layer: of the controller.
        attack: with the call of every attack, on batches; None for none.
        model: (inputs, outputs) up to a step, each `(runs, n)` -> the outputs after it.
        past: inputs and outputs before the first step, at least `t_ini` of each.
        references: a step -> y_ref and u_ref over the horizon from it, shared or one a run.
        steps: under control.
        replan_every: steps between two plans.

    Returns:
        The true outputs, `(runs, steps, n_y)`, and the windows of every step, one batch a step in turn.
    """
    (us, ys), t_ini, windows = (list(part) for part in past), layer.data.t_ini, []
    first, y = len(ys), model(*past)
    for k in range(steps):
        u_ini, y_ini = torch.stack(us[-t_ini:], dim=1), torch.stack(ys[-t_ini:], dim=1)
        windows.append(Windows(u_ini, y_ini, **references(k), step=torch.full((len(y),), k)))
        if k % replan_every == 0:
            p = 0.0 if attack is None else windows[-1].attacked_by(attack, step=k)
            plan = windows[-1].plan(layer, p).u
        us.append(plan[:, k % replan_every])
        ys.append(y)
        y = model(us, ys)
    return torch.stack(ys[first:], dim=1), Windows.joined(windows)


def drawn(rhos: Sequence[float], n: int, generator: torch.Generator) -> Tensor:
    """Return n values of rho, `(n,)`."""
    return torch.tensor(rhos, dtype=torch.float64)[torch.randint(len(rhos), (n,), generator=generator)]
