"""What an adversary is trained for: Algorithm 1's direction, a lower psi, a larger error in closed loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from scripts.experiments.closed_loops import Windows, drawn
from torch_dpc import attacks

TINY = 1e-12
LEAST_PSI = 0.01  # of the mean: a window whose psi is below that counts as if it were there
CHUNK = 1024  # windows that are prepared at once


class WindowLosses:
    """Losses over recorded windows of one controller.

    Args:
        plant: an experiment of `scripts/experiments`.
        layer: of the controller.
        windows: recorded.
        policy: the network.
        batch: windows an iteration, over all processes.
        seed: of what the iterations draw.
    """

    def __init__(self, plant: Any, layer: Any, windows: Windows, policy: nn.Module, batch: int, seed: int):
        self.plant, self.layer, self.windows, self.policy = plant, layer, windows, policy
        self.batch, self.seed = batch, seed
        parts = [windows[i : i + CHUNK] for i in range(0, len(windows), CHUNK)]
        with torch.no_grad():
            nominal = torch.cat([self.psi(part) for part in parts])
        self.nominal, self.scale = nominal, nominal.clamp_min(LEAST_PSI * nominal.mean())
        self.best = torch.cat([algorithm1(plant, layer, part, attacks.Ball(1.0)) for part in parts])

    def psi(self, windows: Windows, p: Tensor | float = 0.0) -> Tensor:
        """Return the attacker's cost of what is planned, `(n,)`."""
        return psi_at(self.plant, windows.step)(windows.plan(self.layer, p))

    def imitate(self, iteration: int, share: slice) -> Tensor:
        """Return 1 - the cosine between the network's direction and Algorithm 1's, averaged."""
        index = self._drawn(iteration)[0][share]
        w, best = self.windows[index], self.best[index]
        d = self.policy(w.u_ini, w.y_ini, w.y_ref, w.u_ref, w.step)
        cosine = (d * best).sum((-2, -1)) / torch.linalg.vector_norm(d, dim=(-2, -1)).clamp_min(TINY)
        return (best.square().sum((-2, -1)) - cosine).sum() / self.batch  # 0, not 1, where Algorithm 1 has no direction

    def lower(self, iteration: int, share: slice) -> Tensor:
        """Return the change of psi relative to psi and to rho, averaged; through the layer."""
        index, rho = (drawn_[share] for drawn_ in self._drawn(iteration))
        w = self.windows[index]
        p = w.attacked_by(attacks.PolicyAttack(self.policy, attacks.RelativeBall(rho)), step=w.step)
        return ((self.psi(w, p) - self.nominal[index]) / self.scale[index] / rho).sum() / self.batch

    def _drawn(self, iteration: int) -> tuple[Tensor, Tensor]:
        generator = seeded(self.seed, iteration)
        index = torch.randint(len(self.windows), (self.batch,), generator=generator)
        return index, drawn(self.plant.rhos, self.batch, generator)


class LoopLoss:
    """The error in closed loop, from random starts, at every rho.

    Args:
        plant: an experiment, whose `loop` has derivatives.
        layer: of the controller.
        policy: the network.
        batch: closed loops an iteration, over all processes; as many at each rho.
        seed: of the starts.
    """

    def __init__(self, plant: Any, layer: Any, policy: nn.Module, batch: int, seed: int):
        self.plant, self.layer, self.policy, self.seed = plant, layer, policy, seed
        self.starts = -(-batch // len(plant.rhos))

    def __call__(self, iteration: int, share: slice) -> Tensor:
        """Return - error / rho, averaged; back through every plan of the run."""
        starts = self.plant.starts(self.starts, seeded(self.seed, iteration).initial_seed())
        rho = torch.tensor(self.plant.rhos, dtype=torch.float64).repeat_interleave(len(starts))
        starts = torch.cat([starts] * len(self.plant.rhos))
        attack = attacks.PolicyAttack(self.policy, attacks.RelativeBall(rho[share]))
        outputs, _ = self.plant.loop(self.layer, attack, starts[share])
        return -(self.plant.mean_errors(outputs, starts[share]) / rho[share]).sum() / len(starts)


def psi_at(plant: Any, step: Tensor) -> Callable[[Any], Tensor]:
    """Return the attacker's cost of plans made at different steps."""
    target = plant.wanted_at(step)
    return lambda solution: 0.5 * (solution.u - target).square().sum((-2, -1))


def algorithm1(plant: Any, layer: Any, windows: Windows, budget: attacks.Budget) -> Tensor:
    """Return Algorithm 1's perturbation of every window."""
    return windows.attacked_by(attacks.LinearizedAttack(layer, psi_at(plant, windows.step), budget))


def seeded(seed: int, iteration: int) -> torch.Generator:
    """Return the generator of an iteration, the same wherever the training began."""
    return torch.Generator().manual_seed(1_000_000 * (seed + 1) + iteration)
