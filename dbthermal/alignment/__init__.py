"""Two cameras or more onto one clock and one grid.

Registration needs OpenCV and is imported by name: `alignment.registration`.
"""

from dbthermal.alignment.offset import time_offset
from dbthermal.alignment.resampling import align

__all__ = ["align", "time_offset"]
