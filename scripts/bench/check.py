"""The regression guard: ratios of times in one process, compared with stored ones.

A ratio does not depend on how busy the machine is, so the stored ones hold wherever the kernels are built.
"""

from __future__ import annotations

import json
from pathlib import Path

from scripts.bench.ratios import guarded

STORED = Path(__file__).with_name("ratios.json")
ALLOWED = 1.5  # times the stored ratio: what is left of noise on a busy machine


def check(stored: Path = STORED) -> list[str]:
    """Measure, print the ratios beside the stored ones, and return the names of those that have grown."""
    before, now = json.loads(stored.read_text()), guarded()
    grown = [name for name, ratio in now.items() if ratio > ALLOWED * before[name]]
    if grown:  # once more: a burst of other work may have met one call alone
        again = guarded()
        now = {name: min(ratio, again[name]) for name, ratio in now.items()}
        grown = [name for name in grown if now[name] > ALLOWED * before[name]]
    for name, ratio in now.items():
        verdict = f"more than {ALLOWED:g} times as much" if name in grown else "fine"
        print(f"{name}: {ratio:.2f}, stored {before[name]:.2f}: {verdict}")
    return grown
