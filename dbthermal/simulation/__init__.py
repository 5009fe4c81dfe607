"""Simulated captures with known truth: scenes and cameras.

Begin with `walkers` and `observe`: a scene, and the counts that a `Rig` records of it. All results
carry `origin = "simulated"`.
"""

from dbthermal.simulation._rig import Rig, blackbody_movies, capture, digitise, observe, pattern
from dbthermal.simulation._scenes import (
    Background,
    heating,
    independent_pixels,
    scene,
    side_by_side,
    walkers,
)

__all__ = [
    "Background",
    "Rig",
    "blackbody_movies",
    "capture",
    "digitise",
    "heating",
    "independent_pixels",
    "observe",
    "pattern",
    "scene",
    "side_by_side",
    "walkers",
]
__dir__ = __all__.copy
