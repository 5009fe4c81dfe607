"""Calibration: the camera's response per band from blackbodies, and emissivities.

`fit_response` fits the four-parameter Sakuma-Hattori curve beside the paper's linear pair;
`maker_response` takes a maker's constants, which have no error bars. The
emissivity of a material, with its uncertainty, follows from thermocouple readings and a reflected
blackbody (`fit_emissivity`), or by the standards' reflector method (`reflector_emissivity`).
"""

from dbthermal.calibration._emissivity import NO_BIAS, Bias, fit_emissivity, reflector_emissivity
from dbthermal.calibration._response import (
    AMBIENT,
    MINIMUM_TEMPERATURES,
    NO_BARS,
    fit_response,
    maker_response,
)

__all__ = [
    "AMBIENT",
    "MINIMUM_TEMPERATURES",
    "NO_BARS",
    "NO_BIAS",
    "Bias",
    "fit_emissivity",
    "fit_response",
    "maker_response",
    "reflector_emissivity",
]
__dir__ = __all__.copy
