"""Bounded memory for gradients through time: keep the state at a few steps, make the steps in between again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..systems.plant import Resumable
from .controller import ControllerState
from .loop import Loop


class _Rest(NamedTuple):
    """What beside tensors decides the steps to come."""

    controller: ControllerState
    generators: list[Tensor]


def advance_with_checkpoints(
    loop: Loop, steps: int, every: int, progress: Callable[[int], None] | None
) -> tuple[Tensor, ...]:
    """Return what `loop.advance(range(steps))` returns; the graph keeps the state every `every` steps.

    Raises:
        ValueError: a plant without `snapshot` and `restore`.
    """
    plant = loop.port.plant
    if not isinstance(plant, Resumable):
        raise ValueError(
            f"`checkpoint_every` must be left out for {type(plant).__name__}, which has no `snapshot()` and "
            "`restore(...)`."
        )
    parts = []
    for first in range(0, steps, every):
        segment = _Segment(loop, plant, range(first, min(first + every, steps)))
        outputs = checkpoint(segment, *segment.tensors(), use_reentrant=False)
        parts.append(outputs[:6])
        segment.restore(outputs[6:], segment.rest())  # the tensors that the checkpoint returned carry the graph
        if progress is not None:
            progress(len(segment.steps))
    dims = (-2, -2, -3, -1, -1, -1)
    return tuple(torch.cat(part, dim) for part, dim in zip(zip(*parts, strict=True), dims, strict=True))


class _Segment:
    """Some steps as a function of the tensors at their beginning; it is called again in a backward pass."""

    def __init__(self, loop: Loop, plant: Resumable, steps: range):
        self.loop, self.plant, self.steps = loop, plant, steps
        self.beginning, self.n_plant = self.rest(), len(plant.snapshot())
        self.was_called = False

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        if self.was_called:
            with self._kept():
                return self._advance(tensors)
        self.was_called = True  # the forward pass: the loop goes on from where this ends
        return self._advance(tensors)

    def _advance(self, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        self.restore(tensors, self.beginning)
        outputs = self.loop.advance(self.steps)
        return (*outputs, *self.tensors())

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """Leave the loop as it was: a backward pass must not move the plant."""
        tensors, rest, plan = self.tensors(), self.rest(), self.loop.controller.plan
        try:
            yield
        finally:  # also if torch has all it needs and breaks the recomputation off
            self.restore(tensors, rest)
            self.loop.controller.plan = plan

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the tensors that decide the steps to come: of the plant, the loop and the plan in force."""
        loop = self.loop
        inputs = loop.controller.state.inputs
        return (
            *self.plant.snapshot(),
            loop.y,
            loop.p,
            *loop.past.us,
            *loop.past.ys,
            *(() if inputs is None else (inputs,)),
        )

    def rest(self) -> _Rest:
        """Return what else decides them."""
        return _Rest(self.loop.controller.state, [one.get_state() for one in self._generators()])

    def restore(self, tensors: Sequence[Tensor], rest: _Rest) -> None:
        """Go to where the loop had these tensors and this rest."""
        loop, t_ini = self.loop, self.loop.data.t_ini
        self.plant.restore(tuple(tensors[: self.n_plant]))
        loop.y, loop.p, *windows = tensors[self.n_plant :]
        loop.past.us.extend(windows[:t_ini])
        loop.past.ys.extend(windows[t_ini : 2 * t_ini])
        inputs = windows[2 * t_ini] if len(windows) > 2 * t_ini else None
        loop.controller.state = replace(rest.controller, inputs=inputs)
        for generator, state in zip(self._generators(), rest.generators, strict=True):
            generator.set_state(state)

    def _generators(self) -> list[torch.Generator]:
        """Return the sources of randomness of the attack and the plant."""
        found: list[torch.Generator] = []
        for source in (self.loop.generator, getattr(self.plant, "generator", None)):
            for one in source if isinstance(source, Sequence) else (source,):
                if one is not None and not any(one is other for other in found):
                    found.append(one)
        return found
