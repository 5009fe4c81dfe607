"""Statistical limits: the best accuracy that a capture allows, and how to plan one.

`bounds` holds for the exact response, any number of bands and a known truth; `plan` applies it to
materials, filters and seconds of video; `ratio_variance_bound` is the closed form of two linear
bands, over the functions of `polynomial_basis`.
"""

from dbthermal._smooth import polynomial_basis
from dbthermal.limits._bounds import bounds, ratio_variance_bound, reflection_ratio
from dbthermal.limits._planner import CaptureDesign, plan, plan_durations

__all__ = [
    "CaptureDesign",
    "bounds",
    "plan",
    "plan_durations",
    "polynomial_basis",
    "ratio_variance_bound",
    "reflection_ratio",
]
__dir__ = __all__.copy
