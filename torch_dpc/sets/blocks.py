"""The structure of a product of sets, and block-diagonal matrices of that structure.

The Jacobian D1 of the projection onto a product has one block for every group of rows that a set holds, or is diagonal
there if the set acts on every entry alone. Everything works in *part order*, v[..., order]: the entries of one part
side by side.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..shapes import broadcast_shapes
from .base import ConvexSet, Part

#: The Jacobian of the projection, part by part: its diagonal `(..., groups, size)` where the set is separable, blocks
#: `(..., groups, size, size)` otherwise.
Blocks = list[Tensor]


@dataclass(frozen=True, eq=False)
class BlockStructure:
    """Which rows each set of a product holds.

    Attributes:
        parts: every set with the rows it holds for, `(groups, size)`.
        names: what each part belongs to, "u_set" and the like, for messages.
    """

    parts: list[Part]
    names: list[str]

    @cached_property
    def order(self) -> Tensor:
        """The rows of v in part order, `(N,)`."""
        return torch.cat([places.reshape(-1) for _, places in self.parts])

    @cached_property
    def inverse(self) -> Tensor:
        """Where each row of v stands in part order, `(N,)`."""
        return self.order.argsort()

    @cached_property
    def _slices(self) -> list[tuple[ConvexSet, slice, tuple[int, ...]]]:
        found, start = [], 0
        for owner, places in self.parts:
            found.append((owner, slice(start, start + places.numel()), tuple(places.shape)))
            start += places.numel()
        return found

    @property
    def tails(self) -> tuple[int, ...]:
        """How many dimensions of each block of D1 are its own."""
        return tuple(2 if owner.separable else 3 for owner, _ in self.parts)

    def complement_times(self, blocks: Blocks, matrix: Tensor) -> Tensor:
        """Return (I - D1) matrix, `(..., N, k)`."""
        out = []
        for (owner, at, shape), D in self._with(blocks):
            rows = matrix[..., at, :].unflatten(-2, shape)  # (..., groups, size, k)
            moved = D[..., None] * rows if owner.separable else D @ rows
            out.append((rows - moved).flatten(-3, -2))
        batch = broadcast_shapes(*(part.shape[:-2] for part in out))
        return torch.cat([part.expand(*batch, *part.shape[-2:]) for part in out], dim=-2)

    def freed(self, blocks: Blocks, weak: Tensor) -> Blocks:
        """Return D1 with the identity at the rows that count as inactive, `(..., N)`; a block is freed as a whole."""
        out = []
        for (owner, at, shape), D in zip(self._slices, blocks, strict=True):
            free = self._group(weak, at, shape)
            if owner.separable:
                out.append(torch.where(free, 1.0, D))
            else:
                eye = torch.eye(shape[-1], dtype=D.dtype, device=D.device)
                out.append(torch.where(free.all(-1)[..., None, None], eye, D))
        return out

    def apply(self, blocks: Blocks, x: Tensor) -> Tensor:
        """Return D1 x, `(..., N)`."""
        out = []
        for (owner, at, shape), D in zip(self._slices, blocks, strict=True):
            group = self._group(x, at, shape)
            out.append(flat(D * group if owner.separable else (D @ group[..., None])[..., 0]))
        return joined(out)

    def dense(self, blocks: Blocks) -> Tensor:
        """Return D1 as a matrix, `(..., N, N)`."""
        eye = torch.eye(len(self.order), dtype=blocks[0].dtype, device=blocks[0].device)
        return eye - self.complement_times(blocks, eye)

    def outer(self, x: Tensor, y: Tensor, blocks: Blocks) -> Blocks:
        """Return the entries of x y' where D1 has entries, summed to the shapes of `blocks`."""
        out = []
        for (owner, at, shape), D in zip(self._slices, blocks, strict=True):
            a, b = self._group(x, at, shape), self._group(y, at, shape)
            out.append((a * b if owner.separable else a[..., :, None] * b[..., None, :]).sum_to_size(D.shape))
        return out

    def spectral(self, blocks: Blocks) -> tuple[Tensor, Blocks]:
        """Return the eigenvalues of D1, `(..., N)`, and its eigenvectors block by block (ones where it is diagonal)."""
        values, vectors = [], []
        for (owner, _, _), D in zip(self._slices, blocks, strict=True):
            value, vector = (D, torch.ones_like(D)) if owner.separable else torch.linalg.eigh(_finite(D))
            values.append(flat(value))
            vectors.append(vector)
        return joined(values).clamp(0.0, 1.0), vectors

    def rotate(self, vectors: Blocks, x: Tensor, *, back: bool = False) -> Tensor:
        """Return W'x, W the eigenvectors, or W x, for x `(..., N)`."""
        return self.apply([W if back or owner.separable else W.mT for (owner, _, _), W in self._with(vectors)], x)

    def rotate_matrix(self, vectors: Blocks, G: Tensor) -> Tensor:
        """Return W'G W, `(..., N, N)`."""
        for (owner, at, shape), W in self._with(vectors):
            if not owner.separable:
                columns = G[..., at].unflatten(-1, shape)  # (..., N, groups, size)
                turned = torch.einsum("...ngs,...gst->...ngt", columns, W).flatten(-2)
                G = torch.cat(
                    [x.expand(*turned.shape[:-1], -1) for x in (G[..., : at.start], turned, G[..., at.stop :])], -1
                )
        for (owner, at, shape), W in self._with(vectors):
            if not owner.separable:
                rows = G[..., at, :].unflatten(-2, shape)  # (..., groups, size, N)
                turned = torch.einsum("...gsn,...gst->...gtn", rows, W).flatten(-3, -2)
                G = torch.cat([G[..., : at.start, :], turned, G[..., at.stop :, :]], dim=-2)
        return G

    def _with(self, blocks: Blocks) -> Iterable[tuple[tuple[ConvexSet, slice, tuple[int, ...]], Tensor]]:
        return zip(self._slices, blocks, strict=True)

    @staticmethod
    def _scale(gamma: Tensor | float, owner: ConvexSet, at: slice, shape: tuple[int, ...]) -> Tensor | float:
        """Return gamma of each group, `(..., groups, 1)`; of each entry of a separable set."""
        if isinstance(gamma, float):
            return gamma
        group = BlockStructure._group(gamma, at, shape)
        return group if owner.separable else group[..., :1]

    @staticmethod
    def _group(x: Tensor, at: slice, shape: tuple[int, ...]) -> Tensor:
        return x[..., at].reshape(*x.shape[:-1], *shape)

    def largest_of_group(self, x: Tensor) -> Tensor:
        """Return x, `(..., N)`, with the largest entry of its group in place of each."""
        groups = [self._group(x, at, shape) for _, at, shape in self._slices]
        return joined([flat(group.amax(-1, keepdim=True).expand_as(group)) for group in groups])


def flat(x: Tensor) -> Tensor:
    """Return `(..., groups size)`; not by `flatten`, for which the older `vmap` has no rule, nor for `unflatten`."""
    return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])


def joined(parts: list[Tensor]) -> Tensor:
    """Concatenate the last dimension, batch dimensions broadcast."""
    batch = broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*batch, -1) for part in parts], dim=-1)


def _finite(D: Tensor) -> Tensor:
    """Return matrices with the identity, a free block, for those that are not finite: LAPACK raises on them.

    An iteration that diverges makes such a block; its sample is refused by its residual.
    """
    eye = torch.eye(D.shape[-1], dtype=D.dtype, device=D.device)
    return torch.where(D.isfinite().all(-1, keepdim=True).all(-2, keepdim=True), D, eye)
