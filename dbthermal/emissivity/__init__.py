"""Band emissivities of materials, and the two bands that tell emission from reflection best.

Spectra become a table of Planck-weighted band averages (`band_table`; `embedded_table` holds 25
common materials); `limits.plan` chooses the filter to set beside the camera's own band, by the
noise behind it (`filter_noise`). A colour of what is mirrored is seen in foil (`background_ratio`).
"""

from dbthermal.emissivity._background import background_ratio
from dbthermal.emissivity._tables import (
    CAMERA_BAND,
    MINIMUM_COVERAGE,
    band_table,
    embedded_table,
    filter_noise,
    library_mixture,
)

__all__ = [
    "CAMERA_BAND",
    "MINIMUM_COVERAGE",
    "background_ratio",
    "band_table",
    "embedded_table",
    "filter_noise",
    "library_mixture",
]
__dir__ = __all__.copy
