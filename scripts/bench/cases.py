"""The problems of the benchmark, and which solver meets which of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.bench.higher_precision import HigherPrecision
from scripts.experiments.case import Case
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared.rows import Array

SEED = 0
CASES: dict[str, Case] = {"masses": Masses(), "quadrotor": Quadrotor()}
T_INI, N_G = CASES["masses"].t_ini, CASES["masses"].n_g  # both plants'
HORIZONS, BATCHES = (25, 50, 100), (1, 64, 1024)
SCALING_N_G = (500, 5_000, 50_000)
MOST = max(BATCHES)  # inputs of each problem; a batch takes the first ones
CYCLE = 16  # a batch of one takes these in turn, so that no solver meets the problem it has just solved
CHECKED = 4  # of the cycle, the first ones whose active set is strict: errors are measured there

LOOP = "DAQP loop"
OURS = {"torch_dpc": "auto", "torch_dpc newton": "newton", "torch_dpc daqp": "daqp"}
FASTEST = ("cvxpylayers MOREAU (reduced)", "QPLayer (reduced)", "qpth (reduced)")

PERTURBATION = {"masses": 0.02, "quadrotor": 0.003}  # of y_ini, relative to its norm


@dataclass(frozen=True)
class Row:
    """One solver on one problem.

    Attributes:
        name: one of `OURS`, `LOOP`, or a key of `baselines.PEERS`.
        plant: "masses" or "quadrotor".
        horizon, n_g, batch: sizes.
        scaling: time the call beside one on n_g = `N_G` recorded windows, turn by turn.
    """

    name: str
    plant: str = "masses"
    horizon: int = 25
    n_g: int = N_G
    batch: int = 1
    scaling: bool = False

    @property
    def problem(self) -> tuple[str, int, int]:
        """Plant, horizon and the windows of the data that the inputs come from."""
        return self.plant, self.horizon, N_G if self.scaling else self.n_g


def quick_rows() -> Iterator[Row]:
    """Yield the rows of `--quick`, the masses at horizon 25."""
    yield from (Row(name, batch=batch) for name in ("torch_dpc", LOOP) for batch in BATCHES)
    yield from (Row(name, batch=batch) for name in FASTEST for batch in (1, 64))
    yield Row("cvxpylayers DIFFCP Clarabel lsqr (paper)")


def scaling_rows() -> Iterator[Row]:
    """Yield the rows that let n_g grow."""
    yield from (Row("torch_dpc", n_g=n_g, scaling=True) for n_g in SCALING_N_G)


def full_rows(peers: dict[str, Any]) -> Iterator[Row]:
    """Yield every row that makes sense.

    The layer, the loop and the fastest peers meet everything. The other differentiable peers take the reduced form at
    horizon 25 up to batch 64; the layer's engines one by one, at horizon 25. Forward-only solvers take one problem
    after the other, so batch 1 says all; the paper's formulation, slow throughout, is given at batch 1 as well.
    """
    yield from scaling_rows()
    rest = [name for name in peers if name not in FASTEST]
    for plant in ("masses", "quadrotor"):
        for horizon in HORIZONS:
            for batch in BATCHES:
                for name in ("torch_dpc", LOOP, *FASTEST):
                    yield Row(name, plant, horizon, batch=batch)
        yield from (Row(name, plant, batch=batch) for name in list(OURS)[1:] for batch in BATCHES)
        for name in rest:
            can_batch = peers[name].formulation == "reduced" and peers[name].kind == "differentiable"
            yield from (Row(name, plant, batch=batch) for batch in BATCHES[: 2 if can_batch else 1])


# --- problems --------------------------------------------------------------------------------------------------------


def record(plant: str, samples: int) -> tuple[Tensor, Tensor]:
    """Return the recorded inputs and outputs, `(samples, n_u)` and `(samples, n_y)`."""
    case = CASES[plant]
    with case.system() as system:
        return case.record(system, SEED, samples)


def layer_of(plant: str, u: Tensor, y: Tensor, horizon: int, solver: str = "auto") -> dpc.DPCLayer:
    """Return the paper's planning problem on a recording."""
    case = replace(CASES[plant], horizon=horizon)
    return case.layer(case.hankel(u, y), solver=solver)


