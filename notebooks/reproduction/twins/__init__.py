"""Simulated twins of the paper's scenes: heat transport, and rays into moving surroundings.

Each twin is a scene with known truth that looks like a scene of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334, whose captures are not public. Sizes, distances and ways are this
project's own; what is known of the originals is their names and two thermocouple readings.
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import xarray as xr

from reproduction.twins.panes import Gun, Pane, Touch, fingerprint, fingers, glass_plate
from reproduction.twins.probes import on_wall, thermocouple_readings
from reproduction.twins.solids import Bulb, Lamp, bulb, bunny, rabbit
from reproduction.twins.stage import AMBIENT, Capture, Stage, clock, obstructed, take
from reproduction.twins.vessels import COFFEE_POT, WINEGLASS, Vessel, coffee_pot, wineglass

__all__ = [
    "AMBIENT",
    "COFFEE_POT",
    "TWINS",
    "WINEGLASS",
    "Bulb",
    "Capture",
    "Gun",
    "Lamp",
    "Pane",
    "Stage",
    "Touch",
    "Vessel",
    "bulb",
    "bunny",
    "clock",
    "coffee_pot",
    "fingerprint",
    "fingers",
    "glass_plate",
    "obstructed",
    "on_wall",
    "rabbit",
    "take",
    "thermocouple_readings",
    "twin",
    "wineglass",
]

TWINS: Final[MappingProxyType[str, Callable[..., Stage]]] = MappingProxyType(
    {
        "wineglass": wineglass,
        "coffee_pot": coffee_pot,
        "bulb": bulb,
        "glass_plate": glass_plate,
        "fingers": fingers,
        "fingerprint": fingerprint,
        "bunny": bunny,
    }
)
"""Name -> function that sets the stage."""


def twin(name: str, capture: Capture, rng: np.random.Generator, **options: Any) -> xr.Dataset:
    """
    Scene of a twin.

    Parameters
    ----------
    name : str
        One of `TWINS`.
    capture : Capture
        Emissivity of the object, shape, times, baseline of the cameras.
    rng : Generator
        Source of all motion.
    **options
        Of the twin's own function, such as the `vessel` of "wineglass".

    Returns
    -------
    Dataset
        From `take`: a scene for `simulation.observe`, with `origin = "simulated"` and the
        attribute `twin`.

    Raises
    ------
    ValueError
        If there is no twin of that name.
    """
    if name not in TWINS:
        raise ValueError(f"Unknown twin '{name}'. Must be one of {[*TWINS]}.")
    return take(TWINS[name](capture, rng, **options), capture)
