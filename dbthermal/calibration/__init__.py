"""Calibration: the camera's response per band from blackbodies, and emissivities.

The response is the four-parameter Sakuma-Hattori curve beside the paper's linear pair. The
emissivity of a material follows from thermocouple readings and a reflected blackbody, or by the
standards' reflector method, with its uncertainty.
"""

from dbthermal.calibration._bias import NO_BIAS, Bias
from dbthermal.calibration._contact import fit_emissivity
from dbthermal.calibration._reflector import reflector_emissivity
from dbthermal.calibration._response import AMBIENT, MINIMUM_TEMPERATURES, fit_response

__all__ = [
    "AMBIENT",
    "MINIMUM_TEMPERATURES",
    "NO_BIAS",
    "Bias",
    "fit_emissivity",
    "fit_response",
    "reflector_emissivity",
]
