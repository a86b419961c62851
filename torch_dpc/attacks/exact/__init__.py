"""The worst there is, proven: branch and bound over the states of the constrained rows."""

from .interval import CertifiedInterval, certified_interval
from .worst_case import WorstCase, worst_case

__all__ = ["CertifiedInterval", "WorstCase", "certified_interval", "worst_case"]
