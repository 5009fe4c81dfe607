"""Simulated captures with known truth, to test a claim: scenes, cameras, nuisances.

Begin with `walkers` and `observe`: a scene, and the counts that a `Rig` records of it. Nuisances
of real cameras are added one by one (`fire_shutter`, `spoil_pixels`, `lag`, ...). Everything made
here carries `origin = "simulated"`.
"""

from dbthermal.simulation._nuisances import (
    SPOILED,
    expose,
    fire_shutter,
    lag,
    lose_frames,
    spoil_pixels,
)
from dbthermal.simulation._rig import (
    Rig,
    blackbody_movies,
    capture,
    contact_measurements,
    digitise,
    observe,
    pattern,
)
from dbthermal.simulation._scenes import (
    Background,
    heating,
    independent_pixels,
    scene,
    side_by_side,
    walkers,
)

__all__ = [
    "SPOILED",
    "Background",
    "Rig",
    "blackbody_movies",
    "capture",
    "contact_measurements",
    "digitise",
    "expose",
    "fire_shutter",
    "heating",
    "independent_pixels",
    "lag",
    "lose_frames",
    "observe",
    "pattern",
    "scene",
    "side_by_side",
    "spoil_pixels",
    "walkers",
]
__dir__ = __all__.copy
