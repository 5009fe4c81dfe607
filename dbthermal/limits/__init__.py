"""Statistical limits: the best accuracy that a capture allows, and how to plan one.

`bounds` holds for the exact response, any number of bands and a known truth; `plan` applies it to
materials, filters and seconds of video.
"""

from dbthermal.limits._bounds import bounds
from dbthermal.limits._planner import CaptureDesign, plan, plan_durations

__all__ = ["CaptureDesign", "bounds", "plan", "plan_durations"]
__dir__ = __all__.copy