def inputs_of(plant: str, layer: dpc.DPCLayer, u: Tensor, y: Tensor, count: int = MOST) -> dict[str, Tensor]:
    """Return the measurements and references of `count` problems that have a solution.

    The measurements are windows of the recording, y_ini perturbed by `PERTURBATION` in a random direction.
    """
    generator = torch.Generator().manual_seed(SEED + 1)
    draw = 2 * count
    start = torch.randint(len(u) - T_INI, (draw,), generator=generator)
    window = start[:, None] + torch.arange(T_INI)
    u_ini, y_ini = u[window], y[window]
    direction = torch.randn(y_ini.shape, generator=generator, dtype=y.dtype)
    size = PERTURBATION[plant] * y_ini.flatten(1).norm(dim=1) / direction.flatten(1).norm(dim=1)
    y_ini = y_ini + size[:, None, None] * direction
    case = CASES[plant]
    if isinstance(case, Quadrotor):
        phase = torch.rand(draw, 1, generator=generator, dtype=y.dtype)
        angle = 2 * math.pi * (phase + case.dt / case.period * torch.arange(layer.data.horizon))
        references = {"y_ref": case.around(angle)}
    else:
        y_ref, u_ref = case.references(1)
        assert u_ref is not None
        references = {"y_ref": y_ref[0], "u_ref": u_ref[0]}
    inputs = {"u_ini": u_ini, "y_ini": y_ini, **references}
    solved = (layer(**inputs, on_failure="nan").info.status == dpc.Status.SOLVED).nonzero()[:count, 0]
    if len(solved) < count:
        raise RuntimeError(f"{len(solved)} of {draw} problems have a solution, {count} are needed.")
    return {name: value[solved] if value.ndim == 3 else value for name, value in inputs.items()}


def take(inputs: dict[str, Tensor], samples: int | slice) -> dict[str, Tensor]:
    """Return some of the problems; an index gives an unbatched one."""
    return {name: value[samples] if value.ndim == 3 else value for name, value in inputs.items()}


def write_case(path: Path, plant: str, horizon: int, n_g: int, count: int = MOST) -> None:
    """Write a problem: the recording, the inputs, and the reference of the samples that are checked."""
    u, y = record(plant, n_g + T_INI + horizon - 1)
    layer = layer_of(plant, u, y, horizon)
    inputs = inputs_of(plant, layer, u, y, count)
    exact, checked, found = HigherPrecision(layer), [], []
    for i in range(min(CYCLE, count)):
        sample = take(inputs, i)
        arrays = {name: value.numpy() for name, value in sample.items()}
        reference = exact.solve(layer(**sample).lam.numpy(), **{"u_ref": np.zeros(layer.data.n_u), **arrays})
        if reference is not None:
            checked.append(i)
            found.append(reference)
        if len(found) == CHECKED:
            break
    saved: dict[str, Any] = {f"input_{name}": value.numpy() for name, value in inputs.items()}
    saved |= {
        "checked": np.array(checked, dtype=int),
        "v": np.array([f.v for f in found]),
        "gradient": np.array([f.gradient for f in found]),
        "error": np.array([f.error for f in found]),
    }
    np.savez(path, recorded_u=u, recorded_y=y, **saved)


def read_case(path: Path) -> tuple[tuple[Tensor, Tensor], dict[str, Tensor], dict[str, Array]]:
    """Return recording, inputs and references of `write_case`."""
    with np.load(path) as file:
        inputs = {name[6:]: torch.from_numpy(file[name]) for name in file if name.startswith("input_")}
        recording = torch.from_numpy(file["recorded_u"]), torch.from_numpy(file["recorded_y"])
        return recording, inputs, {name: file[name] for name in ("checked", "v", "gradient", "error")}
