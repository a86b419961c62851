"""Sets by name: what a saved layer may hold, and how a set is written.

A set is written as the arguments of its constructor: what its method `config()` returns, a dictionary, or without one
its attributes named as the parameters of `__init__`. Sets of the package are known; others by :func:`register_set`.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any, TypeVar

from torch import nn

from . import ConvexSet

S = TypeVar("S", bound=type[ConvexSet])

_registered: dict[str, type[ConvexSet]] = {}


def register_set(cls: S) -> S:
    """Make a set of one's own known to saved layers, under the name of its class; also works as a decorator.

    The set is written as what its method `config()` returns, the arguments of its constructor as numbers, strings,
    tensors, lists and sets; without that method, as its attributes named as the parameters of `__init__`.

    Raises:
        ValueError: not a ConvexSet, or another set has the name.

    Example:
        >>> @register_set
        ... class Halfline(ConvexSet):
        ...     def __init__(self, start):
        ...         super().__init__()
        ...         self.start = start
        ...     def project(self, x):
        ...         return x.clamp_min(self.start)
        >>> arguments_of(Halfline(2.0))
        {'start': 2.0}
    """
    if not (isinstance(cls, type) and issubclass(cls, ConvexSet)):
        raise ValueError(f"`cls` must be a subclass of ConvexSet, got {cls!r}.")
    other = known_sets().get(cls.__name__)
    if other is not None and _origin(other) != _origin(cls):
        raise ValueError(f"the name {cls.__name__!r} is taken by {'.'.join(_origin(other))}: rename the class.")
    _registered[cls.__name__] = cls
    return cls


def known_sets() -> dict[str, type[ConvexSet]]:
    """Return the sets that can be saved and loaded, by name: those of the package and those registered."""

    def below(cls: type[ConvexSet]) -> Iterator[type[ConvexSet]]:
        for child in cls.__subclasses__():
            yield child
            yield from below(child)

    package = __name__.partition(".")[0]
    own = {cls.__name__: cls for cls in below(ConvexSet) if cls.__module__.partition(".")[0] == package}
    return {**_registered, **own}


def arguments_of(thing: Any) -> dict[str, Any]:
    """Return the arguments that make an object again: its `config()`, or its attributes named as its parameters.

    A `config()` from further up than `__init__` speaks of another constructor, and does not count.
    """
    cls = type(thing)
    owner = {name: next((c for c in cls.__mro__ if name in vars(c)), object) for name in ("config", "__init__")}
    if owner["config"] not in (object, ConvexSet) and issubclass(owner["config"], owner["__init__"]):
        return dict(thing.config())
    if owner["__init__"] is nn.Module:  # a set without arguments
        return {}
    names = [name for name in inspect.signature(cls.__init__).parameters if name != "self"]
    missing = [name for name in names if not hasattr(thing, name)]
    if missing:
        raise ValueError(
            f"{cls.__name__} cannot be saved: it has no attribute {missing[0]!r} to go with the parameter of "
            f"its constructor. Keep the argument under that name, or define `config()`, which returns the arguments."
        )
    return {name: getattr(thing, name) for name in names}


def _origin(cls: type) -> tuple[str, str]:
    return cls.__module__, cls.__qualname__
