"""Convex sets for inputs and outputs."""

from .base import ConvexSet
from .box import Box, NonNegative, Reals, SoftBox
from .curved import Ball, SecondOrderCone
from .feasible import FeasibleSet
from .product import Product

__all__ = [
    "Ball",
    "Box",
    "ConvexSet",
    "FeasibleSet",
    "NonNegative",
    "Product",
    "Reals",
    "SecondOrderCone",
    "SoftBox",
]
