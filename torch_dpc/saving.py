"""Layers on disk: safetensors files, which hold tensors and text and run no code when they are read.

The header holds one JSON text: the format's version, the sizes of the data, and the arguments of `DPCLayer` as a tree
of numbers, strings, lists and sets, in which each tensor stands by its name in the file, and a checksum of the text and
of every tensor (files of earlier versions have none). By default the data are written compact
(:meth:`torch_dpc.HankelData.compressed`), so that a file is small whatever the number of windows.

A set is written as the arguments of its constructor; see :mod:`torch_dpc.sets.registry`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from .checks import as_data, check_flag, check_type
from .data.hankel import HankelData
from .data.row_space import RowSpace, row_units
from .files import write_whole
from .sets import ConvexSet
from .sets.registry import arguments_of, known_sets, register_set

__all__ = ["load_layer", "register_set", "save_layer"]

#: The version of the format. A file of another is refused.
VERSION = 1
#: The key of the text in the header.
HEADER = "torch_dpc"
#: What the text holds; the checksum is of all the rest.
CHECKSUM = "sha256"
ENTRIES = {"version", "data", "arguments", CHECKSUM}


def save_layer(layer: nn.Module, path: str | os.PathLike[str], *, data: bool = False) -> None:
    """Write a layer; see :meth:`torch_dpc.DPCLayer.save`."""
    torch_files = _safetensors()
    check_flag("data", data)
    check_type("path", path, (str, os.PathLike))
    text, tensors = layer_to_tree(layer, data=data)
    text[CHECKSUM] = _checksum(text, tensors)
    write_whole(path, torch_files.save(tensors, metadata={HEADER: json.dumps(text, allow_nan=False)}))


def load_layer(cls: type[Any], path: str | os.PathLike[str]) -> Any:
    """Read a layer of class `cls`; see :meth:`torch_dpc.DPCLayer.load`."""
    check_type("path", path, (str, os.PathLike))
    text, tensors = _read(path)
    if text.get("version") != VERSION:
        raise ValueError(
            f"{os.fspath(path)!r} has version {text.get('version')!r} of the format, this torch_dpc reads version "
            f"{VERSION}: read it with the torch_dpc that wrote it."
        )
    found = text.pop(CHECKSUM, None)
    if text.keys() - ENTRIES or (found is not None and found != _checksum(text, tensors)):
        raise ValueError(f"{os.fspath(path)!r} is damaged: its content does not agree with its checksum.")
    try:
        return layer_from_tree(cls, text, tensors)
    except (KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)!r} is not a whole torch_dpc file: {error!r}.") from error


def layer_to_tree(
    layer: Any, *, data: bool = False, compact: HankelData | None = None, live: bool = False
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return a layer as a tree of JSON and the tensors that it names.

    Args:
        layer: a `DPCLayer`.
        data: with the recorded windows; otherwise the data are compact.
        compact: the compact data, if they are known already.
        live: with the layer's own tensors in place of copies of their values.

    Raises:
        ValueError: a set that is not known, a batch of data sets, or settings that do not go together.
    """
    writer = _Writer(live=live)
    layer.feasible_set  # noqa: B018  # settings that do not go together could not be loaded
    held = layer.data
    if not isinstance(held, HankelData):
        raise ValueError("a layer on a batch of data sets cannot be saved: save one layer for each.")
    if data:
        held.require_windows()
    kept = held if data else compact_data(layer) if compact is None else compact
    text = {
        "version": VERSION,
        "data": _data_to_tree(kept, writer),
        "arguments": {name: writer.tree(value, f"`{name}`", name) for name, value in arguments_of(layer).items()},
    }
    return text, writer.tensors


def compact_data(layer: Any) -> HankelData:
    """Return the data of a layer compact; for affine systems with the row of ones, which its factor must know."""
    compact: HankelData = (layer.data.with_ones if layer.affine else layer.data).compressed()
    return compact


