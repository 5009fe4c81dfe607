"""Baselines: methods to compare with, most of which estimate no uncertainty."""

from typing import Final

import numpy as np

from dbthermal.separation._quality import Bits
from dbthermal.separation._tiles import Array, Estimate, Tile

WITHOUT_STD: Final = ("object_temperature_std", "background_temperature_std", "emissivity_std")
"""Variables that a method without standard deviations never estimates."""

WITHOUT_BACKGROUND: Final = (*WITHOUT_STD, "background_temperature")
"""Variables that a method which neglects the background never estimates."""


def point_estimate(
    tile: Tile,
    object_temperature: Array,
    status: Bits,
    emissivity: Array | None = None,
    background_temperature: Array | None = None,
) -> Estimate:
    """Estimate of a tile without standard deviations; quantities that are not given are NaN.

    Temperatures (time, pixel) [K], `status` (pixel), `emissivity` (band, pixel) [1].
    """
    unknown = np.full_like(object_temperature, np.nan)
    none = np.full((len(tile.curves), status.size), np.nan)
    return Estimate(
        object_temperature=object_temperature,
        object_temperature_std=unknown,
        background_temperature=(
            unknown if background_temperature is None else background_temperature
        ),
        background_temperature_std=unknown,
        emissivity=none if emissivity is None else emissivity,
        emissivity_std=none,
        status=status,
    )
