"""No separation at all: the apparent temperature of the quieter band, as a camera shows it.

What every method has to beat: the object is taken for a blackbody, so that no background counts.
"""

from typing import Final

import numpy as np

from dbthermal.schema import Status
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import Estimate, Method, Tile


def separate(tile: Tile) -> Estimate:
    """
    Apparent temperature of one tile.

    Parameters
    ----------
    tile : Tile
        Signals; only those of the quieter band are used.

    Returns
    -------
    Estimate
        Object temperature, NaN where no temperature gives the signal, with the flag
        `outside_response`. Nothing else is estimated.
    """
    temperature = tile.temperature(0, tile.signals[0])
    unknown = np.full_like(temperature, np.nan)
    none = np.full((2, temperature.shape[1]), np.nan)
    return Estimate(
        object_temperature=temperature,
        object_temperature_std=unknown,
        background_temperature=unknown,
        background_temperature_std=unknown,
        emissivity=none,
        emissivity_std=none,
        status=status_bits({Status.OUTSIDE_RESPONSE: np.any(np.isnan(temperature), axis=0)}),
    )


METHOD: Final = Method(
    separate,
    not_estimated=(
        "object_temperature_std",
        "background_temperature",
        "background_temperature_std",
        "emissivity",
        "emissivity_std",
    ),
)
"""The camera's own reading, for `solve`."""
