"""Is a derivative asked for, and is a function transform at work?"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils._pytree import register_pytree_node

# Not public, but stable since torch 2.0; without them every tensor is taken to be wrapped, which is slower and right.
_functorch = getattr(torch._C, "_functorch", None)
_is_wrapped = getattr(_functorch, "is_functorch_wrapped_tensor", lambda tensor: True)
_is_legacy_batched = getattr(_functorch, "is_legacy_batchedtensor", lambda tensor: False)
are_transforms_active = getattr(torch._C, "_are_functorch_transforms_active", lambda: True)


def is_plain(tensor: Tensor) -> bool:
    """Return whether a tensor holds its own numbers: no `vmap` or `torch.func` transform has wrapped it."""
    return type(tensor) is Tensor and not _is_wrapped(tensor) and not _is_legacy_batched(tensor)


def is_mapped(value: Any) -> bool:
    """Return whether `vmap` maps a tensor, perhaps below other transforms: no decision can follow from its numbers."""
    while isinstance(value, Tensor) and _is_wrapped(value) and _functorch is not None:
        if _functorch.is_batchedtensor(value):
            return True
        value = _functorch.get_unwrapped(value)
    return isinstance(value, Tensor) and _is_legacy_batched(value)


def refuse_forward_twice() -> None:
    """Raise NotImplementedError within a forward derivative of a forward derivative.

    Within the `jvp` of a Function torch keeps no other tangent: what the `jvp` itself depends on is lost without a
    word. Where it depends on nothing, as at boxes with constant weights, this does not matter.
    """
    if _functorch is None:
        return
    stack = _functorch.get_interpreter_stack() or []
    if sum(level.key() == _functorch.TransformType.Jvp for level in stack) > 1:
        raise NotImplementedError(
            "forward derivatives of forward derivatives (jacfwd of jacfwd, jvp of jvp) are there for boxes with "
            "constant weights: take one of the two backward, as `hessian` does."
        )


def apply_function(function: type[torch.autograd.Function], *args: Any) -> Any:
    """Return `function.apply(*args)`.

    `Function.apply` binds the arguments by name and looks for wrappers left by ended transforms, which takes longer
    than the rest of a small Function. If no transform is active and no argument is wrapped, this calls its base.
    """
    if are_transforms_active() or not all(is_plain(arg) for arg in args if isinstance(arg, Tensor)):
        return function.apply(*args)
    return super(torch.autograd.Function, function).apply(*args)  # type: ignore[misc]


def is_grads_batched(tensor: Tensor) -> bool:
    """Return whether a cotangent is one of many at once, from `torch.autograd.grad(..., is_grads_batched=True)`.

    That is the older `vmap`, which ignores the `vmap` rule of a Function: its tensors support built-in operations only.
    """
    return _is_legacy_batched(tensor)


def untransformed() -> contextlib.AbstractContextManager[Any]:
    """Return a context without transforms, for results that outlive the call; every tensor in it must be plain.

    Within a transform even a new tensor is wrapped, and its wrapper is invalid once the transform has ended.
    """
    return getattr(torch._C, "_DisableFuncTorch", contextlib.nullcontext)()


def constant(tensor: Tensor) -> Tensor:
    """Return a tensor's numbers, without its graph, its tangent, and the wrappers of `torch.func.grad` and `jvp`."""
    if _functorch is None or not are_transforms_active():
        return tensor.detach()
    with untransformed():
        while _functorch.is_gradtrackingtensor(tensor):
            tensor = _functorch.get_unwrapped(tensor)
        return tensor.detach()


def carries_derivative(values: tuple[Any, ...]) -> bool:
    """Return whether a derivative, backward or forward, may be asked of one of the tensors among values.

    What a transform has wrapped counts: a derivative that an outer one asks for is not seen from within an inner one.
    """
    tensors = [value for value in values if isinstance(value, Tensor)]
    if are_transforms_active() and not all(map(is_plain, tensors)):
        return True
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return True
    if getattr(forward_ad, "_current_level", 0) < 0:  # no forward derivative is under way: spare the look at each
        return False
    return any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)


def only_backward() -> bool:
    """Return whether neither a function transform nor a forward derivative is under way."""
    return not are_transforms_active() and getattr(forward_ad, "_current_level", 0) < 0


def register_fields(cls: type[Any]) -> None:
    """Make a dataclass of tensors, or of None, a pytree: what `vmap` and transforms may return."""
    names = [field.name for field in dataclasses.fields(cls)]

    def flatten(record: Any) -> tuple[list[Any], None]:
        return [getattr(record, name) for name in names], None

    def unflatten(children: Iterable[Any], _: None) -> Any:
        return cls(*children)

    register_pytree_node(cls, flatten, unflatten, serialized_type_name=f"torch_dpc.{cls.__name__}")
