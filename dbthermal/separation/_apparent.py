"""Apparent temperature: the reading of a camera that takes every object for a blackbody."""

from typing import Final

import numpy as np

from dbthermal.schema import Status
from dbthermal.separation._inputs import Method
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import WITHOUT_BACKGROUND, Estimate, Tile


def separate(tile: Tile) -> Estimate:
    """Apparent temperature in the quieter band; NaN where no temperature gives the signal."""
    temperature = tile.temperature(0, tile.signals[0])
    missing = np.any(np.isnan(temperature), axis=0)
    status = status_bits({Status.OUTSIDE_RESPONSE: missing})
    estimate = Estimate.without_std(tile, temperature, status)
    return estimate.check_range(tile.curves[0], not_estimated=METHOD.not_estimated)


METHOD: Final = Method(separate, not_estimated=(*WITHOUT_BACKGROUND, "emissivity"))
"""The camera's reading, for `solve`."""
