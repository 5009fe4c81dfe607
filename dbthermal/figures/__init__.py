"""Figures that a thermographer expects. A function draws what it is given and returns the figure.

Nothing is computed here beyond units for the eye, nothing is saved. Temperatures are drawn in
degrees Celsius. Every figure of data that are simulated or not radiometric says so in its title,
from the `origin` and `radiometric` attributes of what it draws.
"""

from dbthermal.figures._accuracy import accuracy, error_bar_calibration, truth_and_estimate
from dbthermal.figures._calibration import (
    emissivity_by_contact,
    emissivity_procedures,
    gain_offset_maps,
    response_fit,
)
from dbthermal.figures._canvas import provenance_note
from dbthermal.figures._films import separated_film
from dbthermal.figures._limits import error_over_bands, error_over_bound, plan, pooling
from dbthermal.figures._live import LiveFigure, Panel
from dbthermal.figures._materials import condition_matrix, emissivity_bars, pooled_materials
from dbthermal.figures._scenes import compared_reflections, separated_frames, separated_temperatures
from dbthermal.figures._validity import status, validity

__all__ = [
    "LiveFigure",
    "Panel",
    "accuracy",
    "compared_reflections",
    "condition_matrix",
    "emissivity_bars",
    "emissivity_by_contact",
    "emissivity_procedures",
    "error_bar_calibration",
    "error_over_bands",
    "error_over_bound",
    "gain_offset_maps",
    "plan",
    "pooled_materials",
    "pooling",
    "provenance_note",
    "response_fit",
    "separated_film",
    "separated_frames",
    "separated_temperatures",
    "status",
    "truth_and_estimate",
    "validity",
]
