"""Band emissivities of materials, and the two bands that tell emission from reflection best.

Spectra become a table of Planck-weighted band averages (`band_table`; `embedded_table` holds 25
common materials). From a table follow the condition number of the mixing matrix for each pair of
bands, by the supplement of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334, and the noise
behind a filter; `limits.plan` chooses the filter to set beside the camera's own band.
"""

from dbthermal.emissivity._background import background_ratio
from dbthermal.emissivity._filters import condition_numbers, filter_noise
from dbthermal.emissivity._tables import (
    CAMERA_BAND,
    MINIMUM_COVERAGE,
    band_table,
    embedded_table,
    library_mixture,
)

__all__ = [
    "CAMERA_BAND",
    "MINIMUM_COVERAGE",
    "background_ratio",
    "band_table",
    "condition_numbers",
    "embedded_table",
    "filter_noise",
    "library_mixture",
]
__dir__ = __all__.copy
