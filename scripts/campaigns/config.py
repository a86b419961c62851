"""The configuration of a campaign: a small TOML file, and the rows it asks for.

Every row has all that decides its run, and an id made of that alone: the same run has the same id in every campaign,
and a changed weight makes another row.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

PLANTS = {"masses": (4, 2), "masses_moving": (4, 2), "quadrotor": (6, 3)}  # outputs, inputs
ATTACKS = ("none", "random", "algorithm1", "projected_gradient", "frank_wolfe")
TOP = {"plants", "seeds", "rho", "attacks", "steps", "replan_every", "weights"}
WEIGHTS = {"lambda_g", "lambda_s", "Q", "R"}


@dataclass(frozen=True)
class RunConfig:
    """One run in closed loop.

    Attributes:
        plant, attack: names, of `PLANTS` and `ATTACKS`.
        weights: the name of a set of weights, for tables.
        lambda_g, lambda_s, Q, R: the weights, Q and R diagonal; None is the paper's.
        seed: of the recording, the start and the noise.
        rho: of the attack's budget; 0 without one.
        steps, replan_every: of the run; None is the paper's.
    """

    plant: str
    weights: str
    seed: int
    attack: str
    rho: float
    steps: int | None = None
    replan_every: int | None = None
    lambda_g: float | None = None
    lambda_s: float | None = None
    Q: tuple[float, ...] | None = None
    R: tuple[float, ...] | None = None

    @property
    def id(self) -> str:
        """A hash of everything that decides the run; the name of the weights does not."""
        decides = {name: value for name, value in asdict(self).items() if name != "weights"}
        return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:20]


def load(path: Path) -> list[RunConfig]:
    """Return the rows of a campaign, in the order of the file.

    Raises:
        ValueError: what is wrong, by name.
    """
    with path.open("rb") as file:
        table = tomllib.load(file)
    unknown = set(table) - TOP
    if unknown:
        raise ValueError(f"{path}: unknown {_names(unknown)}; there are {_names(TOP)}.")
    plants = _chosen(path, table, "plants", tuple(PLANTS))
    attacks = _chosen(path, table, "attacks", ATTACKS)
    seeds, rhos = _seeds(path, table.get("seeds")), [float(rho) for rho in table.get("rho", [])]
    if any(rho <= 0 for rho in rhos) or (not rhos and set(attacks) != {"none"}):
        raise ValueError(f"{path}: `rho` must list positive numbers, got {table.get('rho')!r}.")
    options: dict[str, Any] = {name: _count(path, table, name) for name in ("steps", "replan_every")}
    configs = []
    for plant in plants:
        for name, weights in table.get("weights", {"paper": {}}).items():
            values = _weights(path, name, weights, plant)
            for seed in seeds:
                for attack in attacks:
                    for rho in [0.0] if attack == "none" else rhos:
                        configs.append(RunConfig(plant, name, seed, attack, rho, **options, **values))
    if len({config.id for config in configs}) < len(configs):
        raise ValueError(f"{path}: two rows are the same run; `seeds`, `rho` and weights must be different.")
    return configs


def _chosen(path: Path, table: dict[str, Any], name: str, known: tuple[str, ...]) -> list[str]:
    chosen = table.get(name)
    if not isinstance(chosen, list) or not chosen or not set(map(str, chosen)) <= set(known):
        raise ValueError(f"{path}: `{name}` must list some of {_names(known)}, got {chosen!r}.")
    return chosen


def _seeds(path: Path, seeds: Any) -> list[int]:
    if isinstance(seeds, dict) and set(seeds) == {"first", "count"}:
        return list(range(seeds["first"], seeds["first"] + seeds["count"]))
    if isinstance(seeds, list) and seeds and all(isinstance(seed, int) for seed in seeds):
        return seeds
    raise ValueError(f"{path}: `seeds` must be a list of integers or {{first = ..., count = ...}}, got {seeds!r}.")


def _count(path: Path, table: dict[str, Any], name: str) -> int | None:
    value = table.get(name)
    if value is not None and (not isinstance(value, int) or value < 1):
        raise ValueError(f"{path}: `{name}` must be a positive integer, got {value!r}.")
    return value


def _weights(path: Path, name: str, table: Any, plant: str) -> dict[str, Any]:
    """Return one set of weights for a plant: [weights.NAME], overridden by [weights.NAME.PLANT]."""
    if not isinstance(table, dict) or set(table) - WEIGHTS - set(PLANTS):
        raise ValueError(f"{path}: [weights.{name}] must hold {_names(WEIGHTS)} or tables for plants, got {table!r}.")
    values = {k: v for k, v in table.items() if k in WEIGHTS} | table.get(plant, {})
    for matrix, size in zip("QR", PLANTS[plant], strict=True):
        if matrix in values:
            if len(values[matrix]) != size:
                raise ValueError(
                    f"{path}: [weights.{name}] `{matrix}` must hold the {size} diagonal entries of the {plant}, "
                    f"got {values[matrix]!r}."
                )
            values[matrix] = tuple(map(float, values[matrix]))
    return {k: float(v) if k.startswith("lambda") else v for k, v in values.items()}


def _names(names: Any) -> str:
    return ", ".join(f"`{name}`" for name in sorted(names))
