"""The plan of a layer as operators of torch, for `torch.compile` and `torch.export`.

    torch_dpc::plan      theta, tensors of the layer -> u, y, lam, active, info, du, weak
    torch_dpc::adjoint   the cotangents of theta and of those tensors

Both run the layer as it runs otherwise, so that numbers are the same. The adjoint solves again: no state passes between
the two. The derivative is of first order; torch refuses a second one.
"""

from __future__ import annotations

import contextlib
import json
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from .layer import DPCLayer
from .saving import layer_from_tree
from .sets.feasible import places_of, snapshot_of
from .solve.derivative import plan as plan_of
from .solve.outcome import Planned
from .tracing import layers_by_handle

#: Layers of exported programs that are kept, by their text.
MOST_LAYERS = 16
_exported: OrderedDict[str, tuple[list[Tensor], DPCLayer]] = OrderedDict()


@torch.library.custom_op("torch_dpc::plan", mutates_args=())
def plan(
    theta: Tensor, tensors: list[Tensor], handle: int, text: str, on_failure: str, sizes: list[int]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Solve for every theta.

    Args:
        theta: (u_ini, y_ini, u_ref, y_ref), `(*batch, n_theta)`, float64.
        tensors: of the layer, in the order of `DPCLayer.own_tensors`, or of the text.
        handle: of a layer of this process.
        text: of a layer that was exported; empty for one of this process.
        on_failure: "raise" or "nan".
        sizes: horizon, n_u, n_y, and the entries of du.

    Returns:
        The fields of :class:`torch_dpc.solve.outcome.Planned`.
    """
    with torch.no_grad():
        layer = _layer_of(tensors, handle, text)
        planned = _planned(layer, theta.detach(), on_failure)
    du = planned.lam[..., planned.lam.shape[-1] - sizes[3] :] if planned.du is None else planned.du
    weak = ~planned.active if planned.weak is None else planned.weak
    if planned.u.shape[:-2] != theta.shape[:-1]:
        raise RuntimeError(
            "in a compiled or exported model the parameters of sets may have no batch dimension beyond that of the "
            f"samples, {tuple(theta.shape[:-1])}; the plan has {tuple(planned.u.shape[:-2])}."
        )
    # Outputs of an operator must not share memory.
    u, y, lam, active, info = (x.clone(memory_format=torch.contiguous_format) for x in planned[:5])
    return u, y, lam, active, info, du.clone(), weak.clone()


@plan.register_fake
def _(
    theta: Tensor, tensors: list[Tensor], handle: int, text: str, on_failure: str, sizes: list[int]
) -> tuple[Tensor, ...]:
    horizon, n_u, n_y, n_du = sizes
    batch, n = theta.shape[:-1], horizon * (n_u + n_y) + n_du
    flags = [theta.new_empty(*batch, n, dtype=torch.bool) for _ in range(2)]
    u, y = (theta.new_empty(*batch, horizon, channels) for channels in (n_u, n_y))
    return (
        u,
        y,
        theta.new_empty(*batch, n),
        flags[0],
        theta.new_empty(*batch, 5),
        theta.new_empty(*batch, n_du),
        flags[1],
    )


@torch.library.custom_op("torch_dpc::adjoint", mutates_args=())
def adjoint(
    theta: Tensor,
    tensors: list[Tensor],
    u_bar: Tensor,
    y_bar: Tensor,
    lam_bar: Tensor,
    handle: int,
    text: str,
    on_failure: str,
    learns: list[bool],
) -> list[Tensor]:
    """Return the cotangents of theta and of the tensors that learn, in their order; zeros for the others.

    Args:
        theta, tensors, handle, text, on_failure: as for :func:`plan`.
        u_bar, y_bar, lam_bar: cotangents of u, y and lam.
        learns: which of the tensors need a cotangent.
    """
    with _recording():
        leaf = theta.detach().requires_grad_()
        leaves = [x.detach().requires_grad_() if own else x for x, own in zip(tensors, learns, strict=True)]
        layer = _layer_of(tensors, handle, text, leaves if any(learns) else None)
        planned = _planned(layer, leaf, on_failure)
        wanted = [leaf, *(x for x, own in zip(leaves, learns, strict=True) if own)]
        bars = torch.autograd.grad(planned[:3], wanted, (u_bar, y_bar, lam_bar), allow_unused=True)
    theta_bar, *others = (torch.zeros_like(x) if bar is None else bar for x, bar in zip(wanted, bars, strict=True))
    found = iter(others)
    return [theta_bar, *(next(found) if own else torch.zeros_like(x) for x, own in zip(tensors, learns, strict=True))]


@adjoint.register_fake
def _(
    theta: Tensor,
    tensors: list[Tensor],
    u_bar: Tensor,
    y_bar: Tensor,
    lam_bar: Tensor,
    handle: int,
    text: str,
    on_failure: str,
    learns: list[bool],
) -> list[Tensor]:
    return [torch.empty_like(x) for x in (theta, *tensors)]


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    theta, tensors, *ctx.constants = inputs
    ctx.like = [(x.shape, x.dtype, x.device) for x in output[:3]]
    ctx.mark_non_differentiable(*output[3:])
    ctx.save_for_backward(theta, *tensors)


def _backward(ctx: Any, u_bar: Tensor, y_bar: Tensor, lam_bar: Tensor, *_: Any) -> tuple[Any, ...]:
    theta, *tensors = ctx.saved_tensors
    handle, text, on_failure, _sizes = ctx.constants
    learns = list(ctx.needs_input_grad[1])
    arguments = (u_bar.contiguous(), y_bar.contiguous(), lam_bar.contiguous(), handle, text, on_failure, learns)
    theta_bar, *bars = adjoint(theta, tensors, *arguments)
    return theta_bar, [bar if own else None for bar, own in zip(bars, learns, strict=True)], None, None, None, None


plan.register_autograd(_backward, setup_context=_setup_context)


def _planned(layer: DPCLayer, theta: Tensor, on_failure: str) -> Planned:
    factored, sets = layer.factored(theta.device), layer.present_sets(theta.device)
    return plan_of(factored.solver, theta, factored.reduction, sets, on_failure)


def _layer_of(tensors: list[Tensor], handle: int, text: str, leaves: list[Tensor] | None = None) -> DPCLayer:
    """Return the layer with these tensors; with the leaves in their places if they are given."""
    if text:
        layer, own = _exported_layer(text, tensors)
    else:
        found = layers_by_handle.get(handle)
        if found is None:
            raise RuntimeError("the layer that was compiled does not exist any more in this process.")
        assert isinstance(found, DPCLayer)
        layer, own = found, found.own_tensors()
        if len(own) != len(tensors):
            raise RuntimeError("a weight of the layer became a tensor, or a number, after the model was compiled.")
    if leaves is None:
        if all(a is b or torch.equal(a, b) for a, b in zip(own, tensors, strict=True)):
            return layer
        leaves = tensors
    return _with_tensors(layer, {id(old): new for old, new in zip(own, leaves, strict=True)})


def _with_tensors(layer: DPCLayer, by_id: dict[int, Tensor]) -> DPCLayer:
    """Return a copy of a layer with other tensors in the places of its own; what it remembers is shared."""
    copy = snapshot_of(layer)
    for holder, name in places_of(copy):
        if id(holder[name]) in by_id:
            holder[name] = by_id[id(holder[name])]
    assert isinstance(copy, DPCLayer)
    return copy


def _exported_layer(text: str, tensors: list[Tensor]) -> tuple[DPCLayer, list[Tensor]]:
    """Return the layer of an exported program, and its tensors in the order of the program's."""
    kept = _exported.get(text)
    tree = json.loads(text)
    data = [i for i, name in enumerate(tree["order"]) if name.startswith("data.")]
    if kept is None or not all(torch.equal(kept[0][i], tensors[i]) for i in data):
        values = [x.detach().clone() for x in tensors]
        layer = layer_from_tree(DPCLayer, tree, dict(zip(tree["order"], values, strict=True)))
        kept = _exported[text] = (values, layer)
        while len(_exported) > MOST_LAYERS:
            _exported.popitem(last=False)
    by_storage = {holder[name].data_ptr(): holder[name] for holder, name in places_of(kept[1])}
    return kept[1], [by_storage.get(x.data_ptr(), x) if x.numel() else x for x in kept[0]]


@contextlib.contextmanager
def _recording() -> Iterator[None]:
    """Let autograd record within an operator, below which torch switches it off."""
    include = torch._C._dispatch_tls_local_include_set()
    nothing = torch._C.DispatchKeySet(torch._C.DispatchKey.Undefined)
    with torch.enable_grad(), torch._C._ForceDispatchKeyGuard(include, nothing):
        yield
