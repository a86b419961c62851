"""Progress of a search: a bar on a terminal, else lines in the log."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping

logger = logging.getLogger("torch_dpc.tuning")

#: Lines in the log of one search, where there is no bar.
LINES = 10


def silent(row: Mapping[str, float]) -> None:
    """Show nothing."""


def shown(steps: int) -> Callable[[Mapping[str, float]], None]:
    """Return what is called with every row of a search: a bar if tqdm is installed and stderr is a terminal.

    Otherwise it is a line in the log of `torch_dpc.tuning`, level INFO, every tenth of the search.
    """
    try:
        from tqdm import tqdm
    except ImportError:
        return _logged(steps)
    if not sys.stderr.isatty():
        return _logged(steps)
    bar = tqdm(total=steps, desc="tuning", unit="step")
    best = float("inf")

    def show(row: Mapping[str, float]) -> None:
        nonlocal best
        best = min(best, row["total"])
        bar.update()
        bar.set_postfix(objective=f"{row['total']:.4g}", best=f"{best:.4g}", refresh=False)
        if row["step"] == steps - 1:
            bar.close()

    return show


def _logged(steps: int) -> Callable[[Mapping[str, float]], None]:
    every = max(steps // LINES, 1)

    def show(row: Mapping[str, float]) -> None:
        if row["step"] % every == 0 or row["step"] == steps - 1:
            message = "step %d of %d: objective %.4g, without attack %.4g, attacked %.4g"
            logger.info(message, int(row["step"]) + 1, steps, row["total"], row["nominal"], row["attacked"])

    return show
