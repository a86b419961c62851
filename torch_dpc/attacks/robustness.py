"""How the damage of an attack grows with its budget."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .. import plot
from ..control.controller import DPCController
from ..control.simulation import simulate
from ..reprs import Described
from ..systems.plant import Plant
from .base import Attack
from .budgets import RelativeBallBudget

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class RobustnessCurve(Described):
    """The closed-loop error under an attack against its budget.

    Attributes:
        name: of the attack.
        rhos: relative budgets, `(n,)`; the first is 0, no attack.
        errors: mean of |y - y_ref| over the run, Euclidean over the channels, `(n, runs)`.
    """

    name: str
    rhos: Tensor
    errors: Tensor

    def plot(self, axes: Any = None) -> Figure:
        """Draw the median and the band from the 10th to the 90th percentile: :func:`torch_dpc.plot.damage`."""
        values = {float(rho): errors.numpy() for rho, errors in zip(self.rhos, self.errors, strict=True)}
        return plot.damage({self.name: values}, axes)

    def __str__(self) -> str:
        """Return a table: rho, the median error, and its 10th and 90th percentile."""
        lines = [f"{'rho':>8}{'median':>12}{'10 %':>12}{'90 %':>12}"]
        for rho, errors in zip(self.rhos.tolist(), self.errors, strict=True):
            low, middle, high = torch.quantile(errors, torch.tensor([0.1, 0.5, 0.9], dtype=errors.dtype)).tolist()
            lines.append(f"{rho:8.3%}{middle:12.4g}{low:12.4g}{high:12.4g}")
        return "\n".join(lines)


def robustness_curve(
    plant: Plant,
    controller: DPCController,
    attack: Attack | Callable[[float], Attack],
    rhos: Sequence[float],
    *,
    batch: int | None = None,
    y_ref: Any = None,
    steps: int = 200,
    channels: Sequence[int] | None = None,
    **run: Any,
) -> RobustnessCurve:
    """Run the closed loop under an attack with growing budgets |p| <= rho |y_ini|.

    Args:
        plant, controller: the closed loop.
        attack: its budget is replaced by a `RelativeBallBudget` of each rho; or rho -> attack.
        rhos: relative budgets; 0 is added in front where it is missing.
        batch: runs, for a plant that carries a batch; give them starts of their own by `reset=`.
        y_ref: reference, as :func:`torch_dpc.simulate` takes it; zero by default.
        steps: of each run.
        channels: of the outputs, whose error counts; all by default.
        run: further arguments of `simulate`.

    Raises:
        ValueError: no budgets, or a negative one.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-1.0, 1.0))
        >>> attack = dpc.attacks.LinearizedAttack(layer, dpc.attacks.TargetInput(torch.ones(2)), dpc.BallBudget(0.0))
        >>> start = {"state": torch.tensor([0.5, 0.5, 0.0, 0.0])}
        >>> curve = robustness_curve(plant, dpc.DPCController(layer, 5), attack, [0.1, 0.3], steps=20, reset=start)
        >>> curve.errors.shape, bool(curve.errors[2] > curve.errors[0])
        (torch.Size([3, 1]), True)
    """
    values = sorted({0.0, *(float(rho) for rho in rhos)})
    if not rhos or values[0] < 0:
        raise ValueError(f"`rhos` must hold at least one number, none of them negative, got {rhos!r}.")
    y_ref = torch.zeros(controller.layer.data.n_y, dtype=torch.float64) if y_ref is None else y_ref
    errors = []
    for rho in values:
        log = simulate(plant, controller, y_ref, steps=steps, batch=batch, attack=_with(attack, rho), **run)
        error = log.y.detach() - log.y_ref
        error = error if channels is None else error[..., list(channels)]
        errors.append(torch.linalg.vector_norm(error, dim=-1).mean(-1).reshape(-1))
    name = type(attack).__name__ if isinstance(attack, Attack) else getattr(attack, "__name__", "attack")
    return RobustnessCurve(name, torch.tensor(values, dtype=torch.float64), torch.stack(errors))


def _with(attack: Attack | Callable[[float], Attack], rho: float) -> Attack | None:
    if rho == 0.0:
        return None
    if not isinstance(attack, Attack):
        return attack(rho)
    sized = copy.copy(attack)
    sized.budget = RelativeBallBudget(rho)
    return sized
