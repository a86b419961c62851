"""A module whose attributes are the settings of a planning problem.

An attribute is checked when it is assigned, and what follows from all of them is derived when it is asked for. Copies,
pickles and `state_dict` keep the settings, and leave out what can be computed again.
"""

from __future__ import annotations

import contextlib
import inspect
from typing import Any

import torch
from torch import Tensor, nn

from .checkpoints import restore, state_of
from .checks import reference, window, with_one_batch
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .factors import Factors
from .problem.terms import Sizes, Terms
from .reprs import shown
from .sets import ConvexSet, Reals
from .sets.feasible import FeasibleSet
from .settings import VALIDATORS, GivenWeights, Settings, Setup
from .tracing import register


class ConfiguredModule(nn.Module):
    """The settings of a layer; see :class:`torch_dpc.DPCLayer` for what each of them means."""

    data: HankelData | HankelBatch
    u_set: ConvexSet
    y_set: ConvexSet
    du_set: ConvexSet | None
    slack_set: ConvexSet | None
    regularizer: str
    terminal_steps: int
    affine: bool
    backward_system: str
    solver: str
    on_failure: str

    def __init__(self) -> None:
        super().__init__()
        self._setup_cache: tuple[Settings, Setup] | None = None
        self._factors = Factors()
        self._handle = register(self)

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign; a setting is checked first, as the constructor checks it."""
        validate = VALIDATORS.get(name)
        super().__setattr__(name, value if validate is None else validate(name, value))

    @property
    def _setup(self) -> Setup:
        """What follows from the settings, derived again when one of them has changed."""
        now = Settings.of(self.__dict__)
        kept = self._setup_cache
        if kept is None or kept[0] != now:
            kept = self._setup_cache = (now, Setup.of(now))
        return kept[1]

    @property
    def _given(self) -> GivenWeights:
        """The weights as they are now."""
        weights = (self.Q, self.R, self.lambda_g, self.lambda_s, self.lambda_u, self.R_du, self.Q_terminal, self.beta_2)
        return GivenWeights(*weights)

    @property
    def backward(self) -> str:
        """The system that the backward solves, "reduced" or "full"; may be assigned."""
        return self.backward_system

    @backward.setter
    def backward(self, value: str) -> None:
        self.backward_system = value

    @property
    def terms(self) -> Terms:
        """Which terms the problem has beyond the paper's."""
        return self._setup.terms

    @property
    def sizes(self) -> Sizes:
        """The sizes of the parts of theta and of v."""
        return self._setup.sizes

    @property
    def feasible_set(self) -> FeasibleSet:
        """All sets of the problem as one."""
        return self._setup.sets

    @property
    def reduced_kkt_size(self) -> int:
        """Unknowns of the reduced system: horizon (n_u + n_y), and more with `R_du`, `du_set` or `slack_set`."""
        return self.sizes.v

    @property
    def full_kkt_size(self) -> int:
        """Unknowns of the paper's system: 2 horizon (n_u + n_y) + t_ini n_u + n_g.

        Raises:
            ValueError: the data sets of a batch have different n_g.
        """
        data = self.data
        return 2 * data.horizon * (data.n_u + data.n_y) + data.t_ini * data.n_u + data.n_g

    def own_tensors(self) -> list[Tensor]:
        """Return the weights that are tensors, then the parameters of the sets."""
        found = [weight for weight in self._given if isinstance(weight, Tensor)]
        for owner in (self.u_set, self.y_set, self.du_set, self.slack_set):
            found += [] if owner is None else list(owner.parameters())
        return found

    def flatten(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any) -> tuple[Tensor, torch.dtype]:
        """Return (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)` in float64, and the caller's dtype.

        For affine systems a 1 stands before them.
        """
        data = self.data
        u_ini = window("u_ini", u_ini, data.t_ini, data.n_u, "n_u")
        y_ini = window("y_ini", y_ini, data.t_ini, data.n_y, "n_y")
        parts = [
            u_ini,
            y_ini,
            reference("u_ref", u_ref, data.horizon, data.n_u, "n_u", u_ini),
            reference("y_ref", y_ref, data.horizon, data.n_y, "n_y", y_ini),
        ]
        dtype = u_ini.dtype if u_ini.dtype == y_ini.dtype else torch.promote_types(u_ini.dtype, y_ini.dtype)
        if all(part.ndim == 2 for part in parts):
            theta = torch.cat([part.reshape(-1) for part in parts])
        else:
            theta = torch.cat([part.flatten(-2) for part in with_one_batch(parts)], dim=-1)
        if self.affine:
            theta = torch.cat([torch.ones_like(theta[..., :1]), theta], dim=-1)
        return (theta if theta.dtype == torch.float64 else theta.double()), dtype

    def get_extra_state(self) -> Tensor:
        """Return what `state_dict` holds besides parameters: compact data, settings and sets, as bytes."""
        return state_of(self)

    def set_extra_state(self, state: Tensor) -> None:
        """Take over data, settings and sets of a checkpoint, so that the layer plans like the one that was saved.

        Raises:
            ValueError: the checkpoint does not fit.
        """
        restore(self, state)

    def __repr__(self) -> str:
        """Describe the data, every argument that is not left at its default, and the systems that are solved."""
        defaults = inspect.signature(type(self)).parameters
        weights: list[str] = []
        sets: list[str] = []
        sizes: list[str] = []
        for name, value in self.config().items():
            usual = defaults[name].default
            if not (value is usual or isinstance(usual, (str, int)) and value == usual or type(value) is Reals):
                (sets if isinstance(value, ConvexSet) else weights).append(f"{name}={shown(value)}")
        for name in ("reduced_kkt_size", "full_kkt_size"):
            # Settings under change may not fit, and the data sets of a batch may differ: neither has a size to show.
            with contextlib.suppress(ValueError):
                sizes.append(f"{name}={getattr(self, name)}")
        lines = (repr(self.data), ", ".join(weights), ", ".join(sets), ", ".join(sizes))
        text = ",\n    ".join(filter(None, lines))
        return f"{type(self).__name__}({text})"

    def config(self) -> dict[str, Any]:
        """Return the arguments of the constructor beyond the data, as they are now."""
        raise NotImplementedError

    def __getstate__(self) -> dict[str, Any]:
        """Leave the factors out of copies and pickles: they are made again when needed."""
        return {**self.__dict__, "_factors": Factors(), "_setup_cache": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Give a copy a handle of its own."""
        super().__setstate__(state)
        self._handle = register(self)
