"""What inputs truly lead to, and what that costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from ..checks import as_data, as_index, check_type
from ..reprs import Described

#: What inputs do from a window on: (u_ini, y_ini, u) -> y, all `(*batch, steps, n)`. A
#: :class:`torch_dpc.attacks.Predictor` is one. Its data should not be those of the layer: a layer with a large lambda_g
#: plans with the predictor of its own data, and would be judged by its own model.
OutputModel = Callable[[Tensor, Tensor, Tensor], Tensor]
#: What a stretch of a run costs: (u, y, u_ref, y_ref), `(*batch, steps, n)` each, -> `(*batch,)`.
RunCost = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


class MeanError(Described):
    """The mean over the steps of |(y - y_ref)[channels]|, in the units of the outputs.

    Example:
        >>> import torch
        >>> y = torch.tensor([[3.0, 4.0, 9.0], [0.0, 0.0, 9.0]])
        >>> MeanError([0, 1])(None, y, None, torch.zeros(2, 3))
        tensor(2.5000)
    """

    #: Below this an error is rounded off, so that the derivative at zero exists [units of the outputs].
    SMOOTH = 1e-6

    def __init__(self, channels: Sequence[int]):
        check_type("channels", channels, (list, tuple, range))
        rule = "`channels` must be integers, 0 or more, at least one"
        self.channels = [as_index(rule, channel) for channel in channels]
        if not self.channels or min(self.channels) < 0:
            raise ValueError(f"{rule}, got {channels!r}.")

    def __call__(self, u: Any, y: Tensor, u_ref: Any, y_ref: Tensor) -> Tensor:
        """Return the error, `(*batch,)`."""
        square = (y - y_ref)[..., self.channels].square().sum(-1)
        return ((square + self.SMOOTH**2).sqrt() - self.SMOOTH).mean(-1)


class QuadraticCost(Described):
    """The mean over the steps of 1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2.

    Args:
        Q, R: fixed weights of one step, `(n_y, n_y)` and `(n_u, n_u)`.
    """

    def __init__(self, Q: Tensor, R: Tensor):
        self.Q, self.R = (_square(name, weight) for name, weight in (("Q", Q), ("R", R)))

    def __call__(self, u: Tensor, y: Tensor, u_ref: Tensor, y_ref: Tensor) -> Tensor:
        """Return the cost, `(*batch,)`."""
        of_y = (((y - y_ref) @ self.Q) * (y - y_ref)).sum(-1)
        of_u = (((u - u_ref) @ self.R) * (u - u_ref)).sum(-1)
        return 0.5 * (of_y + of_u).mean(-1)


def _square(name: str, weight: Any) -> Tensor:
    weight = as_data(name, weight)
    if weight.ndim != 2 or weight.shape[0] != weight.shape[1]:
        raise ValueError(f"`{name}` must be the weight of one step, (n, n), got {tuple(weight.shape)}.")
    return weight
