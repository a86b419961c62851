"""Plants in processes of their own."""

from __future__ import annotations

import multiprocessing
import traceback
import weakref
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .plant import Port

#: How long a process is given to end by itself [s].
PATIENCE = 5.0


class PlantProcesses:
    """Processes that each hold some of the plants and step them one after another.

    Args:
        makers: functions without arguments that make the plants; they are pickled.
        count: of processes, at most one a plant.

    Attributes:
        sizes: (n_u, n_y, dt) of each plant.

    Raises:
        RuntimeError: a plant could not be made, with the error of its process.
    """

    def __init__(self, makers: Sequence[Any], count: int):
        # A fresh interpreter: a forked copy of torch's threads may hang.
        context = multiprocessing.get_context("spawn")
        self._shares = np.array_split(np.arange(len(makers)), min(count, len(makers)))
        self._pipes: list[Connection] = []
        self._workers = []
        for share in self._shares:
            here, there = context.Pipe()
            worker = context.Process(target=_serve, args=(there, [makers[i] for i in share]), daemon=True)
            worker.start()
            there.close()
            self._pipes.append(here)
            self._workers.append(worker)
        self._finalizer = weakref.finalize(self, _end, self._pipes, self._workers)
        self.sizes: list[tuple[int, int, float]] = [size for sizes in self._answers() for size in sizes]

    def call(self, method: str, arguments: Sequence[Any]) -> Tensor:
        """Call "start" or "step" of every plant with its argument and return the outputs, `(plants, n_y)`."""
        if not self._finalizer.alive:
            raise RuntimeError("the processes of these plants have ended; make new ones.")
        for pipe, share in zip(self._pipes, self._shares, strict=True):
            pipe.send((method, [_sent(arguments[i]) for i in share]))
        return torch.from_numpy(np.concatenate(self._answers()))

    def close(self) -> None:
        """End the processes."""
        self._finalizer()

    def __len__(self) -> int:
        return len(self._workers)

    def _answers(self) -> list[Any]:
        """Return what every process answers; an error of one of them ends all."""
        answers = []
        for pipe in self._pipes:
            try:
                answer = pipe.recv()
            except EOFError:
                answer = "the process has died."
            if isinstance(answer, str):
                self.close()
                raise RuntimeError(f"a process that holds plants failed; all were ended.\n{answer}")
            answers.append(answer)
        return answers


def _serve(pipe: Connection, makers: Sequence[Any]) -> None:
    """Make the plants, then answer calls until None arrives; an error is answered by its traceback."""
    torch.set_num_threads(1)
    try:
        ports = [Port(make()) for make in makers]
        pipe.send([(port.n_u, port.n_y, port.dt) for port in ports])
        while (call := pipe.recv()) is not None:
            method, arguments = call
            zero = torch.zeros(ports[0].n_u, dtype=torch.float64)
            outputs = [
                port.start(one or True, zero) if method == "start" else port.step(torch.from_numpy(one))
                for port, one in zip(ports, arguments, strict=True)
            ]
            pipe.send(torch.stack(outputs).detach().numpy())
    except (EOFError, KeyboardInterrupt):
        pass
    except Exception:
        pipe.send(traceback.format_exc())


def _sent(argument: Any) -> Any:
    return argument.numpy() if isinstance(argument, Tensor) else argument


def _end(pipes: list[Connection], workers: list[Any]) -> None:
    for pipe in pipes:
        try:
            pipe.send(None)
        except OSError:  # its process has ended
            pass
    for worker in workers:
        worker.join(PATIENCE)
        if worker.is_alive():
            worker.terminate()
