"""The experiments by name: Figures 3 and 4, and the masses on a sinusoid."""

from __future__ import annotations

from scripts.experiments.case import Case
from scripts.experiments.masses import Masses, MovingMasses
from scripts.experiments.quadrotor import Quadrotor

CASES: dict[str, Case] = {case.name: case for case in (Masses(), MovingMasses(), Quadrotor())}
