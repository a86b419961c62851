"""Weights that hold under attack: lambda_g, lambda_s, Q and R chosen by the worst they allow, by backprop.

    minimise over the weights   E[ c(0) ] + attacked_weight E[ c(p) ],      p = the attacker's answer to these weights

c(p) is what the plan made at y_ini + p would *truly* cost: its inputs are run through a predictor that starts from the
unattacked window, over one plan or over several in closed loop. The attacker knows the weights. Two derivatives:

* "danskin" holds p fixed. Where p maximises c itself over one plan, that is the derivative of the worst case (Danskin
  1966); for any other attacker it is a partial derivative, and cheap.
* "attack" goes through the attacker's own step, p = argmin over the budget of <d psi / dp, p>, and so through second
  derivatives of the layer: the whole derivative, whatever psi the attacker has.

A common factor on all four weights changes no plan. It is taken out: the mean of the logarithms of R stays.
"""

from ..data.predictor import Predictor
from .gain import plan_gain
from .judge import attack_suite, judge
from .objective import RobustObjective, Windows
from .outcome import MeanError, OutputModel, QuadraticCost, RunCost
from .parametrize import Positive, Semidefinite
from .scales import WeightScales
from .search import TuningResult, tune
from .verdict import Verdict, compare, scenarios

#: The earlier name of `Predictor` in this room.
DataPredictor = Predictor

__all__ = [
    "DataPredictor",
    "MeanError",
    "OutputModel",
    "Positive",
    "Predictor",
    "QuadraticCost",
    "RobustObjective",
    "RunCost",
    "Semidefinite",
    "TuningResult",
    "Verdict",
    "WeightScales",
    "Windows",
    "attack_suite",
    "compare",
    "judge",
    "plan_gain",
    "scenarios",
    "tune",
]
