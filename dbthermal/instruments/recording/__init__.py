"""Recorder of captures, and reader of recordings.

`record` writes the frames of all cameras and the readings beside them; `open_capture` opens a
recording as stage `capture`, `notes` its log, `overview` a folder of recordings, and `open_sweep`
and `bench_series` those of a blackbody. See `dbthermal.instruments.protocols` for whole procedures.
"""

from dbthermal.instruments.recording._reader import (
    bench_series,
    notes,
    open_capture,
    open_sweep,
    overview,
    require_whole,
)
from dbthermal.instruments.recording._recorder import record
from dbthermal.instruments.recording._records import Limits, Preview, Reading, Summary

__all__ = [
    "Limits",
    "Preview",
    "Reading",
    "Summary",
    "bench_series",
    "notes",
    "open_capture",
    "open_sweep",
    "overview",
    "record",
    "require_whole",
]
__dir__ = __all__.copy
