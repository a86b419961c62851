"""The settings of a layer: what each may be, and what follows from all of them as they are now.

A setting is checked when it is assigned. Conditions on several settings are checked when a layer is used, so that one
setting may be changed after the other: :meth:`Setup.of` checks them, again whenever :class:`Settings` have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from .checks import as_index, cure
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .problem.terms import REGULARIZERS, Sizes, Terms
from .sets import ConvexSet, Reals
from .sets.feasible import FeasibleSet, identity_key
from .watch import Watch

#: The settings that take one of a few words.
CHOICES = {
    "regularizer": REGULARIZERS,
    "backward": ("reduced", "full"),
    "solver": ("auto", "newton", "daqp"),
    "on_failure": ("raise", "nan"),
}


class GivenWeights(NamedTuple):
    """The weights of a layer as they were given: numbers, tensors or parameters; None for terms that are not there."""

    Q: Any
    R: Any
    lambda_g: Any
    lambda_s: Any
    lambda_u: Any
    R_du: Any
    Q_terminal: Any
    beta_2: Any


class Settings(NamedTuple):
    """The settings of a layer besides its weights, to compare by `==`.

    A set is given by :func:`torch_dpc.sets.feasible.identity_key`, whose first entry is the set itself.
    """

    data: HankelData | HankelBatch
    u_set: tuple[Any, ...]
    y_set: tuple[Any, ...]
    du_set: tuple[Any, ...] | None
    slack_set: tuple[Any, ...] | None
    regularizer: str
    terminal_steps: int
    has_lambda_u: bool
    has_R_du: bool
    has_beta_2: bool
    affine: bool
    backward: str
    solver: str

    @staticmethod
    def of(held: dict[str, Any]) -> Settings:
        """Read the settings from the dictionary of a layer.

        They are read at every call, and a module's own access to its children takes 0.3 us each.
        """
        modules = held["_modules"]
        du_set, slack_set = modules.get("du_set"), modules.get("slack_set")
        return Settings(
            held["data"],
            identity_key(modules["u_set"]),
            identity_key(modules["y_set"]),
            None if du_set is None else identity_key(du_set),
            None if slack_set is None else identity_key(slack_set),
            held["regularizer"],
            held["terminal_steps"],
            _is_given("lambda_u", held),
            _is_given("R_du", held),
            _is_given("beta_2", held),
            held["affine"],
            held["backward_system"],
            held["solver"],
        )


@dataclass(frozen=True, eq=False)
class Setup:
    """What follows from the settings of a layer.

    Attributes:
        data: the recorded trajectories; for affine systems with a row of ones.
        terms: which terms the problem has beyond the paper's.
        sizes: the parts of theta and of v.
        sets: all sets of the problem as one.
        backward: "reduced" or "full".
        solver: "auto", "newton" or "daqp".
    """

    data: HankelData | HankelBatch
    terms: Terms
    sizes: Sizes
    sets: FeasibleSet
    backward: str
    solver: str

    @cached_property
    def of_factors(self) -> tuple[Any, ...]:
        """What the factors depend on besides the weights, to compare by `==`."""
        return self.solver, self.backward, self.data, self.terms, self.sets.structure_key

    @cached_property
    def windows(self) -> tuple[tuple[int, int], ...]:
        """The shapes of u_ini, y_ini, u_ref and y_ref of one sample."""
        data = self.data
        return (data.t_ini, data.n_u), (data.t_ini, data.n_y), (data.horizon, data.n_u), (data.horizon, data.n_y)

    @staticmethod
    def of(settings: Settings) -> Setup:
        """Derive the setup.

        Raises:
            ValueError: settings that do not go together, or not with the data.
        """
        data, steps = settings.data.with_ones if settings.affine else settings.data, settings.terminal_steps
        if data.has_ones and not settings.affine:
            raise ValueError("`affine` must be True for these data, which were saved by a layer with `affine=True`.")
        if not 0 <= steps <= data.horizon:
            raise ValueError(
                f"`terminal_steps` must be an integer from 0 to the horizon, {data.horizon}, got {steps!r}."
            )
        rates = settings.has_R_du or settings.du_set is not None
        mismatch = settings.slack_set is not None
        terms = Terms(settings.regularizer, settings.has_lambda_u, rates, steps, settings.affine, mismatch)
        if settings.has_beta_2 != (terms.regularizer == "gamma"):
            raise ValueError(
                '`regularizer="gamma"` needs `beta_2`, the weight of gamma_2, and no other regularizer has it; got '
                f"`regularizer={terms.regularizer!r}` with{'' if settings.has_beta_2 else 'out'} `beta_2`."
            )
        if terms.slack and terms.rates:
            raise ValueError("`R_du` and `du_set` count from the last u_ini, which `lambda_u` leaves open: give one.")
        horizon = data.horizon
        named = [("u_set", settings.u_set[0], horizon, data.n_u), ("y_set", settings.y_set[0], horizon, data.n_y)]
        if rates:
            named.append(("du_set", Reals() if settings.du_set is None else settings.du_set[0], horizon, data.n_u))
        if settings.slack_set is not None:
            named.append(("slack_set", settings.slack_set[0], data.t_ini, data.n_y))
        sets = FeasibleSet.of(named)
        sets.check_engine(settings.solver)
        return Setup(data, terms, Sizes.of(data, terms), sets, settings.backward, settings.solver)


def watch_of(held: dict[str, Any], setup: Setup) -> Watch | None:
    """Return a watch over the weights and the parameters of the sets; None if they cannot be watched.

    Args:
        held: the dictionary of the layer.
        setup: what follows from its settings.
    """
    if not isinstance(setup.data, HankelData) or not setup.sets.is_of_the_package:
        return None
    places = []
    for name in GivenWeights._fields:
        holder = next((part for part in (held, held["_parameters"], held["_buffers"]) if name in part), None)
        if holder is None:  # parametrised: made anew whenever it is asked for
            return None
        places.append((holder, name))
    for owner, _ in setup.sets.parts:
        holders = (owner.__dict__, owner._parameters, owner._buffers)
        places += [(holder, name) for holder in holders for name in holder if name[0] != "_" and name != "training"]
    try:
        return Watch(places, setup.data.matrices)
    except ValueError:
        return None


def _is_given(name: str, held: dict[str, Any]) -> bool:
    """Return whether a weight is not None; one that is no plain attribute may be a parameter, or parametrised."""
    if name in held:
        return held[name] is not None
    return held["_parameters"].get(name, held) is not None


def check_choice(name: str, value: Any) -> str:
    """Return a setting that takes one of a few words.

    Raises:
        ValueError: another word.
    """
    if name == "regularizer" and value in ("l1", "1-norm"):
        raise ValueError(
            f"`regularizer` must be one of {', '.join(map(repr, CHOICES[name]))}, got {value!r}: the 1-norm of g is "
            "not invariant under rotations of g, so a problem with it does not reduce to the row space of the data. "
            "For a plan from few windows use `NearestWindows`; for a 1-norm of the slack give "
            "`slack_set=SoftBox(0.0, 0.0, price)`."
        )
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
        raise ValueError(f"`{name}` must be a ConvexSet or None, got {type(value).__name__}{cure('set', value)}.")
    return value


def _set_or_none(name: str, value: Any) -> ConvexSet | None:
    return None if value is None else _set(name, value)


def _steps(name: str, value: Any) -> int:
    return as_index(f"`{name}` must be an integer from 0 to the horizon", value)


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"`{name}` must be True or False, got {value!r}.")
    return value


def _backward(_: str, value: Any) -> str:
    return check_choice("backward", value)


#: The check of each attribute of a layer, applied when it is assigned.
VALIDATORS: Mapping[str, Callable[[str, Any], Any]] = {
    "data": _data,
    "u_set": _set,
    "y_set": _set,
    "du_set": _set_or_none,
    "slack_set": _set_or_none,
    "terminal_steps": _steps,
    "affine": _flag,
    "regularizer": check_choice,
    "backward_system": _backward,
    "solver": check_choice,
    "on_failure": check_choice,
}
