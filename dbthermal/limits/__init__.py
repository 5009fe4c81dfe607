"""Statistical limits: the best accuracy that a capture allows, and how to plan one.

`bounds` holds for the exact response, any number of bands and a known truth; `plan` applies it to
materials, filters and seconds of video. `polynomial_basis` has the smooth functions of both.
"""

from dbthermal._smooth import polynomial_basis
from dbthermal.limits._bounds import bounds
from dbthermal.limits._planner import CaptureDesign, plan, plan_durations

__all__ = ["CaptureDesign", "bounds", "plan", "plan_durations", "polynomial_basis"]
__dir__ = __all__.copy
