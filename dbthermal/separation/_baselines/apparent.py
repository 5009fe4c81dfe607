"""No separation at all: the apparent temperature of the quieter band, as a camera shows it.

What every method has to beat: the object is taken for a blackbody, so that no background counts.
"""

from typing import Final

import numpy as np

from dbthermal.separation._problem import Method, Problem
from dbthermal.separation._separated import Separated, flag


def separate(problem: Problem) -> Separated:
    """
    Apparent temperature of one tile.

    Parameters
    ----------
    problem : Problem
        Signals; only those of the quieter band are used.

    Returns
    -------
    Separated
        Object temperature, NaN where no temperature gives the signal, with the flag
        `outside_response`. Nothing else is estimated.
    """
    temperature = problem.temperature(0, problem.signals[0])
    unknown = np.full_like(temperature, np.nan)
    none = np.full((2, temperature.shape[1]), np.nan)
    return Separated(
        object_temperature=temperature,
        object_temperature_std=unknown,
        background_temperature=unknown,
        background_temperature_std=unknown,
        emissivity=none,
        emissivity_std=none,
        status=flag({"outside_response": np.any(np.isnan(temperature), axis=0)}),
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
