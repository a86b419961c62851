"""Argument validation: each error gives the name, the rule and what came."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .autodiff import is_mapped
from .shapes import broadcast_shapes

#: What to write in place of an object that is easily taken for another, by argument and class (or one of its bases).
CURES = {
    ("budget", "ConvexSet"): "a set bounds plans; attacks.BoxBudget or attacks.BallBudget bounds perturbations",
    ("budget", "float"): "attacks.RelativeBallBudget(0.1) is 10 % of the measured window, for instance",
    ("controller", "DPCLayer"): "give DPCController(layer)",
    ("layer", "DPCController"): "give controller.layer",
    ("attack", "Budget"): "give an attack within it, for instance attacks.RandomAttack(budget)",
    ("set", "Budget"): "a budget bounds perturbations; Box or Ball bounds plans",
    ("set", "tuple"): "give Box(lower, upper)",
}


def cure(name: str, value: Any) -> str:
    """Return what to write in place of a value, `: ...`; nothing if there is nothing to say."""
    kinds = (CURES.get((name, kind.__name__)) for kind in type(value).__mro__)
    return next((f": {text}" for text in kinds if text), "")


def as_data(name: str, value: Any, *, finite: bool = True, integers: bool = False) -> Tensor:
    """Return floating data as a tensor; a tensor passes as it is, with its graph.

    Args:
        name: what the caller calls it; the error says so.
        value: a floating tensor, a NumPy float array, or a nested list of floats.
        finite: refuse NaN and infinity.
        integers: admit Python integers, alone or in lists: references and targets that are typed by hand.

    Raises:
        ValueError: integer, boolean or complex values, ragged lists, or values that are not finite.
    """
    if isinstance(value, Tensor):
        tensor = value
    else:
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise ValueError(f"`{name}` must be a rectangular array of floats: {error}") from error
        if integers and array.dtype.kind in "iu" and not isinstance(value, (np.ndarray, np.generic)):
            array = array.astype(np.float64)
        if not np.issubdtype(array.dtype, np.floating):
            hint = " Write 1.0 for 1, or x.astype(float)." if array.dtype.kind in "iu" else ""
            raise ValueError(f"`{name}` must hold floating-point numbers, got {array.dtype}.{hint}")
        tensor = torch.as_tensor(array)
    if not tensor.is_floating_point():
        hint = "" if tensor.is_complex() or tensor.dtype is torch.bool else f" Give {name}.double()."
        raise ValueError(f"`{name}` must hold floating-point numbers, got {tensor.dtype}.{hint}")
    if finite and not is_finite(tensor):
        bad = int((~torch.isfinite(tensor.detach())).sum())
        raise ValueError(f"`{name}` must be finite, got {bad} NaN or infinite of {tensor.numel()} values.")
    return tensor


def is_finite(tensor: Tensor) -> bool:
    """Return whether every value is finite."""
    # A sum takes a tenth of the time; where it is finite, so is every value.
    return math.isfinite(float(tensor.detach().sum())) or bool(torch.isfinite(tensor.detach()).all())


def as_index(rule: str, value: Any) -> int:
    """Return an integer, NumPy's and torch's included; anything else, booleans too, breaks `rule`, as the error says.

    Raises:
        ValueError: no integer.
    """
    is_bool = isinstance(value, (bool, np.bool_)) or getattr(value, "dtype", None) is torch.bool
    try:
        if not is_bool:
            return operator.index(value)
    except TypeError:
        pass
    raise ValueError(f"{rule}, got {value!r}.")


def check_count(name: str, value: Any) -> int:
    """Return a positive integer, NumPy's and torch's included.

    Raises:
        ValueError: anything else.
    """
    rule = f"`{name}` must be a positive integer"
    count = as_index(rule, value)
    if count < 1:
        raise ValueError(f"{rule}, got {value!r}.")
    return count


def check_number(
    name: str, value: Any, *, positive: bool = False, finite: bool = True, kind: str | None = None
) -> float:
    """Return a number that is not negative, NumPy's and torch's included.

    Args:
        name: what the caller calls it; the error says so.
        value: the number.
        positive: zero is not admitted.
        finite: infinity is not admitted.
        kind: what it must be, in words of the caller's.

    Raises:
        ValueError: anything else.
    """
    kind = kind or ("finite and " if finite else "") + ("positive" if positive else "not negative")
    rule = f"`{name}` must be {kind}"
    is_bool = isinstance(value, (bool, np.bool_)) or getattr(value, "dtype", None) is torch.bool
    try:
        number = math.nan if is_bool or isinstance(value, (str, bytes)) else float(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{rule}, got {value!r}.") from error
    if not (number > 0 if positive else number >= 0) or (finite and math.isinf(number)):
        raise ValueError(f"{rule}, got {value!r}.")
    return number


def as_numbers(name: str, value: Any) -> Tensor:
    """Return a number or an array of numbers as a float64 tensor, with its graph; integers become floats.

    Raises:
        ValueError: no numbers, none at all, booleans or complex numbers.
    """
    rule = f"`{name}` must be a number or an array of numbers"
    try:
        tensor = torch.as_tensor(value)
        if tensor.dtype is torch.bool or tensor.is_complex() or not tensor.numel():
            raise TypeError
        tensor = tensor.double() if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{rule}, got {value!r}.") from error
    return tensor


def check_type(name: str, value: Any, kind: type[Any] | tuple[type[Any], ...]) -> None:
    """Raise ValueError unless a value is of one of some classes."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or ".join(k.__name__ for k in kinds)
        came = f"the class {value.__name__}: make an object of it" if isinstance(value, type) else type(value).__name__
        raise ValueError(f"`{name}` must be a {wanted}, got {came}{cure(name, value)}.")


