"""The settings of a layer: what each may be, and what follows from all of them as they are now.

A setting is checked where it is assigned. What two of them must agree on is checked where they are used, so that one
may be changed after the other: :meth:`Setup.of` derives it, and a layer asks for it again when `settings_of` differs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from .checks import as_index
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .problem.terms import Sizes, Terms
from .sets import ConvexSet, Reals
from .sets.feasible import FeasibleSet, outline

#: The settings that take one of a few words.
CHOICES = {
    "regularizer": ("projection", "identity"),
    "backward": ("reduced", "full"),
    "solver": ("auto", "newton", "daqp"),
    "on_failure": ("raise", "nan"),
}


@dataclass(frozen=True, eq=False)
class Setup:
    """What follows from the settings of a layer.

    Attributes:
        terms: which terms the problem has beyond the paper's.
        sizes: the parts of theta and of v.
        sets: all sets of the problem as one.
        is_box: whether they are a box together.
        of_factors: what the factors hang on besides the weights, to compare by `==`. Boxes are no part of it: their
            bounds are read at every call.
    """

    terms: Terms
    sizes: Sizes
    sets: FeasibleSet
    is_box: bool
    of_factors: tuple[Any, ...]

    @staticmethod
    def of(layer: Any) -> Setup:
        """Derive it.

        Raises:
            ValueError: settings that do not go together, or not with the data.
        """
        data, steps = layer.data, layer.terminal_steps
        if not 0 <= steps <= data.horizon:
            raise ValueError(
                f"`terminal_steps` must be an integer from 0 to the horizon, {data.horizon}, got {steps!r}."
            )
        rates = layer.R_du is not None or layer.du_set is not None
        terms = Terms(layer.regularizer == "identity", layer.lambda_u is not None, rates, steps)
        if terms.slack and terms.rates:
            raise ValueError("`R_du` and `du_set` count from the last u_ini, which `lambda_u` leaves open: give one.")
        named = [("u_set", layer.u_set, data.n_u), ("y_set", layer.y_set, data.n_y)]
        if rates:
            named.append(("du_set", Reals() if layer.du_set is None else layer.du_set, data.n_u))
        sets = FeasibleSet.of((name, owner, data.horizon, n) for name, owner, n in named)
        engine = layer.solver, layer.on_failure, layer.backward_system
        is_box = sets.is_box
        if not is_box and (layer.backward_system == "full" or layer.solver != "auto"):
            raise ValueError('`backward="full"` and the choice of a `solver` are for sets that are boxes.')
        return Setup(terms, Sizes.of(data, terms), sets, is_box, (*engine, data, terms, None if is_box else sets))


def settings_of(held: dict[str, Any]) -> tuple[Any, ...]:
    """Return what a :class:`Setup` hangs on, to compare by `==`; `held` is the dictionary of the layer.

    It is read at every call, and a module's own way to its parts takes 0.3 us each.
    """
    modules = held["_modules"]
    du_set = modules.get("du_set")
    return (
        held["data"],
        held["regularizer"],
        held["terminal_steps"],
        _is_given("lambda_u", held),
        _is_given("R_du", held),
        held["backward_system"],
        held["solver"],
        held["on_failure"],
        outline(modules["u_set"]),
        outline(modules["y_set"]),
        None if du_set is None else outline(du_set),
    )


def _is_given(name: str, held: dict[str, Any]) -> bool:
    """Return whether a weight is not None; one that is no plain attribute may be a parameter, or parametrised."""
    if name in held:
        return held[name] is not None
    return held["_parameters"].get(name, held) is not None


# --- one by one -------------------------------------------------------------------------------------------------------


def check_choice(name: str, value: Any) -> str:
    """Return a setting that takes one of a few words.

    Raises:
        ValueError: another word.
    """
    choices = CHOICES[name]
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"`{name}` must be one of {', '.join(map(repr, choices))}, got {value!r}.")
    return value


def _data(name: str, value: Any) -> HankelData | HankelBatch:
    if not isinstance(value, (HankelData, HankelBatch)):
        raise ValueError(f"`{name}` must be a HankelData or a HankelBatch, got {type(value).__name__}.")
    return value


def _set(name: str, value: Any) -> ConvexSet:
    """Return a set; None stands for no constraint."""
    if value is None:
        return Reals()
    if not isinstance(value, ConvexSet):
        raise ValueError(f"`{name}` must be a ConvexSet or None, got {type(value).__name__}.")
    return value


def _set_or_none(name: str, value: Any) -> ConvexSet | None:
    return None if value is None else _set(name, value)


def _steps(name: str, value: Any) -> int:
    return as_index(f"`{name}` must be an integer from 0 to the horizon", value)


def _backward(_: str, value: Any) -> str:
    return check_choice("backward", value)


#: What an attribute of a layer goes through when it is assigned.
DOORS: Mapping[str, Callable[[str, Any], Any]] = {
    "data": _data,
    "u_set": _set,
    "y_set": _set,
    "du_set": _set_or_none,
    "terminal_steps": _steps,
    "regularizer": check_choice,
    "backward_system": _backward,
    "solver": check_choice,
    "on_failure": check_choice,
}
