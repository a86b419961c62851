"""The compiled extension, where it was built, and the tolerances and limits of its kernels."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from .outcome import ACCEPTANCE
from .weakness import WEAKLY_ACTIVE

try:
    if os.environ.get("TORCH_DPC_NO_KERNELS", "0") not in ("", "0"):
        raise ImportError("switched off")
    from . import _kernels
except ImportError:
    _kernels = None  # type: ignore[assignment]


@dataclass(frozen=True)
class KernelSettings:
    """Tolerances and limits of the kernels."""

    #: v + lam must pass a bound by this, relative to 1 + |bound|, for its row to be active. Without it rounding makes
    #: the set flicker at rows that only touch their bound.
    hysteresis: float = 1e-12
    #: A Cholesky factor of G[A, A] is trusted if every row of Ct has a part outside the span of the rows before it, of
    #: more than this fraction of its length; G cannot resolve less.
    independence: float = 1e-5
    #: A row that depends on the active ones may pass its bound by this, relative to 1 + |bound|: they hold it there, up
    #: to rounding.
    touching: float = 1e-10
    #: Steps of the primal-dual method after which the dual method takes over; samples that converge need 1 to 8.
    primal_dual_steps: int = 10
    #: |v - P(v + gamma lam)| relative to 1 + |v| at which Newton's method ends: a hundred roundings.
    converged: float = 1e-13
    #: The same, at which its result counts as a solution; the judgement of plans asks for less.
    good: float = 1e-10
    #: The same, at which the proximal point method leaves the rest to Newton's method.
    close: float = 1e-11
    #: Newton steps and halvings of one; samples that converge need 3 to 8 steps.
    newton_steps: int = 25
    halvings: int = 12
    #: Rounds of the proximal point method, and how many it may go on without halving the residual.
    rounds: int = 60
    patience: int = 20
    #: Newton steps of a round, and bisections of one.
    inner_steps: int = 40
    bisections: int = 40
    #: The penalty begins at 1 / gamma and grows by this from round to round, up to the largest times 1 / gamma. Beyond
    #: it rounding grows with the penalty.
    growth: float = 10.0
    largest_penalty: float = 1e7
    #: Displacements and distances up to this, relative to 1 + |v|, count as zero.
    weakness: float = WEAKLY_ACTIVE
    #: The residual of a plan, together with the error of the map, that needs no second look.
    convincing: float = ACCEPTANCE.convincing

    @cached_property
    def compiled(self) -> Any:
        """The same settings as the kernels read them."""
        return _kernels.settings(**asdict(self))
