"""A box as two tensors over all constrained rows, the form in which most problems are solved."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Bounds:
    """lower <= v <= upper for v = (u, y, du).

    Attributes:
        lower, upper: `(N,)` or `(*batch, N)`, float64.
    """

    lower: Tensor
    upper: Tensor

    is_box = True
    is_piecewise_affine = True

    @property
    def tensors(self) -> tuple[Tensor, Tensor]:
        """The tensors that a derivative may be asked of."""
        return self.lower, self.upper

    @property
    def are_shared(self) -> bool:
        """Whether all samples have the same bounds."""
        return self.lower.ndim == self.upper.ndim == 1

    def with_tensors(self, tensors: Iterable[Tensor]) -> Bounds:
        """Return the bounds with these in place of `tensors`; itself if they are the same."""
        lower, upper = tensors
        return self if lower is self.lower and upper is self.upper else Bounds(lower, upper)

    def batches(self, device: torch.device) -> list[tuple[str, torch.Size]]:
        """Return the batch dimensions of both, by name."""
        if self.are_shared:
            return []
        return [("lower", self.lower.shape[:-1]), ("upper", self.upper.shape[:-1])]

    def of_samples(self, samples: Tensor) -> Bounds:
        """Return the bounds of some samples of a flattened batch."""
        return Bounds(*(bound if bound.ndim == 1 else bound[samples] for bound in self.tensors))

    def supports(self, d: Tensor) -> Tensor:
        """Return the supremum of d_i v_i over each row's interval, `(..., N)`; it may be infinite."""
        return torch.where(d == 0, 0.0, d * torch.where(d > 0, self.upper, self.lower))

    def bounded_direction(self, d: Tensor) -> Tensor:
        """Return d `(..., N)` with zero where it points to a missing bound."""
        return torch.where(torch.where(d > 0, self.upper, self.lower).isfinite(), d, 0.0)

    def conjugate(self, lam: Tensor, v: Tensor) -> Tensor:
        """Return the supremum of <lam, v> over the box at optimal multipliers, `(...)`."""
        bound = torch.where(lam < 0, self.lower, torch.where(lam > 0, self.upper, 0.0))
        return (lam * bound).sum(-1)
