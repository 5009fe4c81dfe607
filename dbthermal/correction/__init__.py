"""Correction of one camera's frames: what its detector does to the counts, found and undone.

In the order of use: `fit_correction` and `correct` (gain and offset of each pixel, from a
blackbody; `correct_drifting` between two corrections), `mark_shutter` (frozen and repeated frames),
`mark_bad` (pixels that turn bad in the capture), `undo_lag` (thermal lag of the pixels) and
`undo_drift` (drift that all pixels share). Then `alignment.registration.register` and
`alignment.align` bring two cameras together, and `separation.solve` follows. A sample that is no
measurement becomes NaN or is flagged, never filled.
"""

from dbthermal.correction._drift import correct_drifting, renew_offset, undo_drift
from dbthermal.correction._lag import noise_amplification, undo_lag
from dbthermal.correction._nonuniformity import (
    DETECTOR_MAXIMUM,
    OUTLIER,
    Array,
    Mask,
    blackbody_statistics,
    correct,
    fit_correction,
)
from dbthermal.correction._pixels import mark_bad
from dbthermal.correction._shutter import find_shutter, mark_shutter

__all__ = [
    "DETECTOR_MAXIMUM",
    "OUTLIER",
    "Array",
    "Mask",
    "blackbody_statistics",
    "correct",
    "correct_drifting",
    "find_shutter",
    "fit_correction",
    "mark_bad",
    "mark_shutter",
    "noise_amplification",
    "renew_offset",
    "undo_drift",
    "undo_lag",
]
