"""The worst there is, proven: branch and bound over the states of the constrained rows."""

from .worst_case import WorstCase, worst_case

__all__ = ["WorstCase", "worst_case"]
