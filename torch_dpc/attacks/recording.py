"""Poisoned recordings: samples of the recording are changed before the controller plans with it.

    minimise over p   mean over windows of psi(plan made with the recording (u, y + p)),   p_k in the budget of y_k,

with p zero but at a few samples. The measurements of the run stay true; only the data are poisoned. The plan is
differentiable in the recorded data, to first order, so that one backward pass tells what every sample does.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..checks import as_index, check_count, check_generator, check_type
from ..data.hankel import HankelData
from ..data.recordings import as_recordings
from ..errors import ExcitationWarning
from ..layer import DPCLayer
from ..reprs import Described
from .budgets import Budget
from .costs import check_cost
from .influence import mean_psi

CHOICES = ("influence", "greedy", "random")


@dataclass(frozen=True)
class PoisonSettings:
    """Constants of the search."""

    rounds: int = 10  # in which "greedy" chooses its samples
    lengths: tuple[float, ...] = (1.0, 0.5, 0.25)  # of the step with new samples, tried until psi falls
    shorter: float = 0.5  # factor on the length of a step after one that did not lower psi


SETTINGS = PoisonSettings()


@dataclass(frozen=True, eq=False, repr=False)
class Poisoned(Described):
    """A poisoned recording.

    Attributes:
        y: the poisoned outputs, as they came: `(T, n_y)`, or a list of such.
        p: what was added, `(T, n_y)`, the recordings of a list one after another.
        samples: the rows of p that may differ from zero, in the order in which they were chosen, `(k,)`.
        layer: the layer that plans with the poisoned recording.
        before, after: mean psi with the clean and with the poisoned recording.
    """

    y: Tensor | list[Tensor]
    p: Tensor
    samples: Tensor
    layer: DPCLayer
    before: float
    after: float

    def __repr__(self) -> str:
        return f"Poisoned({len(self.samples)} of {len(self.p)} samples, psi {self.before:.4g} -> {self.after:.4g})"


class PoisonedRecording(Described):
    """Change a few samples of the recorded outputs so that the plans made with the recording suit the attacker.

    The first step is Algorithm 1's, the best vertex of the budget for the linearised psi, on the chosen samples. Each
    further one goes towards the vertex of the present slope, half as far after a step that did not lower psi
    (Frank-Wolfe). The answer is never worse for the attacker than the clean recording.

    A recording without noise has a lower rank than its neighbours, and its derivative holds among recordings of that
    rank only. There it proposes samples and the first step; what counts is psi of the poisoned recording.

    Args:
        layer: the planning problem; its data are replaced.
        cost: psi, a callable DPCSolution -> `(*batch,)`, to be made small.
        budget: of each sample, whose window is that one sample: `BallBudget(0.1)` bounds every |p_k| by 0.1. Convex.
        samples: how many samples are changed, or which: their rows in the recording.
        choose: how they are chosen where a number is given: "influence", by the fall of psi that the derivative
            promises for each at the clean recording; "greedy", likewise a few at a time, at the recording poisoned so
            far; "random".
        steps: after the first.

    Raises:
        ValueError: bad input, named.

    Example:
        >>> import torch_dpc as dpc
        >>> plant = dpc.systems.OscillatingMasses(noise=0.01)
        >>> u, y = dpc.collect(plant, 200, generator=torch.Generator().manual_seed(0))
        >>> data = dpc.HankelData.from_trajectories(u[:150], y[:150], t_ini=4, horizon=10)
        >>> layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-1.0, 1.0))
        >>> cost = dpc.attacks.TargetInput(torch.ones(2))
        >>> attack = PoisonedRecording(layer, cost, dpc.attacks.BallBudget(0.1), samples=5, steps=3)
        >>> poisoned = attack(u[:150], y[:150], u[160:164], y[160:164])
        >>> poisoned.after < poisoned.before, poisoned.p.norm(dim=1).max() <= 0.1 + 1e-9
        (True, tensor(True))
    """

    def __init__(
        self, layer: DPCLayer, cost: Any, budget: Budget, *, samples: Any, choose: str = "influence", steps: int = 10
    ):
        check_type("layer", layer, DPCLayer)
        check_type("layer.data", layer.data, HankelData)
        check_cost(cost)
        check_type("budget", budget, Budget)
        if not budget.convex:
            raise ValueError(f"`budget` must be convex, got {type(budget).__name__}.")
        if choose not in CHOICES:
            raise ValueError(f"`choose` must be one of {', '.join(CHOICES)}, got {choose!r}.")
        rule = "`steps` must be an integer, 0 or more"
        if as_index(rule, steps) < 0:
            raise ValueError(f"{rule}, got {steps!r}.")
        self.layer, self.cost, self.budget, self.choose, self.steps = layer, cost, budget, choose, steps
        self.samples: int | list[int] = _samples(samples)

    def __repr__(self) -> str:
        rest = f"samples={self.samples}, choose={self.choose!r}, steps={self.steps}"
        return f"PoisonedRecording({self.cost!r}, {self.budget!r}, {rest})"

    def __call__(
        self,
        u: Any,
        y: Any,
        u_ini: Any,
        y_ini: Any,
        *,
        y_ref: Any = None,
        u_ref: Any = None,
        generator: torch.Generator | None = None,
        step: int = 0,
    ) -> Poisoned:
        """Poison a recording.

        Args:
            u, y: the recording, `(T, n_u)` and `(T, n_y)`, or lists of such.
            u_ini, y_ini: the windows that are planned from, held out of the recording, `(*batch, t_ini, n)`.
            y_ref, u_ref: references, as the layer takes them.
            generator: of the random choice.
            step: of the run, for costs that move with it.

        Raises:
            ValueError: shapes that do not fit, fewer samples than are to be changed, or a clean recording that leaves
                a window without a plan.
        """
        check_generator(generator)
        us, ys = as_recordings(u, y)
        search = _Search(self, us, ys, (u_ini, y_ini, y_ref, u_ref, step))
        p, psi = search.run(generator)
        outputs = search.outputs(p)
        is_list = isinstance(y, Sequence) and len(outputs) > 0 and getattr(y[0], "ndim", 0) == 2
        poisoned = outputs if is_list else outputs[0]
        return Poisoned(poisoned, p, search.chosen, search.layer(p), search.before, psi)


class _Search:
    """One poisoning: the recording, and where the search stands."""

    def __init__(self, attack: PoisonedRecording, us: list[Tensor], ys: list[Tensor], windows: tuple[Any, ...]):
        self.attack, self.us, self.windows = attack, us, windows
        self.lengths = [len(one) for one in ys]
        self.y = torch.cat(ys).detach()
        wanted = attack.samples if isinstance(attack.samples, int) else 1 + max(attack.samples)
        if wanted > len(self.y):
            raise ValueError(f"`samples` = {attack.samples} asks for more than the {len(self.y)} recorded samples.")
        self.p = torch.zeros_like(self.y)
        self.before, self.gradient = self.psi_and_gradient(self.p)
        if not self.before < torch.inf:
            raise ValueError("`u_ini` and `y_ini` must hold windows that have a plan with the clean recording.")
        self.psi = torch.inf  # the first step is taken wherever it leads: the clean slope may hold only nearby
        self.chosen = torch.arange(0)

    def run(self, generator: torch.Generator | None) -> tuple[Tensor, float]:
        """Return the best p and its psi; p = 0 if nothing lowers psi."""
        for group in self.groups(generator):
            more = self.best_samples(group) if isinstance(group, int) else group
            self.chosen = torch.cat([self.chosen, more])
            any(self.step(length) for length in SETTINGS.lengths)
        length = 1.0
        for _ in range(self.attack.steps):
            length *= 1.0 if self.step(length) else SETTINGS.shorter
        return (self.p, self.psi) if self.psi < self.before else (torch.zeros_like(self.p), self.before)

    def groups(self, generator: torch.Generator | None) -> Iterable[int | Tensor]:
        """Return the samples, or how many are to be chosen at a time."""
        count = self.attack.samples
        if not isinstance(count, int):
            return [torch.tensor(count)]
        if self.attack.choose == "random":
            return [torch.randperm(len(self.y), generator=generator)[:count]]
        rounds = min(SETTINGS.rounds, count) if self.attack.choose == "greedy" else 1
        return [len(part) for part in torch.arange(count).chunk(rounds)]

    def best_samples(self, count: int) -> Tensor:
        """Return the samples that promise the largest fall of psi, beyond those that were chosen."""
        promised = -(self.gradient * self.vertex()).sum(1)
        promised[self.chosen] = -torch.inf
        return promised.argsort(descending=True, stable=True)[:count]

    def step(self, length: float) -> bool:
        """Go towards the best vertex on the chosen samples, if psi falls; return whether it does."""
        towards = torch.zeros_like(self.p)
        towards[self.chosen] = self.vertex()[self.chosen] - self.p[self.chosen]
        trial = self.p + length * towards
        psi, gradient = self.psi_and_gradient(trial)
        if falls := psi < self.psi:
            self.p, self.psi, self.gradient = trial, psi, gradient
        return falls

    def vertex(self) -> Tensor:
        """Return the admissible change of each sample that lowers the linearised psi most, `(T, n_y)`."""
        c, y = self.gradient[:, None].double(), self.y[:, None].double()
        return self.attack.budget.minimize_linear(c, y)[:, 0].to(self.y)

    def psi_and_gradient(self, p: Tensor) -> tuple[float, Tensor]:
        """Return mean psi and its derivative in every recorded sample; infinity where either does not exist."""
        with torch.inference_mode(False), torch.enable_grad():
            p = p.detach().clone().requires_grad_()
            layer = self.layer(p)
            assert isinstance(layer.data, HankelData)
            psi = mean_psi(layer, self.attack.cost, *self.windows) if layer.data.row_space.clear else None
            if psi is None or not bool(psi.isfinite()):
                return torch.inf, torch.zeros_like(p)
            (gradient,) = torch.autograd.grad(psi, p)
        return float(psi.detach()), gradient

    def layer(self, p: Tensor) -> DPCLayer:
        """Return the layer that plans with the poisoned recording."""
        data = self.attack.layer.data
        assert isinstance(data, HankelData)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExcitationWarning)  # of the inputs, which are not changed
            poisoned = HankelData.from_trajectories(self.us, self.outputs(p), t_ini=data.t_ini, horizon=data.horizon)
        if data.n_ridge:  # the controller's own, which no recording changes
            wider: dict[str, Any] = {}
            for name in ("Up", "Uf", "Yp", "Yf"):
                ridge = getattr(data, name)[:, -data.n_ridge :].to(p)
                wider[name] = torch.cat([getattr(poisoned, name), ridge], dim=1)
            poisoned = replace(poisoned, **wider, n_ridge=data.n_ridge)
        return DPCLayer(poisoned, **self.attack.layer.config())

    def outputs(self, p: Tensor) -> list[Tensor]:
        """Return the poisoned outputs of each recording."""
        return list((self.y + p).split(self.lengths))


def _samples(value: Any) -> int | list[int]:
    """Return a count, or a list of rows without repetition."""
    if isinstance(value, Tensor) and value.ndim == 1:
        value = value.tolist()
    if not isinstance(value, (list, tuple, range)):
        return check_count("samples", value)
    rule = "`samples` must be a positive integer or different rows of the recording, 0 or more"
    rows = [as_index(rule, row) for row in value]
    if not rows or min(rows) < 0 or len(set(rows)) < len(rows):
        raise ValueError(f"{rule}, got {value!r}.")
    return rows
