"""The call of a layer while torch compiles or exports a model: one operator, and plain operations around it.

The operator, `torch.ops.torch_dpc.plan`, is defined in :mod:`torch_dpc.operators`. While torch compiles it finds the
layer by its handle in this process. An exported program must run in another process: it holds the layer as a text and
the tensors that the text names.
"""

from __future__ import annotations

import itertools
import json
import weakref
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes

from .checks import reference, window
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .saving import compact_data, layer_to_tree
from .solution import DPCSolution
from .solve.info import SolveInfo, lost
from .solve.recovery import Thunks

#: The layers of this process; compiled models find them by their handles.
layers_by_handle: weakref.WeakValueDictionary[int, nn.Module] = weakref.WeakValueDictionary()
_handles = itertools.count()

WHY_NOT = "in a compiled or exported model it is not computed; call the layer outside of it"


def register(layer: nn.Module) -> int:
    """Return a new handle of a layer."""
    handle = next(_handles)
    layers_by_handle[handle] = layer
    return handle


def flat_parameters(
    data: HankelData | HankelBatch,
    u_ini: Any,
    y_ini: Any,
    y_ref: Any,
    u_ref: Any,
    batches: list[torch.Size],
    *,
    affine: bool,
) -> tuple[Tensor, torch.dtype]:
    """Return (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)`, and the dtype of the caller.

    Args:
        data: for the sizes.
        u_ini, y_ini, y_ref, u_ref: as for a call of the layer.
        batches: batch shapes that weights and data have.
        affine: put a 1 before them, for affine systems.
    """
    u_ini = window("u_ini", u_ini, data.t_ini, data.n_u, "n_u")
    y_ini = window("y_ini", y_ini, data.t_ini, data.n_y, "n_y")
    u_ref = reference("u_ref", u_ref, data.horizon, data.n_u, "n_u", u_ini)
    y_ref = reference("y_ref", y_ref, data.horizon, data.n_y, "n_y", y_ini)
    parts = [part.flatten(-2) for part in (u_ini, y_ini, u_ref, y_ref)]
    batch = torch.broadcast_shapes(*[part.shape[:-1] for part in parts], *batches)
    theta = torch.cat([part.expand(*batch, part.shape[-1]).double() for part in parts], dim=-1)
    if affine:
        theta = torch.cat([torch.ones_like(theta[..., :1]), theta], dim=-1)
    return theta, torch.promote_types(u_ini.dtype, y_ini.dtype)


def planned_by_operator(
    theta: Tensor,
    tensors: list[Tensor],
    handle: int,
    text: str,
    on_failure: str,
    sizes: list[int],
    dtype: torch.dtype,
) -> DPCSolution:
    """Return the plan of one call of the operator; the arguments are those of `torch_dpc.operators.plan`."""
    u, y, lam, _, info, _, _ = torch.ops.torch_dpc.plan(theta, tensors, handle, text, on_failure, sizes)
    return DPCSolution(u.to(dtype), y.to(dtype), SolveInfo(info, None, lost), lam, Thunks({}, WHY_NOT))


def batches_of(data: HankelData | HankelBatch, weights: tuple[Any, ...]) -> list[torch.Size]:
    """Return the batch shapes of the data and of the weights, in the order of `GivenWeights`."""
    tails = (2, 2, 0, 0, 0, 2, 2, 0)
    found = [
        w.shape[: w.ndim - tail]
        for w, tail in zip(weights, tails, strict=True)
        if isinstance(w, Tensor) and w.ndim > tail
    ]
    return [*found, torch.Size([len(data.members)])] if isinstance(data, HankelBatch) else found


def described(layer: Any) -> tuple[str, list[Tensor]]:
    """Return a layer as a text, and the tensors that it names.

    Raises:
        ValueError: the layer cannot be saved.
    """
    with _disable_current_modes():  # the recorded data are constants: nothing of their factorisation is traced
        data = compact_data(layer) if isinstance(layer.data, HankelData) else layer.data
    tree, tensors = layer_to_tree(layer, compact=data, live=True)
    return json.dumps({**tree, "order": list(tensors)}), list(tensors.values())
