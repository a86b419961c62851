"""What attacks of several sizes do to the plans of a saved layer, from windows of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .. import attacks, plot
from ..data.hankel import HankelData
from ..data.predictor import Predictor
from ..errors import Status
from ..layer import DPCLayer
from ..problem.weights import weight_matrix

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Damage:
    """What one attack of one size does, over the windows.

    Attributes:
        attack: its name.
        rho: its size relative to |y_ini|.
        input_change: largest change of a planned input, `(windows,)`, in the units of the inputs.
        increase: of the predicted error, relative to that without an attack, `(windows,)`.
        unsolved: share of the windows from which no plan was found under the attack.
    """

    attack: str
    rho: float
    input_change: Tensor
    increase: Tensor
    unsolved: float


@dataclass(frozen=True, eq=False)
class Audit:
    """The damage of every attack.

    Attributes:
        nominal: predicted error without an attack, `(windows,)`: the root mean square of |y - y_ref|_Q over the
            horizon, y what the data predict for the planned inputs from the true window.
        damages: one for each attack and size.
        skipped: windows from which the layer has no plan even without an attack.
    """

    nominal: Tensor
    damages: list[Damage]
    skipped: int

    def plot(self) -> Figure:
        """Draw the errors against the size of the attack."""
        curves: dict[str, dict[float, Tensor]] = {}
        for damage in self.damages:
            curves.setdefault(damage.attack, {0.0: 0 * self.nominal})[damage.rho] = 100 * damage.increase
        return plot.damage(curves, ylabel="increase of the predicted error [%]", unit="windows")


def audit(
    layer: DPCLayer,
    u: Tensor,
    y: Tensor,
    *,
    rhos: Sequence[float],
    windows: int,
    y_ref: Tensor,
    seed: int,
    u_ref: Tensor | None = None,
) -> Audit:
    """Attack the plans of a layer: random noise, Algorithm 1 and projected gradient, each within |p| <= rho |y_ini|.

    The attacker wants the outputs away from their reference (:class:`torch_dpc.attacks.TrackingError`).

    Args:
        layer: the planning problem.
        u, y: a recording, `(T, n_u)` and `(T, n_y)`, whose windows are the initial conditions.
        rhos: sizes of the attack.
        windows: how many, evenly spread.
        y_ref: reference, `(n_y,)`.
        seed: of the random noise.
        u_ref: input reference, `(n_u,)`; zero by default.

    Raises:
        ValueError: a recording of other channels than the layer's, or shorter than a window; no window has a plan.
    """
    data = layer.data
    assert isinstance(data, HankelData)  # a batch of data sets cannot be saved
    if (u.shape[1], y.shape[1]) != (data.n_u, data.n_y):
        raise ValueError(
            f"the layer has {data.n_u} inputs and {data.n_y} outputs, the recording {u.shape[1]} and {y.shape[1]}."
        )
    if len(u) < data.t_ini:
        raise ValueError(f"the recording must have at least t_ini = {data.t_ini} samples, got {len(u)}.")
    layer.on_failure = "nan"
    references = {"y_ref": y_ref, "u_ref": u_ref}
    places = torch.linspace(0, len(u) - data.t_ini, windows).round().long().unique()
    u_ini, y_ini = (x.unfold(0, data.t_ini, 1).mT[places] for x in (u, y))
    solvable = layer(u_ini, y_ini, **references).info.status == Status.SOLVED
    if not bool(solvable.any()):
        raise ValueError("the layer has no plan from any window of the recording: do its units match?")
    u_ini, y_ini = u_ini[solvable], y_ini[solvable]
    predictor, weight = Predictor(data), weight_matrix("Q", layer.Q, data.n_y, data.horizon).detach()
    nominal = layer(u_ini, y_ini, **references).u

    def error(planned: Tensor) -> Tensor:
        away = (predictor(u_ini, y_ini, planned) - y_ref).flatten(-2)
        return ((away @ weight) * away).sum(-1).div(data.horizon).sqrt()

    before = error(nominal)
    cost, damages = attacks.TrackingError(data, weight), []
    for rho in rhos:
        budget = attacks.RelativeBallBudget(rho)
        for name, attack in (
            ("random noise", attacks.RandomAttack(budget)),
            ("Algorithm 1", attacks.LinearizedAttack(layer, cost, budget)),
            ("projected gradient", attacks.ProjectedGradientAttack(layer, cost, budget)),
        ):
            p = attack(u_ini, y_ini, **references, generator=torch.Generator().manual_seed(seed))
            plan = layer(u_ini, y_ini + p, **references)
            kept = plan.info.status == Status.SOLVED
            change = (plan.u - nominal).abs().amax((-2, -1))
            increase = error(plan.u) / before - 1
            damages.append(Damage(name, rho, change[kept], increase[kept], 1 - float(kept.double().mean())))
    return Audit(before, damages, int((~solvable).sum()))
