"""The last steps of a run, of which every plan is made."""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data


class Past:
    """The last `t_ini` inputs and outputs of one run, or of a batch of runs.

    Args:
        t_ini: steps that are kept.
    """

    def __init__(self, t_ini: int):
        self.us: deque[Tensor] = deque(maxlen=t_ini)
        self.ys: deque[Tensor] = deque(maxlen=t_ini)
        self.t_ini = t_ini

    @classmethod
    def of(cls, t_ini: int, n_u: int, n_y: int, u_past: Any, y_past: Any) -> Past:
        """Return the end of recorded windows, `(*batch, >= t_ini, n)`; empty for None and None.

        Raises:
            ValueError: one without the other, or shapes that do not fit.
        """
        past = cls(t_ini)
        if (u_past is None) != (y_past is None):
            raise ValueError("give both `u_past` and `y_past`, or neither.")
        if u_past is not None:
            past.us.extend(_rows("u_past", u_past, t_ini, n_u))
            past.ys.extend(_rows("y_past", y_past, t_ini, n_y))
        return past

    @property
    def is_full(self) -> bool:
        """Whether a plan can be made."""
        return len(self.us) == self.t_ini

    def append(self, u: Tensor, y: Tensor) -> None:
        """Add a step: u, `(*batch, n_u)`, is applied at y, `(*batch, n_y)`."""
        self.us.append(u)
        self.ys.append(y)

    def windows(self) -> tuple[Tensor, Tensor]:
        """Return u_ini and y_ini, `(*batch, t_ini, n)`."""
        return torch.stack(tuple(self.us), -2), torch.stack(tuple(self.ys), -2)


def _rows(name: str, past: Any, t_ini: int, channels: int) -> tuple[Tensor, ...]:
    past = as_data(name, past)
    if past.ndim < 2 or past.shape[-2] < t_ini or past.shape[-1] != channels:
        raise ValueError(f"`{name}` must have shape (*batch, >= {t_ini}, {channels}), got {tuple(past.shape)}.")
    return past.unbind(-2)