def layer_from_tree(cls: type[Any], text: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Any:
    """Return the layer of class `cls` that :func:`layer_to_tree` describes."""
    reader = _Reader(dict(tensors))
    data = _data_from_tree(text["data"], reader)
    return cls(data, **{name: reader.value(tree) for name, tree in text["arguments"].items()})


# --- data -------------------------------------------------------------------------------------------------------------

_DATA_NUMBERS = ("t_ini", "horizon", "n_u", "n_y", "windows_seen")
_SPACE_NUMBERS = ("rank", "rank_W", "n_rows", "last_kept", "first_dropped")
_MATRICES = ("Up", "Uf", "Yp", "Yf")


def _data_to_tree(data: HankelData, writer: _Writer) -> dict[str, Any]:
    tree: dict[str, Any] = {name: getattr(data, name) for name in _DATA_NUMBERS}
    tree["n_ridge"] = data.n_ridge
    tree["recorded_as"] = None if data.recorded_as is None else str(data.recorded_as).removeprefix("torch.")
    for name in _MATRICES:
        matrix = getattr(data, name)
        writer.tensors[f"data.{name}"] = matrix if writer.live else _plain(matrix)
    if not data.has_windows:  # compact data know their rank, as it was decided on the windows
        tree["row_space"] = {name: getattr(data.row_space, name) for name in _SPACE_NUMBERS}
    return tree


def _data_from_tree(tree: Mapping[str, Any], reader: _Reader) -> HankelData:
    numbers = {name: tree[name] for name in _DATA_NUMBERS}
    numbers["n_ridge"] = tree.get("n_ridge", 0)  # files of earlier versions have none
    matrices = {name: as_data(f"data.{name}", reader.tensors[f"data.{name}"]) for name in _MATRICES}
    columns = matrices["Up"].shape[-1]
    for name, matrix in matrices.items():
        rows = numbers["t_ini" if name[1] == "p" else "horizon"] * numbers["n_u" if name[0] == "U" else "n_y"]
        rows += name == "Up" and len(matrix) == rows + 1  # of ones, for affine systems
        if matrix.shape != (rows, columns):
            raise ValueError(f"the file is damaged: {name} has shape {tuple(matrix.shape)}, not {(rows, columns)}.")
    recorded_as = None if tree["recorded_as"] is None else getattr(torch, tree["recorded_as"])
    if not isinstance(recorded_as, (torch.dtype, type(None))):
        raise ValueError(f"the file is damaged: {tree['recorded_as']!r} is no precision.")
    data = HankelData(
        matrices["Up"], matrices["Uf"], matrices["Yp"], matrices["Yf"], **numbers, recorded_as=recorded_as
    )
    if "row_space" in tree:
        space = {name: tree["row_space"][name] for name in _SPACE_NUMBERS}
        if space["rank"] != columns:
            raise ValueError(f"the file is damaged: its data have {columns} columns for a rank of {space['rank']}.")
        units = row_units(data.matrices, data.n_u, data.n_y, data.n_windows)
        data.__dict__["row_space"] = RowSpace(basis=torch.eye(columns, dtype=torch.float64), units=units, **space)
    return data


# --- values -----------------------------------------------------------------------------------------------------------


class _Writer:
    """Values to a tree of JSON, and the tensors it names."""

    def __init__(self, *, live: bool = False) -> None:
        self.tensors: dict[str, Tensor] = {}
        self.live = live
        self._seen: dict[int, tuple[Any, dict[str, Any]]] = {}  # a parameter used twice stays one

    def tree(self, value: Any, what: str, key: str) -> Any:
        """Return the tree of a value; `what` names it in messages, `key` in the file."""
        if value is None or isinstance(value, (bool, int, str)):
            return value
        if isinstance(value, np.generic):
            return self.tree(value.item(), what, key)
        if isinstance(value, float):
            return value if math.isfinite(value) else {"number": repr(value)}
        if isinstance(value, np.ndarray):
            return self._tensor(torch.as_tensor(value), key)
        if isinstance(value, Tensor):
            return self._tensor(value, key)
        if isinstance(value, (list, tuple)):
            return [self.tree(item, f"{what}[{i}]", f"{key}.{i}") for i, item in enumerate(value)]
        if isinstance(value, ConvexSet):
            # A parametrised set is of a class that was made for it alone; its attributes are their present values.
            cls = parametrize.type_before_parametrizations(value)
            name = cls.__name__
            if known_sets().get(name) is not cls:
                raise ValueError(
                    f"{what} is a {name}, which saved layers do not know: call torch_dpc.register_set({name}) first, "
                    f"here and where the layer is loaded."
                )
            parts = arguments_of(value)
            return {"set": name, "arguments": {k: self.tree(v, f"{what}.{k}", f"{key}.{k}") for k, v in parts.items()}}
        raise ValueError(
            f"{what} is a {type(value).__name__}; what can be saved is numbers, strings, tensors, lists and sets."
        )

    def _tensor(self, tensor: Tensor, key: str) -> dict[str, Any]:
        if id(tensor) not in self._seen:
            self.tensors[key] = tensor if self.live else _plain(tensor)
            learns = tensor.is_leaf and tensor.requires_grad  # what a graph made is kept as its value
            tree = {"tensor": key, "parameter": isinstance(tensor, nn.Parameter), "requires_grad": learns}
            self._seen[id(tensor)] = (tensor, tree)
        return self._seen[id(tensor)][1]


class _Reader:
    """A tree of JSON back to values."""

    def __init__(self, tensors: dict[str, Tensor]):
        self.tensors = tensors
        self._made: dict[str, Tensor] = {}

    def value(self, tree: Any) -> Any:
        """Return the value of a tree."""
        if isinstance(tree, list):
            return [self.value(item) for item in tree]
        if not isinstance(tree, dict):
            return tree
        if "number" in tree:
            return float(tree["number"])
        if "tensor" in tree:
            return self._tensor(tree)
        name = tree["set"]
        cls = known_sets().get(name)
        if cls is None:
            raise ValueError(
                f"the file holds a set {name!r} that is not known: call torch_dpc.register_set on its class first."
            )
        return cls(**{key: self.value(part) for key, part in tree["arguments"].items()})

    def _tensor(self, tree: Mapping[str, Any]) -> Tensor:
        key = tree["tensor"]
        if key not in self._made:
            tensor = self.tensors[key]
            learns = bool(tree["requires_grad"])
            self._made[key] = (
                nn.Parameter(tensor, requires_grad=learns) if tree["parameter"] else tensor.requires_grad_(learns)
            )
        return self._made[key]


# --- files ------------------------------------------------------------------------------------------------------------


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    _safetensors()
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            header = (file.metadata() or {}).get(HEADER)
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{os.fspath(path)!r} is not a whole safetensors file: {error}") from error
    try:
        text = json.loads("null" if header is None else header)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)!r} has a damaged header: {error}.") from error
    if not isinstance(text, dict):
        raise ValueError(f"{os.fspath(path)!r} is a safetensors file, but not one that `DPCLayer.save` wrote.")
    return text, tensors


def _checksum(text: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the text and of every tensor with its name, precision and shape."""
    digest = hashlib.sha256(json.dumps(text).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _safetensors() -> Any:
    try:
        import safetensors.torch
    except ImportError as error:
        raise ImportError(
            "saving and loading a layer needs safetensors: pip install 'torch_dpc[save]', or safetensors alone."
        ) from error
    return safetensors.torch


def _plain(tensor: Tensor) -> Tensor:
    """Return the values alone, in memory of their own."""
    return tensor.detach().to(device="cpu", copy=True).contiguous()
