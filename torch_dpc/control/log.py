"""What a run in closed loop leaves."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class ClosedLoopLog:
    """A run in closed loop; float64.

    Attributes:
        t: time [s], `(steps,)`; 0 is the first step under control.
        u: inputs applied, `(steps, n_u)`.
        y: true outputs, `(steps, n_y)`; y[k] is measured before u[k] is applied.
        y_ref: the reference, `(steps, n_y)`.
        p: what was added to y_ini at the plan in force, `(steps, t_ini, n_y)`.
        status: of the plan in force, a :class:`torch_dpc.Status`, `(steps,)`.
    """

    t: Tensor
    u: Tensor
    y: Tensor
    y_ref: Tensor
    p: Tensor
    status: Tensor
