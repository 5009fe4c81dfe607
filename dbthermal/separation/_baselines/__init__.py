"""Baselines: methods to compare with, most of which estimate no uncertainty."""

import numpy as np

from dbthermal.separation._tiles import Array, Bits, Estimate


def point_estimate(
    object_temperature: Array,
    status: Bits,
    emissivity: Array | None = None,
    background_temperature: Array | None = None,
) -> Estimate:
    """Estimate of a tile of two bands without standard deviations; quantities not given are NaN."""
    unknown = np.full_like(object_temperature, np.nan)
    none = np.full((2, object_temperature.shape[1]), np.nan)
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
