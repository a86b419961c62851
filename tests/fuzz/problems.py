"""Random problems by stream and index, in NumPy alone: recordings, weights, sets, terms and samples."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.oracles.extended import Array
from tests.oracles.problem import Sample

STREAMS = {"any": 15_001, "sensible": 15_002}  # seeds; another number is a held-out stream

Spec = tuple[Any, ...]  # ("box", lower, upper), ("soft", lower, upper, price), ("ball", radius, center, per), ("cone",
#                         per), ("nonnegative",), ("product", [(spec, channels), ...])


@dataclass(frozen=True)
class Case:
    """A problem with its samples, as a user would state it."""

    stream: str
    index: int
    recordings: list[tuple[Array, Array]]  # (T, n_u), (T, n_y)
    t_ini: int
    horizon: int
    weights: dict[str, Any]  # Q, R, lambda_g, lambda_s and the terms of the layer
    sets: dict[str, Spec]  # u_set, y_set, du_set
    samples: list[Sample]
    traits: dict[str, Any] = field(default_factory=dict)  # what kind of problem it is, for the table

    @property
    def n_u(self) -> int:
        return self.recordings[0][0].shape[1]

    @property
    def n_y(self) -> int:
        return self.recordings[0][1].shape[1]


class _Draw:
    """A generator with the distributions of this file."""

    def __init__(self, seed: list[int]):
        self.rng = np.random.default_rng(seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rng, name)

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def log(self, low: float, high: float, size: Any = None) -> Any:
        """Return 10^x, x uniform."""
        return 10.0 ** self.rng.uniform(low, high, size)

    def pick(self, options: dict[str, float]) -> str:
        names, shares = list(options), np.array(list(options.values()))
        return str(self.rng.choice(names, p=shares / shares.sum()))


def make(stream: str, index: int) -> Case:
    """Return case `index` of a stream; a stream of a number is seeded by it and made like "any"."""
    seed = STREAMS[stream] if stream in STREAMS else int(stream)
    draw = _Draw([seed, index])
    sensible = stream == "sensible"
    n_u, n_y = int(draw.integers(1, 5)), int(draw.integers(1, 7))
    t_ini, horizon = int(draw.integers(1, 5)), int(draw.integers(2, 8))
    recordings, histories, noise, flaws = _recordings(draw, n_u, n_y, t_ini, horizon, sensible)
    kind = "none" if sensible else draw.pick({"none": 0.55, "one for all": 0.2, "per channel": 0.25})
    unit_u, unit_y = _units(draw, kind, n_u, n_y)
    size_u = _size([u for u, _ in recordings])
    size_y = _size([y for _, y in recordings])
    weights = _weights(draw, n_u, n_y, horizon, unit_u, unit_y, sensible)
    sets = _sets(draw, n_u, n_y, horizon, size_u, size_y, unit_u, unit_y, "lambda_u" in weights, sensible)
    samples = [_sample(draw, h, size_y, horizon, t_ini, noise, sensible) for h in histories]
    samples = [Sample(s.u_ini * unit_u, s.y_ini * unit_y, s.u_ref * unit_u, s.y_ref * unit_y) for s in samples]
    recordings = [(u * unit_u, y * unit_y) for u, y in recordings]
    traits = {"units": kind, "noise": noise, "flaws": flaws, "sets": {k: _name(v) for k, v in sets.items()}}
    return Case(stream, index, recordings, t_ini, horizon, weights, sets, samples, traits)


def _name(spec: Spec) -> str:
    if spec[0] == "product":
        return "product of " + ", ".join(sorted({_name(part) for part, _ in spec[1]}))
    return spec[0] + (" per trajectory" if isinstance(spec[-1], str) and spec[-1] == "trajectory" else "")


def _size(parts: list[Array]) -> Array:
    size = np.abs(np.concatenate(parts)).max(0)
    return np.where(size > 0, size, 1.0)


# --- recordings -------------------------------------------------------------------------------------------------------


def _recordings(draw: _Draw, n_u: int, n_y: int, t_ini: int, horizon: int, sensible: bool):
    """Return recordings, the true past windows of the samples, the noise, and the flaws, channels of size near 1."""
    n_x = int(draw.integers(1, 7))
    A = draw.normal(size=(n_x, n_x))
    A *= draw.uniform(0.3, 1.0) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
    B, C = draw.normal(size=(n_x, n_u)), draw.normal(size=(n_y, n_x))
    D = draw.normal(size=(n_y, n_u)) * draw.chance(0.2)
    C, D = C / 2, D / 2
    noise = 0.0 if draw.chance(0.4) else float(draw.log(-6, -2))
    flaws = []
    if not sensible:
        flaws = [name for name, p in (("idle input", 0.06), ("doubled input", 0.06), ("doubled output", 0.08),
                                      ("dead output", 0.04), ("few windows", 0.1)) if draw.chance(p)]  # fmt: skip
    window = t_ini + horizon
    enough = (n_u * window + n_x) * (2 if draw.chance(0.5) else 1) + int(draw.integers(0, 40))
    columns = int(draw.integers(1, max(2, n_u * window))) if "few windows" in flaws else enough
    pieces = int(draw.integers(1, 4))
    counts = [max(1, columns // pieces) for _ in range(pieces)]
    idle, twin_u = int(draw.integers(n_u)), draw.permutation(n_u)[:2]
    dead, twin_y = int(draw.integers(n_y)), draw.permutation(n_y)[:2]

    def run(length: int, x: Array):
        u = draw.uniform(-1, 1, size=(length, n_u))
        if "idle input" in flaws:
            u[:, idle] = 0
        if "doubled input" in flaws and n_u > 1:
            u[:, twin_u[1]] = u[:, twin_u[0]]
        y = np.zeros((length, n_y))
        for k in range(length):
            y[k] = C @ x + D @ u[k]
            x = A @ x + B @ u[k]
        y += noise * draw.normal(size=y.shape)
        if "dead output" in flaws:
            y[:, dead] = 0
        if "doubled output" in flaws and n_y > 1:
            y[:, twin_y[1]] = y[:, twin_y[0]]
        return u, y

    recordings = [run(window - 1 + c, draw.normal(size=n_x)) for c in counts]
    n_samples = int(draw.choice([1, 2, 2, 2, 3]))
    histories = []
    for _ in range(n_samples):
        u, y = run(t_ini + horizon + 3, draw.normal(size=n_x) * draw.log(-1, 0.3))
        histories.append((u[3:], y[3:]))
    return recordings, histories, noise, flaws


def _units(draw: _Draw, kind: str, n_u: int, n_y: int) -> tuple[Array, Array]:
    if kind == "one for all":
        one = draw.log(-6, 6)
        return np.full(n_u, one), np.full(n_y, one)
    if kind == "per channel":
        return draw.log(-6, 6, n_u), draw.log(-6, 6, n_y)
    return np.ones(n_u), np.ones(n_y)


def _sample(draw: _Draw, history, size_y, horizon: int, t_ini: int, noise: float, sensible: bool) -> Sample:
    u, y = history
    kind = "consistent" if sensible else draw.pick({"consistent": 0.75, "random": 0.1, "zero": 0.1, "off": 0.05})
    u_ini, y_ini = u[:t_ini].copy(), y[:t_ini].copy()
    if kind == "random":
        u_ini, y_ini = draw.uniform(-1, 1, u_ini.shape), size_y * draw.normal(size=y_ini.shape)
    elif kind == "zero":
        u_ini, y_ini = 0 * u_ini, 0 * y_ini
    elif kind == "off":
        y_ini = y_ini + 0.1 * size_y * draw.normal(size=y_ini.shape)
    target = draw.pick({"zero": 0.25, "constant": 0.4, "trajectory": 0.15, "reachable": 0.2})
    n_u, n_y = u.shape[1], y.shape[1]
    u_ref, y_ref = np.zeros((horizon, n_u)), np.zeros((horizon, n_y))
    if target == "constant":
        y_ref += size_y * draw.normal(size=n_y) * draw.log(-1, 0.5)
        u_ref += draw.normal(size=n_u) * draw.chance(0.3)
    elif target == "trajectory":
        y_ref, u_ref = size_y * draw.normal(size=(horizon, n_y)), 0.5 * draw.normal(size=(horizon, n_u))
    elif target == "reachable":
        u_ref, y_ref = u[t_ini : t_ini + horizon].copy(), y[t_ini : t_ini + horizon].copy()
    return Sample(u_ini, y_ini, u_ref, y_ref)


# --- weights ----------------------------------------------------------------------------------------------------------


def _weights(draw: _Draw, n_u: int, n_y: int, horizon: int, unit_u, unit_y, sensible: bool) -> dict[str, Any]:
    matched = sensible or draw.chance(0.7)  # the user has weighted in the units of the data
    per_u, per_y = (1 / unit_u, 1 / unit_y) if matched else (np.ones(n_u), np.ones(n_y))
    all_y = np.exp(np.log(per_y).mean())
    all_u = np.exp(np.log(per_u).mean())
    weights = {
        "Q": _weight(draw, n_y, horizon, per_y, sensible, may_vanish=True),
        "R": _weight(draw, n_u, horizon, per_u, sensible, may_vanish=True),
        "lambda_g": float(draw.log(-1, 3) if sensible else draw.log(-4, 6)),
        "lambda_s": float((draw.log(2, 6) if sensible else draw.log(-2, 8)) * all_y**2),
    }
    if not sensible and draw.chance(0.05):
        weights["lambda_g"] = 0.0
    if draw.chance(0.15):
        weights["R_du"] = _weight(draw, n_u, horizon, per_u, sensible, may_vanish=False)
    elif draw.chance(0.14):  # changes of the input count from an exact u_ini
        weights["lambda_u"] = float((draw.log(2, 6) if sensible else draw.log(-2, 8)) * all_u**2)
    if draw.chance(0.15):
        weights["regularizer"] = "identity"
    if draw.chance(0.1 if not sensible else 0.05):
        weights["terminal_steps"] = int(draw.integers(1, 3)) if horizon > 2 else 1
    return weights


def _weight(draw: _Draw, n: int, horizon: int, per: Array, sensible: bool, may_vanish: bool) -> Array:
    """Return a weight `(n, n)` or `(horizon n, horizon n)`, in the units of the data."""
    low, high = (-1, 2) if sensible else (-5, 5)
    level = draw.log(low, high)
    spread = draw.log(-0.5, 0.5, n) if sensible or draw.chance(0.6) else draw.log(low, high, n) / level
    diagonal = level * spread
    if may_vanish and not sensible:
        if draw.chance(0.12):
            return np.zeros((n, n))
        if draw.chance(0.15):
            diagonal = diagonal * (draw.uniform(size=n) < 0.6)
    if draw.chance(0.15):  # coupled channels
        F = np.eye(n) + 0.4 * draw.normal(size=(n, n))
        W = F.T @ np.diag(diagonal) @ F if sensible else np.sqrt(np.outer(diagonal, diagonal)) * _correlation(draw, n)
        W = W * np.outer(per, per)
        return (W + W.T) / 2
    W = np.diag(diagonal * per**2)
    if draw.chance(0.1):  # one weight for each step
        return np.kron(np.diag(draw.log(-1, 1, horizon)), W)
    return W


def _correlation(draw: _Draw, n: int) -> Array:
    F = draw.normal(size=(n, n + 2))
    C = F @ F.T
    size = np.sqrt(np.diagonal(C))
    return C / np.outer(size, size)


# --- sets -------------------------------------------------------------------------------------------------------------


def _sets(draw: _Draw, n_u, n_y, horizon, size_u, size_y, unit_u, unit_y, open_ini: bool, sensible: bool):
    sets: dict[str, Spec] = {}
    shares = {"none": 0.2, "box": 0.4, "soft": 0.08, "ball": 0.12, "cone": 0.06, "nonnegative": 0.04, "product": 0.1}
    u = _set(draw, draw.pick(shares), n_u, horizon, size_u, unit_u, -0.7, 0.2, sensible)
    y = _set(draw, draw.pick({**shares, "none": 0.35, "soft": 0.15, "nonnegative": 0.02}), n_y, horizon, size_y, unit_y,
             -0.2 if sensible else -0.7, 0.7, sensible)  # fmt: skip
    kinds = {"none": 0.8, "box": 0.14, "soft": 0.02, "ball": 0.04}
    if open_ini:
        kinds = {"none": 1.0}
    du = _set(draw, draw.pick(kinds), n_u, horizon, size_u, unit_u, -0.7, 0.3, sensible)
    for name, spec in (("u_set", u), ("y_set", y), ("du_set", du)):
        if spec is not None:
            sets[name] = spec
    return sets


def _set(draw: _Draw, kind: str, n, horizon, size, unit, low, high, sensible: bool) -> Spec | None:
    """Return a set of about 10^low to 10^high times the size of the recorded values."""
    if kind == "none":
        return None
    if kind in ("cone", "product") and n == 1:
        kind = "box"
    if kind in ("box", "soft"):
        return _box(draw, kind, n, horizon, size, unit, low, high, sensible)
    if kind == "nonnegative":
        return ("nonnegative",)
    per = "trajectory" if draw.chance(0.25) else "step"
    if kind == "ball":
        extent = float(np.sqrt((size**2).sum() * (horizon if per == "trajectory" else 1)))
        # one radius holds channels of unlike units: the largest decides
        radius = extent * float((size * unit).max() / size.max()) * draw.log(low, high)
        center = 0.0 if draw.chance(0.8) else 0.2 * size * unit * draw.normal(size=n)
        return ("ball", float(radius), center, per)
    if kind == "cone":
        return ("cone", "step" if draw.chance(0.8) else per)
    cut = int(draw.integers(1, n))
    channels = draw.permutation(n)
    parts = []
    for chosen in (np.sort(channels[:cut]), np.sort(channels[cut:])):
        inner = draw.pick({"box": 0.5, "soft": 0.1, "ball": 0.3, "nonnegative": 0.1})
        spec = _set(draw, inner, len(chosen), horizon, size[chosen], unit[chosen], low, high, sensible)
        parts.append((spec, [int(c) for c in chosen]))
    return ("product", parts)


def _box(draw: _Draw, kind: str, n, horizon, size, unit, low, high, sensible: bool) -> Spec:
    half = size * draw.log(low, high, n)
    middle = 0.2 * half * draw.normal(size=n) if draw.chance(0.3) else np.zeros(n)
    lower, upper = (middle - half) * unit, (middle + half) * unit
    if draw.chance(0.15):
        lower = np.where(draw.uniform(size=n) < 0.5, -np.inf, lower)
    elif not sensible and draw.chance(0.04):
        upper = np.where(draw.uniform(size=n) < 0.3, lower, upper)  # held
    if draw.chance(0.15):  # one box for each step
        widen = draw.uniform(0.5, 1.5, size=(horizon, 1))
        lower, upper = lower * widen, upper * widen
        lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
    if kind == "box":
        return ("box", lower, upper)
    price = (draw.log(-1, 4) if sensible else draw.log(-3, 6)) / unit
    return ("soft", lower, upper, price)
