"""Alignment of two cameras or more: one clock and one pixel grid.

`register` estimates where the pixels of the first view lie in the others, `time_offset` by how much
one camera is exposed later than the first, and `align` brings all bands onto one clock and onto the
grid of the first.
"""

from dbthermal.alignment._align import align
from dbthermal.alignment._clocks import exposure_times, fill_times
from dbthermal.alignment._offset import time_offset
from dbthermal.alignment._reflections import reflection_shift
from dbthermal.alignment._registration import register

__all__ = ["align", "exposure_times", "fill_times", "reflection_shift", "register", "time_offset"]
__dir__ = __all__.copy
