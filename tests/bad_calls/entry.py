"""What an entry of the tables is, and the values that are wrong for most arguments."""

import re
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

#: A name, and a rule in words.
WORDS = 5
NAN, INF = float("nan"), float("inf")
#: No positive integer.
NO_COUNT = (0, -1, 1.5, True, "3", None, NAN)
#: No number at all.
NO_NUMBER = ("a", None, [], {}, 1j)
#: No positive finite number.
NOT_POSITIVE = (-1.0, 0.0, NAN, INF, *NO_NUMBER)
#: No finite number that may be zero.
NEGATIVE = (-1.0, NAN, INF, *NO_NUMBER)


class Call(NamedTuple):
    """A malformed call: what the error must name, and the call."""

    label: str
    names: str  # an argument, which stands in backticks, or words of the rule
    run: Callable[[], Any]

    def is_named(self, message: str) -> bool:
        """Return whether a message names the argument, alone or as a part of it, `u[0]`, and gives a rule."""
        quoted = re.search(rf"`[^`]*\b{self.names}\b[^`]*`", message) if self.names.isidentifier() else None
        is_there = quoted is not None or (not self.names.isidentifier() and self.names in message)
        return is_there and len(message.split()) >= WORDS


def each(names: str, label: str, values: Iterable[Any], call: Callable[[Any], Any]) -> list[Call]:
    """Return an entry for each wrong value of one argument."""
    return [Call(f"{label}={_short(value)}", names, lambda value=value: call(value)) for value in values]


def one(names: str, label: str, call: Callable[[], Any]) -> list[Call]:
    return [Call(label, names, call)]


def _short(value: Any) -> str:
    text = "tensor" + str(tuple(value.shape)) if hasattr(value, "shape") else repr(value)
    text = type(value).__name__ if " at 0x" in text or "\n" in text else text
    return text if len(text) < 40 else text[:37] + "..."
