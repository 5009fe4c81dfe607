"""Figures of the experiments: accuracy, filters, limits, comparisons, nuisances, twins."""

from reproduction.figures.accuracy import accuracy, error_bar_calibration, validity
from reproduction.figures.calibration import gain_offset_maps, response_fit
from reproduction.figures.comparison import (
    compared_reflections,
    descents,
    emissivity_errors,
    emissivity_procedures,
    error_over_noise,
    reductions,
    sensitivity,
)
from reproduction.figures.emissivity import emissivity_bars, emissivity_by_contact
from reproduction.figures.filters import condition_matrix
from reproduction.figures.limits import (
    error_over_bands,
    error_over_bound,
    pooled_materials,
    pooling,
)
from reproduction.figures.nuisances import disturbances, offsets, parallax
from reproduction.figures.scenes import (
    camera_readings,
    compared_pictures,
    raw_pictures,
    separated_film,
    truth_and_estimate,
)
from reproduction.figures.sky import hours, sky_changes
from reproduction.figures.twins import error_maps, thermocouples

__all__ = [
    "accuracy",
    "camera_readings",
    "compared_pictures",
    "compared_reflections",
    "condition_matrix",
    "descents",
    "disturbances",
    "emissivity_bars",
    "emissivity_by_contact",
    "emissivity_errors",
    "emissivity_procedures",
    "error_bar_calibration",
    "error_maps",
    "error_over_bands",
    "error_over_bound",
    "error_over_noise",
    "gain_offset_maps",
    "hours",
    "offsets",
    "parallax",
    "pooled_materials",
    "pooling",
    "raw_pictures",
    "reductions",
    "response_fit",
    "sensitivity",
    "separated_film",
    "sky_changes",
    "thermocouples",
    "truth_and_estimate",
    "validity",
]
