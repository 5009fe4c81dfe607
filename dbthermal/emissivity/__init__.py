"""Band emissivities of materials, and which two bands tell emission from reflection best.

Spectra become a table of Planck-weighted band averages; from the table follow the condition number
of the mixing matrix for each pair of bands, and the filter to set beside the camera's own band.
"""

from dbthermal.emissivity._filters import (
    choose_filter,
    condition_numbers,
    filter_noise,
    pair_summary,
    single_frame_std,
)
from dbthermal.emissivity._table import MINIMUM_COVERAGE, band_table, embedded_table

__all__ = [
    "MINIMUM_COVERAGE",
    "band_table",
    "choose_filter",
    "condition_numbers",
    "embedded_table",
    "filter_noise",
    "pair_summary",
    "single_frame_std",
]
