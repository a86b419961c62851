"""Any plants side by side, as one plant with a batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, check_count
from .plant import Plant, Port
from .workers import PlantProcesses


class Many:
    """Plants that carry no batch themselves, side by side: hardware, PyBullet, NumPy, one run each.

    The outputs are `(len(plants), n_y)`, so that a controller plans for all plants in one call. The plants may differ,
    in their parameters for instance, but not in `n_u`, `n_y` and `dt`.

    Args:
        plants: one for each run. With `processes`, functions without arguments that make them, each called in its
            process; a class will do, or a `functools.partial`.
        processes: step the plants in so many processes. This pays where cores are idle and a step takes much longer
            than 0.1 ms, the time of a message to a process and back.

    Attributes:
        plants: the plants; empty with `processes`.

    Raises:
        ValueError: no plants, or sizes that differ.

    Example:
        >>> from torch_dpc.systems import OscillatingMasses
        >>> plant = Many([OscillatingMasses(damping=d) for d in (0.0, 0.1, 0.2)])
        >>> plant.reset(state=torch.ones(4)).shape
        torch.Size([3, 4])
    """

    def __init__(self, plants: Sequence[Plant | Callable[[], Plant]], *, processes: int = 0):
        if not isinstance(plants, Sequence) or not plants:
            raise ValueError(f"`plants` must be a list of one plant or more, got {plants!r}.")
        self._processes: PlantProcesses | None = None
        self.plants: list[Plant] = []
        if processes:
            self._processes = PlantProcesses(plants, check_count("processes", processes))
            sizes = self._processes.sizes
        else:
            self.plants = [_plant(i, plant) for i, plant in enumerate(plants)]
            self._ports = [Port(plant) for plant in self.plants]
            sizes = [(port.n_u, port.n_y, port.dt) for port in self._ports]
        if len(set(sizes)) > 1:
            raise ValueError(f"the plants must be alike in (n_u, n_y, dt), got {sorted(set(sizes))}.")
        self.n_u, self.n_y, self.dt = sizes[0]
        self._count = len(plants)

    def reset(
        self, *, batch: Sequence[int] | None = None, each: Sequence[Mapping[str, Any]] | None = None, **shared: Any
    ) -> Tensor:
        """Reset every plant and return the first measurements, `(len(plants), n_y)`.

        Args:
            batch: the number of plants, if given.
            each: arguments of the reset, one mapping a plant.
            **shared: arguments of the reset of every plant.

        Raises:
            ValueError: another number of plants.
        """
        if batch is not None and tuple(batch) != (self._count,):
            raise ValueError(f"`batch` must be ({self._count},), the number of plants, or be left out, got {batch!r}.")
        if each is not None and len(each) != self._count:
            raise ValueError(f"`each` must hold one mapping a plant, {self._count}, got {len(each)}.")
        arguments = [{**shared, **one} for one in (each or [{}] * self._count)]
        if self._processes is not None:
            return self._processes.call("start", arguments)
        return torch.stack(
            [port.start(one or True, torch.zeros(self.n_u)) for port, one in zip(self._ports, arguments, strict=True)]
        )

    def step(self, u: Any) -> Tensor:
        """Apply u, `(len(plants), n_u)`, for one step and return the measurements after it, `(len(plants), n_y)`."""
        u = as_data("u", u).double()
        if u.shape != (self._count, self.n_u):
            raise ValueError(f"`u` must have shape {(self._count, self.n_u)}, got {tuple(u.shape)}.")
        if self._processes is not None:
            return self._processes.call("step", list(u.detach()))
        return torch.stack([port.step(one) for port, one in zip(self._ports, u, strict=True)])

    def close(self) -> None:
        """End the processes, or close the plants that have a `close`."""
        if self._processes is not None:
            self._processes.close()
        for plant in self.plants:
            if hasattr(plant, "close"):
                plant.close()

    def __len__(self) -> int:
        return self._count

    def __enter__(self) -> Many:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        kinds = sorted({type(plant).__name__ for plant in self.plants})
        where = f" in {len(self._processes)} processes" if self._processes is not None else f" of {', '.join(kinds)}"
        return f"Many({self._count} plants{where}, n_u={self.n_u}, n_y={self.n_y}, dt={self.dt:g} s)"


def _plant(i: int, plant: Any) -> Plant:
    if isinstance(plant, type) or not hasattr(plant, "step"):
        raise ValueError(f"`plants[{i}]` must be a plant, got {plant!r}; functions that make one need `processes`.")
    checked: Plant = plant
    return checked
