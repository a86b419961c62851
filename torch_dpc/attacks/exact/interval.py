"""What a budget can do to a linear function of the plan, certified."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...checks import as_data, check_number
from ...layer import DPCLayer
from ..budgets import Budget
from .complementarity import DEPENDENT, FREE, Array, allowed_states
from .moments import Moments
from .relaxation import DUAL_SLACK, Linear
from .window import Window, check_problem

#: To which fraction of its first width an interval is computed.
PRECISION = 1e-3


@dataclass(frozen=True, eq=False)
class CertifiedInterval:
    """Bounds of a linear function of the plan over every perturbation of a budget.

    Attributes:
        lower, upper: no perturbation of the budget leaves them, `(*batch,)`, float64.
        nominal: its value without an attack, `(*batch,)`.
    """

    lower: Tensor
    upper: Tensor
    nominal: Tensor

    @property
    def width(self) -> Tensor:
        """The length of the interval, `(*batch,)`."""
        return self.upper - self.lower

    def __repr__(self) -> str:
        if self.nominal.ndim:
            return f"CertifiedInterval(batch={tuple(self.nominal.shape)}, widest={float(self.width.max()):.4g})"
        return (
            f"CertifiedInterval({float(self.lower):.6g} to {float(self.upper):.6g}, nominal={float(self.nominal):.6g})"
        )


def certified_interval(
    layer: DPCLayer,
    c: Any,
    budget: Budget,
    u_ini: Any,
    y_ini: Any,
    *,
    c_y: Any = None,
    y_ref: Any = None,
    u_ref: Any = None,
    time_limit: float = 10.0,
) -> CertifiedInterval:
    """Return an interval that holds <c, u*(p)> + <c_y, y*(p)> for every p of the budget, of any attack.

    Two certificates, the tighter end of each counts. The projection that makes a plan is firmly nonexpansive, so that
    with v = C x and x a projection of x0 + X p

        |c'dv| <= (|c'Vp p| + |C'c| |X p|) / 2.

    The moment relaxation (:mod:`torch_dpc.attacks.exact.moments`) knows the budget, the bounds and the complementarity
    of the window at hand; it is skipped where rows within reach of their bounds depend on each other. Bounds of outputs
    count in both. Perturbations that leave the controller without a plan have no u* and are left out.

    Args:
        layer: its sets are boxes; one problem, not a batch of weights.
        c: weights of the inputs, `(horizon, n_u)`, or anything that broadcasts to it.
        budget: a ball, box, ellipsoid, balls for each channel, or any other that has `norm_bounds`.
        u_ini, y_ini: the true windows, `(*batch, t_ini, n)`.
        c_y: weights of the plan's outputs, `(horizon, n_y)`; 0 by default.
        y_ref, u_ref: references, as the layer takes them.
        time_limit: for each sample [s]; the interval is valid, and wider, where it ends early.

    Raises:
        ValueError: a budget or layer of another kind; bad windows or weights.
        SolveError: there is no plan without an attack.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 120, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u, y, t_ini=4, horizon=5)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-0.5, 0.5))
        >>> first = torch.zeros(5, 2)
        >>> first[0, 0] = 1.0  # the first planned input of the first actuator
        >>> budget = dpc.attacks.BallBudget(0.05)
        >>> interval = certified_interval(layer, first, budget, u[:4], y[:4])
        >>> attacked = layer(u[:4], y[:4] + budget.random(y[:4], generator)).u[0, 0]
        >>> bool(interval.lower <= attacked <= interval.upper)
        True
    """
    check_problem(layer, budget)
    check_number("time_limit", time_limit, positive=True, finite=False)
    data = layer.data
    weights = (
        _weights("c", c, data.horizon, data.n_u),
        _weights("c_y", 0.0 if c_y is None else c_y, data.horizon, data.n_y),
    )
    c_v = np.concatenate(weights)
    theta, _ = layer.flatten(as_data("u_ini", u_ini), as_data("y_ini", y_ini), y_ref, u_ref)
    flat = theta.reshape(-1, theta.shape[-1]).detach()
    ends = [_interval(Window(layer, budget, one), c_v, time.monotonic() + time_limit) for one in flat]
    table = torch.tensor(ends, dtype=torch.float64).reshape(-1, 3)
    lower, upper, nominal = (column.reshape(theta.shape[:-1]) for column in table.unbind(1))
    return CertifiedInterval(lower, upper, nominal)


def _weights(name: str, value: Any, horizon: int, n: int) -> Array:
    tensor = as_data(name, value).detach().double().cpu()
    try:
        return tensor.expand(horizon, n).flatten().numpy()
    except RuntimeError as error:
        raise ValueError(
            f"`{name}` must have shape (horizon, n) = ({horizon}, {n}), got {tuple(tensor.shape)}."
        ) from error


def _interval(window: Window, c: Array, deadline: float) -> tuple[float, float, float]:
    """Return lower and upper end, and the value of the plan without an attack."""
    nominal = float(c @ (window.v0 - window.G @ window.lam))
    if not window.A.size:
        return nominal, nominal, nominal
    reach = _by_nonexpansiveness(window, c)
    lower, upper, unseen = nominal - reach, nominal + reach, _effect_of_unseen(window, c)
    if reach == 0.0:
        return nominal, nominal, nominal
    index = np.flatnonzero(window.has_bound)
    for _ in range(2):  # intervals of fewer rows, which may be independent, are narrower
        rows = window.rows(index)
        rows.propagate()
        index = index[allowed_states(rows) != FREE]
    rows = window.rows(index)
    rows.propagate()
    if rows.H is None:
        return lower - unseen, upper + unseen, nominal
    moments = Moments(rows, window.of_s.pieces, window.lam[index])
    value = float(c @ window.v0), c @ window.A / reach, -(c @ window.G[:, index]) / reach
    for sign in (1.0, -1.0):
        F = moments.linear(Linear(sign * value[1], sign * value[2]))
        bounded = moments.minimum(F, tolerance=PRECISION, deadline=deadline)
        if bounded is not None:
            least = reach * (bounded.bound - DUAL_SLACK * (1 + abs(bounded.bound)))
            lower, upper = (max(lower, value[0] + least), upper) if sign > 0 else (lower, min(upper, value[0] - least))
    return lower - unseen, upper + unseen, nominal


def _effect_of_unseen(window: Window, c: Array) -> float:
    """Return by how much the directions of p that were dropped can move c'v."""
    values = np.linalg.eigvalsh(window.G)
    least = values[values > DEPENDENT * values[-1]][0]
    return window.of_s.unseen * float(np.sqrt(max(c @ window.G @ c, 0.0) / least))


def _by_nonexpansiveness(window: Window, c: Array) -> float:
    """Return (|c'Vp p| + |C'c| |X p|) / 2 at its largest over the budget, G = C C'."""
    values, vectors = np.linalg.eigh(window.G)
    root = vectors / np.sqrt(np.where(values > DEPENDENT * values[-1], values, np.inf))
    X = root.T @ window.A
    radius = float(np.linalg.norm(window.of_s.most(X)))
    pieces = window.of_s.pieces
    if len(pieces) == 1:
        radius = min(radius, float(np.linalg.norm(X @ np.linalg.pinv(pieces[0].matrix), 2)) * pieces[0].radius)
    direct = float(window.of_s.most(c[None] @ window.A)[0])
    return (direct + float(np.sqrt(max(c @ window.G @ c, 0.0))) * radius) / 2
