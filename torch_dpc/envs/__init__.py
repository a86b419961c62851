"""Gymnasium environments (extra `gym`): the attacker's environment, and the quadrotor.

Importing this module registers "torch_dpc/Quadrotor-v0" with `gymnasium.make`.
"""

try:
    import gymnasium
except ImportError as error:
    raise ImportError("torch_dpc.envs needs Gymnasium: pip install 'torch_dpc[gym]'.") from error

from .attack import AttackEnv
from .quadrotor import QuadrotorEnv

__all__ = ["AttackEnv", "QuadrotorEnv"]

gymnasium.register("torch_dpc/Quadrotor-v0", entry_point="torch_dpc.envs:QuadrotorEnv", max_episode_steps=500)
