"""Figures of the experiments."""

from reproduction.figures.comparison import (
    emissivity_errors,
    error_over_noise,
    reductions,
    sensitivity,
)
from reproduction.figures.nuisances import disturbances, offsets, parallax
from reproduction.figures.twins import error_maps, thermocouples

__all__ = [
    "disturbances",
    "emissivity_errors",
    "error_maps",
    "error_over_noise",
    "offsets",
    "parallax",
    "reductions",
    "sensitivity",
    "thermocouples",
]
