"""Figures that a thermographer expects. A function draws what it is given and returns the figure.

Nothing is computed here beyond units for the eye, nothing is saved. Temperatures are drawn in
degrees Celsius. Every figure of data that are simulated or not radiometric says so in its title,
from the `origin` and `radiometric` attributes of what it draws.
"""

from dbthermal.figures.accuracy import accuracy, error_bar_calibration, truth_and_estimate
from dbthermal.figures.calibration import (
    emissivity_by_contact,
    emissivity_procedures,
    gain_offset_maps,
    response_fit,
)
from dbthermal.figures.canvas import provenance_note
from dbthermal.figures.comparison import (
    emissivity_errors,
    error_over_noise,
    reductions,
    sensitivity,
)
from dbthermal.figures.films import separated_film
from dbthermal.figures.limits import error_over_bands, error_over_bound, plan, pooling
from dbthermal.figures.live import LiveFigure, Panel
from dbthermal.figures.materials import condition_matrix, emissivity_bars, pooled_materials
from dbthermal.figures.nuisances import disturbances, offsets, parallax
from dbthermal.figures.scenes import (
    compared_reflections,
    separated_frames,
    separated_temperatures,
)
from dbthermal.figures.twins import error_maps, thermocouples
from dbthermal.figures.validity import status, validity

__all__ = [
    "LiveFigure",
    "Panel",
    "accuracy",
    "compared_reflections",
    "condition_matrix",
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
    "offsets",
    "parallax",
    "plan",
    "pooled_materials",
    "pooling",
    "provenance_note",
    "reductions",
    "response_fit",
    "sensitivity",
    "separated_film",
    "separated_frames",
    "separated_temperatures",
    "status",
    "thermocouples",
    "truth_and_estimate",
    "validity",
]
