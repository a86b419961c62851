"""The interface of a budget, and what they share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ... import batching


class Budget:
    """An admissible set of perturbations p: closed, and with every p it holds s p, 0 <= s <= 1.

    Write your own by giving `minimize_linear` and `project`.
    """

    #: Whether the set is convex, so that a mean of two admissible perturbations is admissible.
    convex = True

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        """Return argmin over the set of <c, p>, and 0 where c = 0; all `(*batch, t_ini, n_y)`."""
        raise NotImplementedError

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        """Return the nearest admissible perturbation, in the Euclidean norm."""
        raise NotImplementedError

    def random(self, y_ini: Tensor, generator: Any = None) -> Tensor:
        """Return a random perturbation that spends the whole budget."""
        return self.minimize_linear(-standard_normal(y_ini, generator), y_ini)

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={_shown(value)}" for name, value in vars(self).items())
        return f"{type(self).__name__}({fields})"

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        """Return how far p is outside the set, relative to its size, `(*batch,)`; zero or less when admissible."""
        outside = euclidean(p - self.project(p, y_ini))[..., 0, 0]
        return outside / euclidean(p)[..., 0, 0].clamp_min(torch.finfo(p.dtype).tiny)


def standard_normal(y_ini: Tensor, generator: Any) -> Tensor:
    """Return standard normal numbers of the shape of a window; `generator` may be a list, one a run."""
    return batching.standard_normal(y_ini, generator, tail=2)


def euclidean(p: Tensor) -> Tensor:
    """Euclidean norm of each window, `(*batch, 1, 1)`."""
    return torch.linalg.vector_norm(p, dim=(-2, -1), keepdim=True)


def direction(c: Tensor) -> Tensor:
    """Return c / |c|, and 0 where c = 0."""
    size = euclidean(c)
    return torch.where(size > 0, c / torch.where(size > 0, size, 1.0), 0.0)


def ratio(size: Tensor, reach: Tensor) -> Tensor:
    """Return size / reach: 0 where the size is 0, infinity where a size meets no reach."""
    return torch.where(size > 0, size / reach, 0.0)


def nonnegative(name: str, value: Any) -> Tensor:
    """Return a size as a float64 tensor, with its graph, or say what is wrong with it."""
    tensor = value.double() if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
    if not bool((tensor >= 0).all()) or not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"`{name}` must be finite and not negative, got {value!r}.")
    return tensor


def _shown(value: Any) -> str:
    return str(value.tolist()) if isinstance(value, Tensor) else repr(value)
