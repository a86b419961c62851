"""Is one controller better than another? Every start, every disturbance, every attack, with paired intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..attacks.base import Attack
from ..checks import check_count
from ..control.controller import DPCController
from ..control.simulation import simulate
from ..layer import DPCLayer
from ..systems.plant import Plant


@dataclass(frozen=True)
class VerdictSettings:
    """Constants of the comparison."""

    resamples: int = 2000  # of the paired bootstrap
    confidence: float = 0.95  # of each interval
    slack: float = 0.01  # an error may grow by this fraction of its old mean and count as no worse
    floor: float = 1e-9  # errors below this are rounding [units of the outputs]


SETTINGS = VerdictSettings()


class Pushed:
    """A plant whose inputs are pushed for a few steps: a disturbance that the controller does not know.

    Args:
        plant: the plant.
        push: added to the input, `(n_u,)`.
        first, steps: when, counted from the reset.
    """

    def __init__(self, plant: Plant, push: Any, first: int, steps: int):
        self.plant, self.push, self.window = plant, torch.as_tensor(push, dtype=torch.float64), (first, first + steps)
        self.n_u, self.n_y, self.dt = plant.n_u, plant.n_y, plant.dt
        self._step = 0

    def reset(self, *args: Any, **kwargs: Any) -> Tensor:
        """Reset the plant and the clock."""
        self._step = 0
        return self.plant.reset(*args, **kwargs)

    def step(self, u: Tensor) -> Tensor:
        """Apply u, pushed while the disturbance lasts."""
        pushed = self.window[0] <= self._step < self.window[1]
        self._step += 1
        return self.plant.step(u + self.push if pushed else u)


def scenarios(
    plant: Plant,
    layer: DPCLayer,
    *,
    resets: Mapping[str, Any],
    y_ref: Tensor,
    u_ref: Tensor | None = None,
    other_y_ref: Tensor | None = None,
    push: Any = None,
    attacks: Mapping[str, Any] | None = None,
    replan_every: int | None = None,
    steps: int = 100,
    channels: Sequence[int] | None = None,
    **run: Any,
) -> dict[str, Tensor]:
    """Return the mean error of the second half of every run, by scenario, `(runs,)` each.

    A controller that merely holds its input keeps a run that begins on its reference there. So the runs begin away from
    it, are pushed, and change reference half way.

    Args:
        plant: a plant that carries a batch.
        layer: of the controller that is judged.
        resets: arguments of the plant's reset, with a start for each run.
        y_ref, u_ref: references, `(n,)`.
        other_y_ref: what the reference becomes half way, `(n_y,)`; None leaves that scenario out.
        push: input disturbance for a tenth of the run, at a third, `(n_u,)`; None leaves it out.
        attacks: name -> layer -> attack.
        replan_every, steps, run: of the controller and :func:`torch_dpc.simulate`.
        channels: of the outputs, whose error counts; all by default.
    """
    controller = DPCController(layer, replan_every, on_failure="hold")
    half = steps // 2

    def error(on: Plant, reference: Tensor, attack: Attack | None = None) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        options = {"steps": steps, "u_ref": u_ref, "reset": resets, "attack": attack, "generator": generator, **run}
        log = simulate(on, controller, reference, **options)
        off = (log.y - log.y_ref)[..., half:, :].detach()
        off = off if channels is None else off[..., list(channels)]
        return torch.linalg.vector_norm(off, dim=-1).mean(-1).reshape(-1)

    found = {"from every start": error(plant, y_ref)}
    if push is not None:
        found["pushed"] = error(Pushed(plant, push, layer.data.t_ini + steps // 3, max(steps // 10, 1)), y_ref)
    if other_y_ref is not None:
        rows = torch.stack([y_ref] * half + [other_y_ref] * (steps - half))
        found["another reference"] = error(plant, rows)
    for name, make in (attacks or {}).items():
        found[name] = error(plant, y_ref, make(layer))
    return found


@dataclass(frozen=True, eq=False)
class Verdict:
    """The change of every scenario's error, after minus before.

    Attributes:
        before, after: mean errors, by scenario.
        change, low, high: mean change and its paired bootstrap interval, by scenario.
        runs: pairs in each.
        certified: the certified bound of |du| / |p|, before and after; None if it was not asked for.
    """

    before: dict[str, float]
    after: dict[str, float]
    change: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    runs: int
    certified: tuple[float, float] | None = None

    @property
    def worse(self) -> list[str]:
        """Scenarios in which the interval does not exclude that the error grew."""
        return [name for name, high in self.high.items() if high > SETTINGS.slack * self.before[name] + SETTINGS.floor]

    @property
    def better(self) -> list[str]:
        """Scenarios in which the whole interval lies below zero."""
        return [name for name, high in self.high.items() if high < -SETTINGS.floor]

    @property
    def dominates(self) -> bool:
        """Whether nothing is worse and something is better."""
        return not self.worse and bool(self.better)

    def __str__(self) -> str:
        """Return a table with a row a scenario."""
        lines = [f"{'scenario':24}{'before':>11}{'after':>11}{'change':>11}{'95 % interval':>24}"]
        for name in self.before:
            interval = f"{self.low[name]:.3g} to {self.high[name]:.3g}"
            numbers = (self.before[name], self.after[name], self.change[name])
            lines.append(f"{name:24}" + "".join(f"{x:11.4g}" for x in numbers) + f"{interval:>24}")
        if self.certified is not None:
            old, new = self.certified
            lines.append(f"{'certified |du| / |p|':24}{old:11.4g}{new:11.4g}{new - old:11.4g}")
        return "\n".join(lines)


def compare(before: Mapping[str, Tensor], after: Mapping[str, Tensor], *, seed: int = 0) -> Verdict:
    """Compare two controllers on the same scenarios and the same runs.

    Args:
        before, after: errors by scenario, `(runs,)`, as :func:`scenarios` returns them, runs in the same order; several
            recordings may be put one after another.
        seed: of the bootstrap.

    Raises:
        ValueError: other scenarios, or other runs.

    Example:
        >>> old = {"from every start": torch.tensor([1.0, 2.0, 3.0]), "attacked": torch.tensor([2.0, 3.0, 4.0])}
        >>> new = {"from every start": torch.tensor([1.5, 2.5, 3.5]), "attacked": torch.tensor([0.1, 0.1, 0.1])}
        >>> verdict = compare(old, new)
        >>> verdict.dominates, verdict.worse, verdict.better
        (False, ['from every start'], ['attacked'])
    """
    if set(before) != set(after) or not before:
        raise ValueError(f"`before` and `after` must hold the same scenarios, got {list(before)} and {list(after)}.")
    sizes = {len(errors) for errors in (*before.values(), *after.values())}
    if len(sizes) != 1:
        raise ValueError(f"`before` and `after` must hold the same runs in every scenario, got {sorted(sizes)}.")
    runs = check_count("runs", sizes.pop())
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randint(runs, (SETTINGS.resamples, runs), generator=generator)
    tail = (1 - SETTINGS.confidence) / 2
    old: dict[str, float] = {}
    new: dict[str, float] = {}
    changes: dict[str, float] = {}
    low: dict[str, float] = {}
    high: dict[str, float] = {}
    for name in before:
        change = (after[name] - before[name]).double()
        ends = torch.quantile(change[draws].mean(1), torch.tensor([tail, 1 - tail], dtype=torch.float64))
        old[name], new[name], changes[name] = (float(x.mean()) for x in (before[name], after[name], change))
        low[name], high[name] = ends.tolist()
    return Verdict(old, new, changes, low, high, runs)
