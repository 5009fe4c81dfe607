"""Simulated captures with known truth: scenes, and the rig that records them.

Everything made here carries `origin = "simulated"`.
"""

from dbthermal.simulation.rig import (
    Rig,
    blackbody_movies,
    capture,
    contact_measurements,
    observe,
    pattern,
)
from dbthermal.simulation.scenes import (
    Background,
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
    "contact_measurements",
    "independent_pixels",
    "observe",
    "pattern",
    "scene",
    "side_by_side",
    "walkers",
]
