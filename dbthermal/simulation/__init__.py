"""Simulated captures with known truth: scenes, and the rig that records them.

Everything made here carries `origin = "simulated"`.
"""

from dbthermal.simulation.rig import Rig, blackbody_movies, capture, observe, pattern
from dbthermal.simulation.scenes import Background, independent_pixels, scene, walkers

__all__ = [
    "Background",
    "Rig",
    "blackbody_movies",
    "capture",
    "independent_pixels",
    "observe",
    "pattern",
    "scene",
    "walkers",
]
