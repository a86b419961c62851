"""The interface of a budget, and what they share."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ... import batching
from ...checks import as_numbers
from ...reprs import Described


class NormBound(NamedTuple):
    """|matrix p + offset| <= radius, Euclidean; one row is an interval.

    Attributes:
        matrix: `(k, t_ini n_y)`, float64; p is flattened, time-major.
        offset: `(k,)`.
        radius: not negative.
    """

    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]
    radius: float


class Budget(Described):
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

    def given(self, u_ini: Tensor) -> Budget:
        """Return the budget of windows with these inputs, `(*batch, t_ini, n_u)`; most do not depend on them."""
        return self

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        """Return pieces whose intersection is the set, for one window `(t_ini, n_y)`.

        Raises:
            ValueError: the set has no such form.
        """
        raise ValueError(
            f"{type(self).__name__} is no intersection of Euclidean norm bounds: take a BallBudget, BoxBudget, "
            "EllipsoidBudget or PerChannelBudget of balls."
        )

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


def norm_bound(scale: Tensor) -> list[NormBound]:
    """Return sum (p_i / scale_i)^2 <= 1 as pieces; an entry with scale 0 is an interval of radius 0."""
    reach = scale.detach().double().flatten().cpu().numpy()
    rows = np.eye(len(reach))
    free = reach > 0
    pieces = [NormBound(rows[i : i + 1], np.zeros(1), 0.0) for i in np.flatnonzero(~free)]
    if free.any():
        pieces.append(NormBound(rows[free] / reach[free, None], np.zeros(int(free.sum())), 1.0))
    return pieces


def nonnegative(name: str, value: Any) -> Tensor:
    """Return a size as a float64 tensor, with its graph, or say what is wrong with it."""
    tensor = as_numbers(name, value)
    if not bool((tensor >= 0).all()) or not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"`{name}` must be finite and not negative, got {value!r}.")
    return tensor
