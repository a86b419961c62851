"""Windows and references of one layer, made to fit another: a surrogate may look further, or less far."""

from __future__ import annotations

import torch
from torch import Tensor


def to_horizon(reference: Tensor, horizon: int) -> Tensor:
    """Return a reference `(..., rows, n)` of `horizon` rows: cut, or the last row held.

    One row, or `(n,)`, broadcasts over every horizon and is left alone.
    """
    if reference.ndim < 2 or reference.shape[-2] == 1:
        return reference
    rows = reference.shape[-2]
    if rows >= horizon:
        return reference[..., :horizon, :]
    held = reference[..., -1:, :].expand(*reference.shape[:-2], horizon - rows, reference.shape[-1])
    return torch.cat([reference, held], dim=-2)


def last_rows(window: Tensor, t_ini: int) -> Tensor:
    """Return the last `t_ini` steps of a window `(..., rows, n)`.

    Raises:
        ValueError: the window is shorter.
    """
    if window.shape[-2] < t_ini:
        raise ValueError(
            f"the windows have {window.shape[-2]} steps, and the attacker's data need t_ini = {t_ini}: an attacker may "
            "look at fewer past steps than the controller, not at more."
        )
    return window[..., -t_ini:, :]