def check_generator(value: Any) -> None:
    """Raise ValueError unless `generator` is a torch.Generator, a sequence of them, one a run, or None."""
    each = value if isinstance(value, (list, tuple)) else [value]
    if not all(isinstance(generator, (torch.Generator, type(None))) for generator in each):
        raise ValueError(f"`generator` must be a torch.Generator, a list of one a run, or None, got {value!r}.")


def check_batch(name: str, value: Any) -> tuple[int, ...]:
    """Return a batch shape, given as a number or as a sequence of numbers.

    Raises:
        ValueError: no counts.
    """
    rule = f"`{name}` must be a number of runs or a shape"
    sizes = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    shape = tuple(as_index(rule, size) for size in sizes)
    if any(size < 0 for size in shape):
        raise ValueError(f"{rule}, got {value!r}.")
    return shape


def check_callable(name: str, value: Any, *, optional: bool = False) -> None:
    """Raise ValueError unless a value can be called, or is None where that is admitted."""
    if not callable(value) and not (optional and value is None):
        kind = f"callable{' or None' if optional else ''}"
        raise ValueError(f"`{name}` must be {kind}, got {type(value).__name__}{cure(name, value)}.")


def check_has(name: str, value: Any, kind: str, *attributes: str) -> None:
    """Raise ValueError unless a value has the attributes of what it is to be; `kind` says what that is."""
    if isinstance(value, type) or not all(hasattr(value, attribute) for attribute in attributes):
        came = f"the class {value.__name__}: make an object of it" if isinstance(value, type) else type(value).__name__
        raise ValueError(f"`{name}` must be {kind}, got {came}.")


