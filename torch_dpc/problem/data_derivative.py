"""The derivative with respect to the recorded data: backward, and once."""

from __future__ import annotations

from typing import Any, NoReturn

import torch
from torch import Tensor


def in_row_space(D: Tensor, basis: Tensor) -> Tensor:
    """Return D B for an orthonormal basis B `(q, r)` of the rows of D, with its derivative in D."""
    product: Tensor = _InRowSpace.apply(D, basis)
    return product


class _InRowSpace(torch.autograd.Function):
    """(D, B) -> D B for an orthonormal basis B of the rows of D, which moves with D.

    What follows depends on D through D D' alone, so that to first order, and only so, B may be taken as fixed:
    D_bar = bar B'. A derivative of that is refused.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(D: Tensor, basis: Tensor) -> Tensor:
        return D @ basis

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:
        (basis,) = ctx.saved_tensors
        return _DataCotangent.apply(bar, basis) if torch.is_grad_enabled() else bar @ basis.mT, None

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Tensor:
        raise NotImplementedError(
            "derivatives with respect to the recorded data go backward: take them by `.backward()`, "
            "`torch.autograd.grad`, `torch.func.grad` or `jacrev`, not by `jvp`, `jacfwd` or `hessian`."
        )


class _DataCotangent(torch.autograd.Function):
    """(bar, B) -> bar B', once: `torch.func` asks for every derivative as one to be derived, and most are not."""

    generate_vmap_rule = True

    @staticmethod
    def forward(bar: Tensor, basis: Tensor) -> Tensor:
        return bar @ basis.mT

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[Tensor, None]:
        _DataCotangent._refuse()

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Tensor:
        _DataCotangent._refuse()

    @staticmethod
    def _refuse() -> NoReturn:
        raise NotImplementedError(
            "the derivative with respect to the recorded data is of first order, and cannot be derived again: detach "
            "it or the data."
        )
