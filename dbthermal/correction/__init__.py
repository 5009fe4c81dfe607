"""Correction of a camera's raw counts: errors of the detector are undone or marked.

Begin with `fit_correction` (gain, offset and bad pixels from a blackbody, whose movies
`blackbody_statistics` reduces); then `correct_capture` does all of it in one documented order. Its
steps are functions of their own, for a capture that was corrected in part elsewhere. A sample that
is no measurement becomes NaN or is flagged, never filled. `alignment.register` and
`alignment.align` follow, then `separation.solve`.
"""

from dbthermal.correction._capture import correct_capture, corrected_by_camera
from dbthermal.correction._nonuniformity import (
    DETECTOR_MAXIMUM,
    OUTLIER,
    blackbody_statistics,
    correct,
    fit_correction,
    renew_offset,
)
from dbthermal.correction._pixels import mark_bad
from dbthermal.correction._shutter import find_shutter, mark_shutter
from dbthermal.correction._temporal import Reference, undo_drift, undo_lag

__all__ = [
    "DETECTOR_MAXIMUM",
    "OUTLIER",
    "Reference",
    "blackbody_statistics",
    "correct",
    "correct_capture",
    "corrected_by_camera",
    "find_shutter",
    "fit_correction",
    "mark_bad",
    "mark_shutter",
    "renew_offset",
    "undo_drift",
    "undo_lag",
]
__dir__ = __all__.copy
