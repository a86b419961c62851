"""Train a network in stages: checkpoints without pickle, and the same result on one process as on several.

A run that was killed goes on from its last checkpoint and ends with the same weights as one that was not: what an
iteration draws depends on its number alone. Started by `torchrun`, each process takes its share of every batch, and the
gradients are added up, so the weights are those of one process to rounding.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from tqdm import tqdm

try:
    from safetensors import safe_open
    from safetensors.torch import save_file
except ImportError as error:
    raise ImportError("checkpoints need safetensors: pip install '.[scripts]'") from error

#: (iteration, the rows of the batch that are this process's) -> the sum over those rows, over the size of the batch.
Loss = Callable[[int, slice], Tensor]


@dataclass(frozen=True)
class Stage:
    """A part of the training with a loss of its own.

    Attributes:
        name: of the stage, in the curve.
        loss: of one iteration.
        iterations: how many.
        rate: of the first step of Adam; it falls to zero along a half cosine.
        largest: norm beyond which a gradient is cut.
        every: iterations between two records.
    """

    name: str
    loss: Loss
    iterations: int
    rate: float
    largest: float = math.inf
    every: int = 50


@dataclass
class Progress:
    """Where the training is.

    Attributes:
        stage: number of the stage.
        iteration: how many of its iterations are done.
        curve: (stage, iteration, loss, validation) of every record, `(records, 4)`.
    """

    stage: int = 0
    iteration: int = 0
    curve: Tensor = torch.zeros(0, 4, dtype=torch.float64)


def train(
    policy: nn.Module,
    stages: Sequence[Stage],
    checkpoint: Path,
    *,
    settings: dict[str, Any],
    validate: Callable[[], float] = lambda: math.nan,
    label: str = "training",
) -> Tensor:
    """Train in place, from the checkpoint if there is one, and return the curve, `Progress.curve`.

    Args:
        policy: its trainable parameters learn.
        stages: one after the other, each with a new optimiser.
        checkpoint: written at every record.
        settings: a checkpoint made with others is refused.
        validate: measured at every record.
        label: of the progress bar.

    Raises:
        ValueError: the checkpoint was made with other settings.
    """
    settings = {**settings, "stages": [[s.name, s.iterations, s.rate] for s in stages]}
    progress, moments = restore(checkpoint, policy, settings)
    done = sum(stage.iterations for stage in stages[: progress.stage]) + progress.iteration
    bar = tqdm(total=sum(stage.iterations for stage in stages), initial=done, desc=label, disable=rank() > 0)
    while progress.stage < len(stages):
        stage = stages[progress.stage]
        optimizer = torch.optim.Adam(policy.parameters(), lr=stage.rate)
        if moments:
            groups = optimizer.state_dict()["param_groups"]
            optimizer.load_state_dict({"state": moments, "param_groups": groups})
            moments = {}
        while progress.iteration < stage.iterations:
            optimizer.param_groups[0]["lr"] = (
                stage.rate * (1 + math.cos(math.pi * progress.iteration / stage.iterations)) / 2
            )
            loss = step(policy, optimizer, stage, progress.iteration)
            progress.iteration += 1
            bar.update()
            if progress.iteration % stage.every == 0 or progress.iteration == stage.iterations:
                record = [progress.stage, progress.iteration, loss, validate()]
                bar.set_postfix_str(f"{stage.name}: {record[3]:.3f}")
                progress.curve = torch.cat([progress.curve, torch.tensor([record], dtype=torch.float64)])
                save(checkpoint, policy, optimizer, progress, settings)
        progress.stage, progress.iteration = progress.stage + 1, 0
    bar.close()
    return progress.curve


def step(policy: nn.Module, optimizer: torch.optim.Optimizer, stage: Stage, iteration: int) -> float:
    """Make one step of the optimiser, on the whole batch whatever the number of processes; return the loss."""
    optimizer.zero_grad()
    loss = stage.loss(iteration, slice(rank(), None, world()))
    loss.backward()
    loss = loss.detach()
    if world() > 1:
        loss = sum_over_processes(policy, loss)
    nn.utils.clip_grad_norm_(policy.parameters(), stage.largest)
    optimizer.step()
    return float(loss)


# --- several processes -----------------------------------------------------------------------------------------------


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that `torchrun` started; alone, do nothing."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    dist.init_process_group("gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def rank() -> int:
    """Return the number of this process, 0 if it is alone."""
    return dist.get_rank() if dist.is_initialized() else 0


def world() -> int:
    """Return how many processes share the batch."""
    return dist.get_world_size() if dist.is_initialized() else 1


def sum_over_processes(policy: nn.Module, loss: Tensor) -> Tensor:
    """Add up the gradients of all processes, in place, and return the sum of the losses."""
    gradients = [p.grad for p in policy.parameters() if p.grad is not None]
    flat = torch.cat([loss.reshape(1), *(g.reshape(-1) for g in gradients)])
    dist.all_reduce(flat)
    for gradient, part in zip(gradients, flat[1:].split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(part.view_as(gradient))
    return flat[0]


# --- checkpoints -----------------------------------------------------------------------------------------------------


def save(path: Path, policy: nn.Module, optimizer: torch.optim.Optimizer, progress: Progress, settings: Any) -> None:
    """Write everything that the rest of the training depends on, by the first process; whole, or not at all."""
    if rank() > 0:
        return
    tensors = {f"policy.{name}": tensor for name, tensor in policy.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": tensor for name, tensor in state.items()}
    where = {"stage": progress.stage, "iteration": progress.iteration}
    write_tensors(path, {**tensors, "curve": progress.curve}, {"settings": settings, "where": where})


def restore(path: Path, policy: nn.Module, settings: dict[str, Any]) -> tuple[Progress, dict[int, dict[str, Tensor]]]:
    """Load the policy of a checkpoint; return where it is and the optimiser's state."""
    if not path.exists():
        return Progress(), {}
    tensors, notes = read_tensors(path)
    if notes["settings"] != settings:
        raise ValueError(f"{path} was made with {notes['settings']}, not with {settings}; --restart begins anew.")
    policy.load_state_dict(policy_tensors(tensors))
    moments: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if key.startswith("adam."):
            _, index, name = key.split(".")
            moments.setdefault(int(index), {})[name] = tensor
    return Progress(notes["where"]["stage"], notes["where"]["iteration"], tensors["curve"]), moments


def policy_tensors(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the policy's `state_dict` from a checkpoint's tensors."""
    return {key.removeprefix("policy."): tensor for key, tensor in tensors.items() if key.startswith("policy.")}


def write_tensors(path: Path, tensors: dict[str, Tensor], notes: dict[str, Any]) -> None:
    """Write tensors and notes; a reader sees the file before or the file after, never a part."""
    half = path.with_suffix(".part")
    contiguous = {
        name: tensor.detach().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()
    }
    save_file(contiguous, half, {key: json.dumps(value) for key, value in notes.items()})
    half.replace(path)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return what `write_tensors` wrote."""
    with safe_open(path, "pt") as file:
        notes = {key: json.loads(value) for key, value in (file.metadata() or {}).items()}
        return {name: file.get_tensor(name) for name in file.keys()}, notes  # noqa: SIM118 - no mapping
