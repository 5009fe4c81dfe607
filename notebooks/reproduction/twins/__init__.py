"""Simulated twins of the paper's scenes: heat transport, and rays into moving surroundings.

Each twin is a simulated scene with known truth that looks like a scene of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334, whose captures are not public. Sizes, distances and routes are this
project's own; known of the originals are their names and two thermocouple readings.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _text as texts
from reproduction.twins.bodies import COFFEE_POT, WINEGLASS, bunny, filled
from reproduction.twins.panes import fingerprint, fingers, glass_plate
from reproduction.twins.stage import Capture, Stage, take

TWINS: Final[dict[str, Callable[..., Stage]]] = {
    "wineglass": partial(filled, vessel=WINEGLASS),
    "coffee_pot": partial(filled, vessel=COFFEE_POT),
    "glass_plate": glass_plate,
    "fingers": fingers,
    "fingerprint": fingerprint,
    "bunny": bunny,
}
"""Name -> function that sets the stage."""


def twin(name: str, capture: Capture, rng: np.random.Generator, **options: Any) -> xr.Dataset:
    """Scene (see `stage.take`) of a twin of `TWINS`, with attribute `twin`.

    The rng is the source of all motion; options are `visitor` of "fingerprint" and `scan` of
    "bunny".
    """
    texts.check_listed("Unknown twin", name, TWINS)
    return take(TWINS[name](capture, rng, **options), capture)
