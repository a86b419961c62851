"""What the `repr` of an object shows of its attributes: small values as they are, large ones by their shape."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .autodiff import is_plain

#: Tensors and lists of more entries are shown by their size.
SHOWN = 6


class Described:
    """An object whose `repr` is its class and its public attributes."""

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={shown(value)}" for name, value in vars(self).items() if not name.startswith("_"))
        return f"{type(self).__name__}({fields})"


def shown(value: Any) -> str:
    """Return a value in a few words.

    Example:
        >>> shown(1e6), shown(torch.ones(2)), shown(torch.ones(3, 4)), shown([1.0, torch.zeros(())])
        ('1e+06', '[1, 1]', 'tensor(3, 4)', '[1, 0]')
    """
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Tensor):
        return _shown_tensor(value)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(shown, value))}]" if len(value) <= SHOWN else f"{len(value)} entries"
    data = getattr(value, "data", None)  # a layer, or what plans like one
    if data is not None and hasattr(data, "horizon"):
        return f"{type(value).__name__}(n_u={data.n_u}, n_y={data.n_y}, horizon={data.horizon})"
    if type(value).__repr__ in (object.__repr__, torch.nn.Module.__repr__):
        return type(value).__name__
    return getattr(value, "__qualname__", None) or repr(value)


def _shown_tensor(value: Tensor) -> str:
    name = "Parameter" if isinstance(value, torch.nn.Parameter) else ""
    if value.ndim > 1 or value.numel() > SHOWN or not is_plain(value.detach()):
        return f"{name or 'tensor'}{tuple(value.shape)}"
    entries = [f"{entry:.6g}" for entry in value.detach().reshape(-1).tolist()]
    text = entries[0] if value.ndim == 0 else f"[{', '.join(entries)}]"
    return f"{name}({text})" if name else text
