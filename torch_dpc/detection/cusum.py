"""CUSUM: small changes that persist add up (Page 1954)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..checks import check_callable, check_number

#: Halvings of the interval that holds the threshold.
HALVINGS = 60


class Cusum:
    """S <- max(0, S + score - drift), an alarm and a new start where S > threshold.

    Args:
        score: (u_ini, y_ini) -> how unusual a window is, `(*batch,)`.
        drift: what a usual step subtracts.
        threshold: the level of alarm.
    """

    def __init__(self, score: Callable[[Tensor, Tensor], Tensor], drift: float, threshold: float):
        check_callable("score", score)
        self.score = score
        self.drift, self.threshold = check_number("drift", drift), check_number("threshold", threshold)

    @staticmethod
    def calibrated(
        score: Callable[[Tensor, Tensor], Tensor], clean: Tensor, drift: float | None, false_alarms: float
    ) -> Cusum:
        """Return a CUSUM whose rate of alarms on clean scores in their order is at most `false_alarms`.

        Args:
            score: of a window.
            clean: scores of clean windows one after another, `(n,)`.
            drift: by default the mean of the clean scores and half their standard deviation.
            false_alarms: rate of steps.
        """
        false_alarms = rate("false_alarms", false_alarms)
        drift = float(clean.mean() + 0.5 * clean.std()) if drift is None else check_number("drift", drift)
        low, high = 0.0, float((clean - drift).clamp_min(0.0).sum()) + 1e-12
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            share = float(run(clean, drift, middle).double().mean())
            low, high = (low, middle) if share <= false_alarms else (middle, high)
        return Cusum(score, drift, high)

    def monitor(self) -> Callable[[Tensor, Tensor], Tensor]:
        """Return a fresh sum that is asked for an alarm at every plan of a run, or of a batch of runs."""
        total: Tensor | None = None

        def step(u_ini: Tensor, y_ini: Tensor) -> Tensor:
            nonlocal total
            score = self.score(u_ini, y_ini)
            total = ((torch.zeros_like(score) if total is None else total) + score - self.drift).clamp_min(0.0)
            alarm = total > self.threshold
            total = torch.where(alarm, 0.0, total)
            return alarm

        return step

    def __repr__(self) -> str:
        return f"Cusum(drift={self.drift:.3g}, threshold={self.threshold:.3g})"


def rate(name: str, value: Any) -> float:
    """Return a rate between 0 and 1, both excluded.

    Raises:
        ValueError: anything else.
    """
    rule = f"`{name}` must be between 0 and 1"
    number = check_number(name, value, kind="between 0 and 1")
    if not 0 < number < 1:
        raise ValueError(f"{rule}, got {value!r}.")
    return number


def run(scores: Tensor, drift: float, threshold: float) -> Tensor:
    """Return the alarms along scores one after another, `(n,)`, boolean."""
    total, alarms = 0.0, []
    for score in scores.tolist():
        total = max(0.0, total + (score if math.isfinite(score) else threshold + drift + 1.0) - drift)
        alarms.append(total > threshold)
        total = 0.0 if alarms[-1] else total
    return torch.tensor(alarms)
