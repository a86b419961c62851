"""What `state_dict` of a layer holds besides its parameters: compact data, settings and sets, as one tensor of bytes.

A checkpoint then makes a layer that was built on another recording plan like the one that was saved. What cannot be
restored so (a batch of data sets, sets that are not registered) is told by a digest of the data, which must agree.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .data.hankel import HankelData
from .saving import compact_data, layer_from_tree, layer_to_tree
from .sets.registry import arguments_of

#: The name of the text among the arrays.
TEXT = "text"


def state_of(layer: Any) -> Tensor:
    """Return the extra state of a `DPCLayer`, `(bytes,)`, uint8."""
    try:
        text, tensors = layer_to_tree(layer)
    except ValueError as error:
        text, tensors = {"digest": _digest(layer.data), "why": str(error)}, {}
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{TEXT: np.frombuffer(json.dumps(text).encode(), dtype=np.uint8)}, **arrays)
    return torch.frombuffer(bytearray(file.getvalue()), dtype=torch.uint8)


def restore(layer: Any, state: Tensor) -> None:
    """Give a layer the data, settings and sets of an extra state; parameters are loaded by torch.

    Raises:
        ValueError: a state that is damaged, or does not fit the parameters that the layer has.
    """
    try:
        with np.load(io.BytesIO(state.cpu().numpy().tobytes()), allow_pickle=False) as file:
            text = json.loads(bytes(file[TEXT]))
            tensors = {name: torch.from_numpy(file[name]) for name in file.files if name != TEXT}
    except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"the extra state of the layer is damaged: {error}.") from error
    if "digest" in text:
        if text["digest"] != _digest(layer.data):
            raise ValueError(
                "the checkpoint is of a layer on other data, which it does not hold: "
                f"{text['why']} Build the layer on the same data first."
            )
        return
    saved = layer_from_tree(type(layer), text, tensors)
    for name, value in saved.config().items():
        mine = layer.config()[name]
        if _learns(mine) or _learns(value):
            if _skeleton(mine) != _skeleton(value):
                raise ValueError(
                    f"`{name}` of the checkpoint is {_short(value)}, that of the layer {_short(mine)}: where one of "
                    "them holds parameters, build the layer with the same."
                )
        elif _skeleton(mine) != _skeleton(value):
            setattr(layer, name, value)
    own = layer.data
    is_known = isinstance(own, HankelData) and (own.has_windows or own.has_ones == saved.affine)
    if not is_known or _digest(compact_data(layer)) != _digest(saved.data):
        layer.data = saved.data


def _learns(value: Any) -> bool:
    return isinstance(value, nn.Parameter) or isinstance(value, nn.Module) and any(True for _ in value.parameters())


def _skeleton(value: Any) -> Any:
    """Return what two settings must share to be alike, to compare by `==`: all but the values of parameters."""
    if isinstance(value, nn.Parameter):
        return "parameter", tuple(value.shape)
    if isinstance(value, Tensor):
        return "tensor", str(value.dtype), value.detach().cpu().tolist()
    if isinstance(value, nn.Module):
        return type(value).__name__, _skeleton(arguments_of(value))
    if isinstance(value, dict):
        return {name: _skeleton(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_skeleton(part) for part in value]
    return value


def _short(value: Any) -> str:
    return f"a tensor {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)


def _digest(data: Any) -> str:
    """Return the SHA-256 of the matrices of the data, one recording or several."""
    found = hashlib.sha256()
    for one in getattr(data, "members", [data]):
        for matrix in one.matrices:
            found.update(matrix.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()
