"""Two cameras or more onto one clock and one grid.

Registration needs OpenCV and is imported by name: `alignment.registration`.
"""

from dbthermal.alignment._offset import time_offset
from dbthermal.alignment._resampling import align

__all__ = ["align", "time_offset"]
