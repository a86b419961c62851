"""Call the compiled kernels with arguments that fit, that nearly fit, and that make no sense.

    python tests/solve/fuzz_kernels.py [calls] [path of the extension]

Run it under sanitizers (`make sanitize`): a call may raise TypeError, ValueError or BufferError, or flag samples, and
nothing else. It imports NumPy and the extension alone, which keeps it quick there.
"""

from __future__ import annotations

import importlib.util
import sys
import threading
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
#: As in torch_dpc/solve/kernels.py, which is not imported; a short proximal point method, for speed.
SETTINGS = {
    **{"hysteresis": 1e-12, "independence": 1e-5, "touching": 1e-10, "primal_dual_steps": 10},
    **{"converged": 1e-13, "good": 1e-10, "close": 1e-11, "newton_steps": 25, "halvings": 12, "rounds": 10},
    **{"patience": 5, "inner_steps": 20, "bisections": 20, "growth": 10.0, "largest_penalty": 1e7},
    **{"weakness": 1e-9, "convincing": 1e-9},
}
SIZES = (0, 1, 2, 3, 5, 16, 17, 33, 40)
COUNTS = (0, 1, 2, 7, 100)
#: What may be said of arguments.
REFUSALS = (TypeError, ValueError, BufferError, OverflowError)


