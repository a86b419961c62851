"""The search: Adam over the logarithms, best-so-far kept."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from ..checks import check_count, check_number, check_type
from ..layer import DPCLayer
from ..reprs import Described
from .objective import RobustObjective
from .progress import shown, silent
from .scales import WeightScales


@dataclass(frozen=True, eq=False, repr=False)
class TuningResult(Described):
    """What `tune` found.

    Attributes:
        layer: the first objective's layer with the best weights.
        scales: their logarithms, to be applied to other layers.
        history: one row an evaluation: step, nominal, attacked, total, gradient (its norm) and seconds since the start.
        best: the row of the best.
    """

    layer: DPCLayer
    scales: WeightScales
    history: list[dict[str, float]]
    best: dict[str, float]


def tune(
    objectives: RobustObjective | Sequence[RobustObjective],
    *,
    steps: int = 100,
    lr: float = 0.1,
    scales: WeightScales | None = None,
    limit: float = math.log(1e4),
    seconds: float = math.inf,
    progress: Callable[[Mapping[str, float]], None] | bool = True,
) -> TuningResult:
    """Minimise the mean of the objectives over the scales by Adam, and keep the best seen.

    Args:
        objectives: one, or several, such as one for each recording; they share the scales.
        steps: evaluations, each with its gradient.
        lr: of Adam, in units of the logarithm.
        scales: where to start; parameters that do not require a gradient stay.
        limit: how far each logarithm may move.
        seconds: no new evaluation is begun after this time.
        progress: True for a bar on a terminal (with tqdm; else lines of the logger "torch_dpc.tuning"), False for
            nothing, or what is called with the row of every evaluation.

    Raises:
        ValueError: no objectives, or a start at which the objective is not finite.
    """
    objectives = [objectives] if isinstance(objectives, RobustObjective) else objectives
    check_type("objectives", objectives, (list, tuple))
    for objective in objectives:
        check_type("objectives", objective, RobustObjective)
    if not objectives:
        raise ValueError("`objectives` must hold at least one RobustObjective, got none.")
    check_count("steps", steps)
    for name, value in (("lr", lr), ("limit", limit)):
        check_number(name, value, positive=True)
    check_number("seconds", seconds, finite=False)
    if not isinstance(progress, bool) and not callable(progress):
        raise ValueError(f"`progress` must be True, False or callable, got {progress!r}.")
    if scales is not None:
        check_type("scales", scales, WeightScales)
    scales = WeightScales(objectives[0].layer) if scales is None else scales
    free = [s for s in scales.parameters() if s.requires_grad]
    optimiser = torch.optim.Adam(free, lr=lr)
    show = progress if callable(progress) else shown(steps) if progress else silent
    began = time.perf_counter()
    history: list[dict[str, float]] = []
    best, best_state = math.inf, scales.state_dict()
    for step in range(steps):
        optimiser.zero_grad()
        values = [objective(scales) for objective in objectives]
        mean = {name: torch.stack([v[name] for v in values]).mean() for name in values[0]}
        mean["total"].backward()
        norm = torch.linalg.vector_norm(torch.cat([s.grad.reshape(-1) for s in free if s.grad is not None]))
        row = {"step": step, **{k: v.item() for k, v in mean.items()}, "gradient": norm.item()}
        history.append({**row, "seconds": time.perf_counter() - began})
        if not (math.isfinite(row["total"]) and math.isfinite(row["gradient"])):
            break  # the last good weights stand
        if row["total"] < best:
            best, best_state = row["total"], {k: v.clone() for k, v in scales.state_dict().items()}
        show(history[-1])
        if history[-1]["seconds"] > seconds:
            break
        optimiser.step()
        with torch.no_grad():
            for s in free:
                s.clamp_(-limit, limit)
    if best == math.inf:
        raise ValueError(f"the objective is not finite where it starts: {history[0]}.")
    scales.load_state_dict(best_state)
    rows = [row for row in history if row["total"] == best]
    return TuningResult(scales.apply_to(objectives[0].layer), scales, history, rows[0])
