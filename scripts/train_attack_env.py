"""Train an attacker by policy gradient in `AttackEnv`, without a derivative of the controller or of the plant.

    python -m scripts.train_attack_env          # about 1 minute on one core

REINFORCE with a baseline (Williams 1992) on the oscillating masses: the policy is Gaussian around a linear map of what
the attacker observes. It is judged on held-out starts beside no attack, random actions and Algorithm 1, which knows the
controller and its derivative. Leaves, in results/, train_attack_env.csv, the return of every update, and .md, the
table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import trange

import torch_dpc as dpc
from scripts.shared.command import arguments, versions
from scripts.shared.rows import write_rows
from torch_dpc import attacks
from torch_dpc.envs import AttackEnv

UPDATES, STARTS, REPEATS, HELD_OUT = 60, 4, 8, 40  # updates; starts an update, episodes a start; held-out episodes
RATE, DISCOUNT, FIRST_SIGMA = 0.05, 0.3, 0.3
RHO, STEPS, REPLAN_EVERY = 0.1, 50, 5
U_TARGET = torch.tensor([0.5, -0.5])

Choice = Callable[[AttackEnv, np.ndarray[Any, Any]], np.ndarray[Any, Any]]


def make_env() -> AttackEnv:
    """Return the masses under data-driven control, from random states around the reference."""
    plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
    data = dpc.HankelData.from_trajectories(*dpc.collect(plant, 300, generator=generator), t_ini=4, horizon=15)
    layer = dpc.DPCLayer(data, Q=10.0, R=1.0, lambda_g=100.0, lambda_s=1e6, u_set=dpc.Box(-1.0, 1.0))
    reference = np.array([1.0, 1.0, 0.0, 0.0])
    return AttackEnv(
        plant,
        dpc.DPCController(layer, REPLAN_EVERY),
        dpc.RelativeBallBudget(RHO),
        attacks.TargetInput(U_TARGET),
        y_ref=reference,
        u_ref=[1.0, 1.0],
        steps=STEPS,
        start=lambda rng: {"state": reference + 0.3 * rng.normal(size=4)},
    )


class Policy(nn.Module):
    """A Gaussian around a linear map of the observation, each entry scaled by what the first episodes showed."""

    def __init__(self, seen: Tensor, actions: int):
        super().__init__()
        self.centre, size = seen.mean(0), seen.std(0)
        self.scale = torch.where(size > 0, size, 1.0) * len(size) ** 0.5
        self.map = nn.Linear(seen.shape[1], actions, dtype=torch.float64)
        nn.init.zeros_(self.map.weight)
        nn.init.zeros_(self.map.bias)
        self.log_sigma = nn.Parameter(torch.full((actions,), FIRST_SIGMA, dtype=torch.float64).log())

    def forward(self, observation: Tensor) -> torch.distributions.Normal:
        """Return the distribution of actions."""
        mean = self.map((observation - self.centre) / self.scale)
        return torch.distributions.Normal(mean, self.log_sigma.exp())


def episode(env: AttackEnv, choose: Choice, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return observations, actions and rewards of an episode."""
    observation, _ = env.reset(seed=seed)
    seen, taken, earned, over = [], [], [], False
    while not over:
        action = choose(env, observation)
        seen.append(observation)
        taken.append(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        earned.append(reward)
        over = terminated or truncated
    return torch.as_tensor(np.array(seen)), torch.as_tensor(np.array(taken)), torch.tensor(earned, dtype=torch.float64)


def train(env: AttackEnv, seed: int) -> tuple[Policy, list[float]]:
    """Return the policy and the mean return of every update."""
    generator = np.random.default_rng(seed)
    first = [episode(env, lambda env, _: generator.uniform(-1, 1, env.action_space.shape), k)[0] for k in range(4)]
    policy = Policy(torch.cat(first), math.prod(env.action_space.shape or ()))
    optimizer, returns = torch.optim.Adam(policy.parameters(), lr=RATE), []

    def explore(_: AttackEnv, observation: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        with torch.no_grad():
            d = policy(torch.as_tensor(observation))
        return generator.normal(d.mean.numpy(), d.stddev.numpy())

    for update in trange(UPDATES, desc="policy gradient"):
        runs = [episode(env, explore, 1000 * (1 + update) + k) for k in range(STARTS) for _ in range(REPEATS)]
        seen, taken, earned = (torch.stack(part) for part in zip(*runs, strict=True))
        to_go = torch.zeros_like(earned)
        for k in reversed(range(earned.shape[1])):
            to_go[:, k] = earned[:, k] + (DISCOUNT * to_go[:, k + 1] if k + 1 < earned.shape[1] else 0.0)
        to_go = to_go.unflatten(0, (STARTS, REPEATS))
        advantage = (to_go - to_go.mean(1, keepdim=True)).flatten(0, 1)  # the baseline: other episodes from this start
        advantage = advantage / advantage.std().clamp_min(1e-12)
        loss = -(policy(seen).log_prob(taken).sum(-1) * advantage).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        returns.append(float(earned.sum(1).mean()))
    return policy, returns


def judge(env: AttackEnv, policy: Policy) -> dict[str, np.ndarray[Any, Any]]:
    """Return the costs psi of held-out episodes, summed over each, by attack."""
    layer = env.controller.layer
    assert isinstance(layer, dpc.DPCLayer)
    attack, noise = attacks.LinearizedAttack(layer, env.cost, env.budget), np.random.default_rng(7)

    def algorithm_1(env: AttackEnv, _: Any) -> np.ndarray[Any, Any]:
        u_ini, y_ini, references = env.window()
        p = attack(u_ini, y_ini, y_ref=references["y_ref"], u_ref=references["u_ref"])
        return np.asarray((p / (RHO * y_ini.norm())).flatten())  # the reach of a ball is its radius

    def learned(_: AttackEnv, observation: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        with torch.no_grad():
            return np.asarray(policy(torch.as_tensor(observation)).mean)

    choices: dict[str, Choice] = {
        "no attack": lambda env, _: np.zeros(env.action_space.shape),
        "random": lambda env, _: noise.normal(size=env.action_space.shape),
        "policy gradient": learned,
        "Algorithm 1": algorithm_1,
    }
    seeds = range(10**6, 10**6 + HELD_OUT)
    return {
        name: np.array([-float(episode(env, choose, seed)[2].sum()) for seed in seeds])
        for name, choose in choices.items()
    }


def main(argv: list[str] | None = None) -> None:
    args = arguments(__doc__, seeds=1).parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    env = make_env()
    policy, returns = train(env, 0)
    note = f"{versions(1, 1)}; {UPDATES} updates of {STARTS * REPEATS} episodes"
    write_rows(args.out / "train_attack_env.csv", [{"update": np.arange(UPDATES), "return": np.array(returns)}], note)
    costs = judge(env, policy)
    nothing = costs["no attack"]
    lines = [f"{note}. Cost of the attacker (small is what it wants), {HELD_OUT} held-out episodes.", ""]
    lines += ["| attack | cost, mean | taken off, mean (standard error) |", "|---|---|---|"]
    for name, cost in costs.items():
        gain = nothing - cost
        lines.append(f"| {name} | {cost.mean():.3f} | {gain.mean():.3f} ({gain.std() / HELD_OUT**0.5:.3f}) |")
    (args.out / "train_attack_env.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
