"""Simulated captures with known truth: scenes, and the rig that records them.

Everything made here carries `origin = "simulated"`. What casts rays or needs meshes is imported by
name: `simulation.twins` (the paper's scenes), `rays`, `surroundings`, `people`, `props`.
"""

from dbthermal.simulation._bench import Bench, bench_series, contact_measurements, reflector_series
from dbthermal.simulation._clocks import drop_frames, expose, repeat_frames
from dbthermal.simulation._nuisances import (
    SPOILED,
    drift_pattern,
    fire_shutter,
    lag,
    lose_frames,
    spoil_pixels,
)
from dbthermal.simulation._rig import Rig, blackbody_movies, capture, observe, pattern
from dbthermal.simulation._samples import OBJECTS, Sample, band_emissivity
from dbthermal.simulation._scenes import (
    Background,
    independent_pixels,
    scene,
    side_by_side,
    walkers,
)

__all__ = [
    "OBJECTS",
    "SPOILED",
    "Background",
    "Bench",
    "Rig",
    "Sample",
    "band_emissivity",
    "bench_series",
    "blackbody_movies",
    "capture",
    "contact_measurements",
    "drift_pattern",
    "drop_frames",
    "expose",
    "fire_shutter",
    "independent_pixels",
    "lag",
    "lose_frames",
    "observe",
    "pattern",
    "reflector_series",
    "repeat_frames",
    "scene",
    "side_by_side",
    "spoil_pixels",
    "walkers",
]
