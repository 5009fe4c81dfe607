"""Statistical limits: what no estimator of one pixel can beat, and what to expect of a recording.

`bounds` holds for the exact response, any number of bands and a given truth; `plan` puts it to
materials, filters and seconds of video; the closed forms of two linear bands stand beside them.
"""

from dbthermal.limits._cramer_rao import bounds
from dbthermal.limits._deviations import QUANTITIES
from dbthermal.limits._planner import NO_FILTER, plan, plan_durations
from dbthermal.limits._ratios import (
    Array,
    calibrated_variance,
    emission_ratio,
    emissivities,
    ratio_variance,
    reflection_ratio,
)
from dbthermal.limits._recording import Recording

__all__ = [
    "NO_FILTER",
    "QUANTITIES",
    "Array",
    "Recording",
    "bounds",
    "calibrated_variance",
    "emission_ratio",
    "emissivities",
    "plan",
    "plan_durations",
    "ratio_variance",
    "reflection_ratio",
]
