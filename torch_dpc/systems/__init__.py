"""Plants: anything with `n_u`, `n_y`, `dt`, `reset(...)` and `step(u)` is one."""

from .masses import OscillatingMasses
from .quadrotor import Quadrotor
from .torch_quadrotor import TorchQuadrotor

__all__ = ["OscillatingMasses", "Quadrotor", "TorchQuadrotor"]
