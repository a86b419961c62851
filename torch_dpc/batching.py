"""Shapes: one matrix or one matrix a sample, with a batch of vectors; random numbers for a batch."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .shapes import broadcast_shapes


def times(matrix: Tensor, x: Tensor) -> Tensor:
    """Return matrix x for vectors `(*batch, n)`; the matrix is `(m, n)`, shared, or `(*batch, m, n)`."""
    if matrix.ndim == 2:
        # Not x @ matrix.mT, which makes the vector a matrix, where the older `vmap` loses a forward derivative.
        return matrix.mv(x) if x.ndim == 1 else x @ matrix.mT
    return (matrix @ x[..., None])[..., 0]


def unit_vectors(like: Tensor) -> Tensor:
    """Return the unit vectors `(n, *1, n)`, a leading dimension of vectors `(*batch, n)` that broadcast to `like`."""
    n = like.shape[-1]
    return torch.eye(n, dtype=like.dtype, device=like.device).reshape(n, *(1,) * (like.ndim - 1), n)


def outer(y: Tensor, x: Tensor, like: Tensor) -> Tensor:
    """Return the cotangent y x' of a matrix with the shape of `like`: summed over the samples that shared it."""
    if like.ndim == 2:
        return y.reshape(-1, y.shape[-1]).mT @ x.reshape(-1, x.shape[-1])
    return (y[..., :, None] * x[..., None, :]).sum_to_size(like.shape)


def standard_normal(
    like: Tensor, generator: torch.Generator | Sequence[torch.Generator] | None, *, tail: int
) -> Tensor:
    """Return standard normal numbers with the shape, dtype and device of a tensor, drawn where the generator is.

    Args:
        like: `(*batch, *own)`.
        generator: one for all, or one a sample of the last batch dimension, which then draws what it would draw for its
            sample alone.
        tail: the number of dimensions in `own`.

    Raises:
        ValueError: another number of generators than samples.
    """
    if isinstance(generator, Sequence):
        place = like.ndim - tail - 1
        if place < 0 or len(generator) != like.shape[place]:
            came = "no batch" if place < 0 else f"a batch of {like.shape[place]}"
            raise ValueError(f"`generator` must hold one generator a sample, got {len(generator)} for {came}.")
        parts = zip(like.unbind(place), generator, strict=True)
        return torch.stack([standard_normal(part, one, tail=tail) for part, one in parts], dim=place)
    device = like.device if generator is None else generator.device
    return torch.randn(like.shape, dtype=like.dtype, device=device, generator=generator).to(like.device)


def flatten_batch(
    matrices: tuple[Tensor, ...], vectors: tuple[Tensor | None, ...]
) -> tuple[torch.Size, list[Tensor], list[Any]]:
    """Broadcast the batch dimensions of all and flatten them to one.

    Returns:
        The batch shape; the matrices, `(m, n)` where they were shared and `(B, m, n)` otherwise; the vectors, `(B, n)`,
        None where they were None.
    """
    if all(x is None or x.ndim == 1 for x in vectors) and all(m.ndim == 2 for m in matrices):  # one sample, unbatched
        return torch.Size(()), list(matrices), [x if x is None else x[None] for x in vectors]
    shapes = [x.shape[:-2] for x in matrices] + [x.shape[:-1] for x in vectors if x is not None]
    batch = broadcast_shapes(*set(shapes))
    flat_matrices = [m if m.ndim == 2 else m.expand(*batch, -1, -1).reshape(-1, *m.shape[-2:]) for m in matrices]
    flat_vectors = [x if x is None else x.expand(*batch, -1).reshape(-1, x.shape[-1]) for x in vectors]
    return batch, flat_matrices, flat_vectors


def lead_all(
    tensors: tuple[Tensor | None, ...], dims: tuple[int | None, ...], tails: tuple[int, ...], size: int
) -> list[Tensor | None]:
    """Bring the dimension that `vmap` maps of each tensor to the front, so that all broadcast as one batch.

    Args:
        tensors: the first carries the batch, and is expanded where it is not mapped itself.
        dims: the mapped dimension of each, or None.
        tails: how many dimensions at the end are a tensor's own.
        size: of the mapped dimension.
    """
    pairs = list(zip(tensors, dims, tails, strict=True))
    depth = max(x.ndim - (dim is not None) - tail for x, dim, tail in pairs if x is not None)
    out: list[Tensor | None] = []
    for place, (x, dim, tail) in enumerate(pairs):
        if x is not None and dim is not None:
            x = x.movedim(dim, 0)
            x = x.reshape(x.shape[0], *(1,) * (depth + 1 + tail - x.ndim), *x.shape[1:])
        elif x is not None and place == 0:
            x = x.expand(size, *(1,) * (depth + tail - x.ndim), *x.shape)
        out.append(x)
    return out