def check_flag(name: str, value: Any) -> bool:
    """Return True or False.

    Raises:
        ValueError: anything else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"`{name}` must be True or False, got {value!r}.")
    return bool(value)


def window(name: str, value: Any, steps: int, channels: int, symbol: str) -> Tensor:
    """Return a past window as a tensor `(*batch, steps, channels)`; `symbol` is what messages call the channels."""
    tensor = as_data(name, value, finite=False)  # values are looked at inside the Function: here it would break vmap
    if tensor.shape[-2:] != (steps, channels):
        raise ValueError(
            f"`{name}` must have shape (*batch, t_ini, {symbol}) = (*, {steps}, {channels}), got {tuple(tensor.shape)}."
        )
    return tensor


def reference(name: str, value: Any, steps: int, channels: int, symbol: str, like: Tensor) -> Tensor:
    """Return a reference as a tensor `(*batch, steps, channels)`, on the device of `like`; zero for None."""
    if value is None:
        return like.new_zeros(()).expand(steps, channels)
    tensor = as_data(name, value, finite=False, integers=True).to(like.device)
    may_be_batch = tensor.ndim == 2 and like.ndim > 2 and tensor.shape[0] == like.shape[-3] > 1
    if may_be_batch and tensor.shape[0] == steps:
        warn_of_two_readings(name, tensor, "samples", stacklevel=7)
    try:
        return tensor.expand(*tensor.shape[:-2], steps, channels)
    except RuntimeError as error:
        hint = f" For one constant reference a sample give {name}[:, None]." if may_be_batch else ""
        raise ValueError(
            f"`{name}` must broadcast to (*batch, horizon, {symbol}) = (*, {steps}, {channels}), "
            f"got {tuple(tensor.shape)}.{hint}"
        ) from error


def warn_of_two_readings(name: str, reference: Tensor, many: str, *, stacklevel: int) -> None:
    """Warn of a reference `(rows, n)` in a call of as many samples: is each row a step, or a sample?

    Args:
        name: of the reference.
        reference: read as a trajectory, one row a step.
        many: "samples" or "runs".
        stacklevel: of the caller's caller, as :func:`warnings.warn` counts.
    """
    rows = len(reference)
    if is_mapped(reference) or bool((reference == reference[:1]).all()):  # both readings are the same plan
        return
    warnings.warn(
        f"`{name}` of shape {tuple(reference.shape)} is read as one trajectory of {rows} steps for all {rows} {many}. "
        f"For one constant reference each give {name}[:, None]; {name}[None] is one trajectory for all, without this "
        "warning.",
        stacklevel=stacklevel,
    )


def with_one_batch(parts: list[Tensor]) -> list[Tensor]:
    """Return u_ini, y_ini, u_ref and y_ref, `(*batch, steps, n)`, with one batch shape."""
    shapes = [part.shape[:-2] for part in parts]
    if all(shape == shapes[0] for shape in shapes):
        return parts
    batch = one_batch(zip(("u_ini", "y_ini", "u_ref", "y_ref"), shapes, strict=True))
    return [part.expand(*batch, *part.shape[-2:]) for part in parts]


def one_batch(named: Iterable[tuple[str, torch.Size]]) -> torch.Size:
    """Return the batch shape that all broadcast to, each given with its name.

    Raises:
        ValueError: they do not; it names those that have a batch dimension.
    """
    batched = [(name, shape) for name, shape in named if len(shape)]
    try:
        return broadcast_shapes(*{shape for _, shape in batched})
    except ValueError as error:
        came = ", ".join(f"{name} {tuple(shape)}" for name, shape in batched)
        raise ValueError(f"the batch shapes must broadcast, got {came}.") from error


def to_horizon(reference: Tensor, horizon: int) -> Tensor:
    """Return a reference `(..., rows, n)` of `horizon` rows: cut, or the last row held.

    One row, or `(n,)`, broadcasts over every horizon and is left alone.
    """
    if reference.ndim < 2 or reference.shape[-2] == 1:
        return reference
    rows = reference.shape[-2]
    if rows >= horizon:
        return reference[..., :horizon, :]
    held = reference[..., -1:, :].expand(*reference.shape[:-2], horizon - rows, reference.shape[-1])
    return torch.cat([reference, held], dim=-2)


def last_rows(window: Tensor, t_ini: int) -> Tensor:
    """Return the last `t_ini` steps of a window `(..., rows, n)`.

    Raises:
        ValueError: the window is shorter.
    """
    if window.shape[-2] < t_ini:
        raise ValueError(
            f"the windows have {window.shape[-2]} steps, and the attacker's data need t_ini = {t_ini}: an attacker may "
            "look at fewer past steps than the controller, not at more."
        )
    return window[..., -t_ini:, :]