def load(path: Path) -> ModuleType:
    """Return the extension at a path, without the package around it."""
    spec = importlib.util.spec_from_file_location("torch_dpc.solve._kernels", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


NAMES = ("solve_boxes", "solve_active", "adjoint", "solve_sets", "solve_held", "plan_one", "adjoint_one")


class Caller:
    """Random arguments for every entry point."""

    def __init__(self, kernels: ModuleType, seed: int):
        self.kernels, self.random = kernels, np.random.default_rng(seed)
        self.settings = kernels.settings(**SETTINGS)

    def matrix(self, count: int, n: int) -> np.ndarray:
        """G of full or low rank, sometimes not even positive."""
        lead = () if self.random.random() < 0.5 else (count,)
        Ct = self.random.standard_normal((*lead, n, self.random.choice([1, max(n // 2, 1), n + 3])))
        G = Ct @ Ct.swapaxes(-1, -2)
        return -G if self.random.random() < 0.05 else G

    def spoil(self, x: np.ndarray) -> Any:
        """Return an argument that may not fit: another shape, type, layout or value, or no array."""
        kind = self.random.integers(12)
        if kind == 0:
            return x[..., :-1].copy() if x.ndim else x
        if kind == 1:
            return x.astype(np.float32)
        if kind == 2:
            return np.asfortranarray(x)
        if kind == 3:
            return x[None]
        if kind == 4:
            return None
        if kind == 5:
            return np.array(1.0)
        if kind == 6:
            return b"bytes"
        if kind == 7 and x.dtype == np.float64 and x.size:
            x = x.copy()
            x.flat[self.random.integers(x.size)] = self.random.choice([np.nan, np.inf, -np.inf, 1e300, 0.0])
        if kind == 8:
            x = x.copy()
            x.flags.writeable = False
        if kind == 9:
            return x[:0].copy() if x.ndim else x
        if kind == 10 and x.dtype == np.int64 and x.size:
            x = x.copy()
            x.flat[self.random.integers(x.size)] = self.random.integers(-3, 60)
        return x

    def arguments(self, name: str, count: int, n: int) -> list[Any]:
        """Arguments that fit."""
        normal = self.random.standard_normal
        G, v, out = self.matrix(count, n), normal((count, n)), np.full((count, n), np.nan)
        flags, active = np.zeros(count, bool), normal((count, n)) > 0
        if name == "solve_boxes":
            shape = (count, n) if self.random.random() < 0.5 else (n,)
            width = np.abs(normal(shape)) * (self.random.random(shape) < 0.8)
            lower = normal(shape) * 0.2 - width
            return [G, v, lower, lower + 2 * width, out, np.zeros(count, np.int64), flags]
        if name == "solve_active":
            return [G, active, v, out, flags]
        if name == "solve_sets":
            return [G, v, self.sets(count, n), out, np.zeros(count, np.int64), flags]
        if name == "solve_held":
            return [G, self.sets(count, n), v, normal((count, n)), active, normal((count, n)), out, flags]
        if name in ("plan_one", "adjoint_one"):
            return self.one(name, max(n, 1))
        return [G, active, v, normal((count, n)) if self.random.random() < 0.5 else None, out, flags]

    def one(self, name: str, n: int) -> list[Any]:
        """Arguments of one sample, which fit."""
        normal, n_theta = self.random.standard_normal, int(self.random.integers(1, 20))
        G = normal((n, n + 3))
        of = (G @ G.T, normal((n, n_theta)), np.ones(n_theta), np.ones(n), np.ones(n), 1e-15, 1e-15, 1e-15)
        sets = tuple(x[0] if i < 3 and x is not None and x.ndim == 2 else x for i, x in enumerate(self.sets(1, n)))
        vector, flags = (lambda: np.full(n, np.nan)), (lambda: np.zeros(n, bool))
        if name == "plan_one":
            return [
                of,
                sets,
                self.windows(n_theta),
                np.empty(n_theta),
                vector(),
                vector(),
                flags(),
                flags(),
                np.empty(5),
            ]
        at = normal(n), normal(n), normal(n) > 0, normal(n) > 0
        return [of, sets, *at, self.windows(2 * n), np.empty(2 * n), np.empty(n_theta)]

    def windows(self, size: int) -> tuple[int, ...]:
        """Addresses, counts and sizes of parts with so many places in all; the arrays behind them are kept."""
        cuts = np.sort(self.random.integers(0, size + 1, 3))
        self.kept, found = [], []
        for width in map(int, np.diff([0, *cuts, size])):
            given = self.random.choice([k for k in range(1, width + 1) if width % k == 0]) if width else 0
            self.kept.append(self.random.standard_normal(max(given, 1)))
            found += [self.kept[-1].ctypes.data if given else 0, int(given), width]
        return tuple(found)

    def sets(self, count: int, n: int) -> tuple[Any, ...]:
        """Intervals, balls and cones on random rows."""
        rows = self.random.permutation(n)[: self.random.integers(n + 1)]
        cuts = np.flatnonzero(self.random.random(max(len(rows) - 1, 0)) < 0.4) + 1
        start = np.array([0, *cuts, len(rows)] if len(rows) else [0])
        shape = (count, n) if self.random.random() < 0.5 else (n,)
        lower = self.random.standard_normal(shape)
        upper = lower + np.abs(self.random.standard_normal(shape))
        lower[..., rows], upper[..., rows] = -np.inf, np.inf
        price = None if self.random.random() < 0.5 else self.random.random(shape) + 1e-3
        kind = self.random.integers(1, 3, len(start) - 1)
        return (
            lower,
            upper,
            price,
            kind,
            start,
            rows,
            self.random.standard_normal(len(rows)),
            self.random.random(len(kind)),
        )

    def call(self, spoils: bool) -> str:
        """Make one call; return how it ended."""
        count, n = int(self.random.choice(COUNTS)), int(self.random.choice(SIZES))
        name = str(self.random.choice(NAMES))
        arguments = self.arguments(name, count, n)
        if spoils:
            place = self.random.integers(len(arguments))
            if isinstance(arguments[place], tuple):
                parts = list(arguments[place])
                which = self.random.integers(len(parts))
                if isinstance(parts[-1], int):  # windows: other addresses or counts would read what is not there
                    parts[which // 3 * 3 + 2] = int(self.random.integers(-2, 60))
                elif isinstance(parts[which], np.ndarray):
                    parts[which] = self.spoil(parts[which])
                arguments[place] = tuple(parts)
            elif isinstance(arguments[place], np.ndarray):
                arguments[place] = self.spoil(arguments[place])
        try:
            getattr(self.kernels, name)(*arguments, self.settings, int(self.random.integers(-1, 4)))
        except REFUSALS:
            return "refused"
        return "ran"


def main(calls: int, path: Path) -> None:
    kernels = load(path)
    counts: dict[str, int] = {}

    def work(seed: int) -> None:
        caller = Caller(kernels, seed)
        for i in range(calls // 4):
            outcome = caller.call(spoils=i % 2 == 1)
            counts[f"{outcome} {seed}"] = counts.get(f"{outcome} {seed}", 0) + 1

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ran, refused = (sum(v for k, v in counts.items() if k.startswith(word)) for word in ("ran", "refused"))
    if ran + refused != 4 * (calls // 4) or not ran or not refused:
        raise SystemExit(f"fuzz: {ran} calls ran and {refused} were refused, of {calls}")
    print(f"fuzz: {ran} calls ran, {refused} were refused")


if __name__ == "__main__":
    built = sorted((ROOT / "torch_dpc" / "solve").glob("_kernels*.so"))
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000, Path(sys.argv[2]) if len(sys.argv) > 2 else built[0])
