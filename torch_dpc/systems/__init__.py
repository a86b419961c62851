"""Plants: anything with `n_u`, `n_y`, `dt`, `reset(...)` and `step(u)` is one."""

from .cart_pole import CartPole
from .four_tanks import FourTanks
from .gym import GymPlant
from .many import Many
from .masses import OscillatingMasses
from .ode import Ode
from .quadrotor import Quadrotor
from .state_space import StateSpace
from .torch_plant import TorchPlant
from .torch_quadrotor import TorchQuadrotor

__all__ = [
    "CartPole",
    "FourTanks",
    "GymPlant",
    "Many",
    "Ode",
    "OscillatingMasses",
    "Quadrotor",
    "StateSpace",
    "TorchPlant",
    "TorchQuadrotor",
]
