"""Products of one matrix, or one matrix a sample, with a batch of vectors."""

from torch import Tensor


def times(matrix: Tensor, x: Tensor) -> Tensor:
    """Return matrix x for vectors `(*batch, n)`; the matrix is `(m, n)`, shared, or `(*batch, m, n)`."""
    if matrix.ndim == 2:
        return x @ matrix.mT
    return (matrix @ x[..., None])[..., 0]


def outer(y: Tensor, x: Tensor, like: Tensor) -> Tensor:
    """Return the cotangent y x' of a matrix with the shape of `like`: summed over the samples that shared it."""
    if like.ndim == 2:
        return y.reshape(-1, y.shape[-1]).mT @ x.reshape(-1, x.shape[-1])
    return (y[..., :, None] * x[..., None, :]).sum_to_size(like.shape)


def per_sample(x: Tensor, tail: int, batch: tuple[int, ...]) -> Tensor:
    """Return a tensor with `tail` dimensions of its own for a flattened batch: shared as it is, or `(B, ...)`."""
    return x if x.ndim == tail else x.expand(*batch, *x.shape[-tail:]).reshape(-1, *x.shape[-tail:])
