"""Simulated captures with known truth: scenes, and the rig that records them.

Everything made here carries `origin = "simulated"`. What casts rays or needs meshes is imported by
name: `simulation.twins` (the paper's scenes), `rays`, `surroundings`, `people`, `props`.
"""

from dbthermal.simulation.bench import (
    Bench,
    bench_series,
    contact_measurements,
    reflector_series,
)
from dbthermal.simulation.clocks import drop_frames, expose, repeat_frames
from dbthermal.simulation.nuisances import (
    SPOILED,
    drift_pattern,
    fire_shutter,
    lag,
    lose_frames,
    spoil_pixels,
)
from dbthermal.simulation.procedures import (
    PROCEDURES,
    compare_procedures,
    reflector_sensitivity,
)
from dbthermal.simulation.rig import Rig, blackbody_movies, capture, observe, pattern
from dbthermal.simulation.samples import OBJECTS, Sample, band_emissivity
from dbthermal.simulation.scenes import (
    Background,
    independent_pixels,
    scene,
    side_by_side,
    walkers,
)

__all__ = [
    "OBJECTS",
    "PROCEDURES",
    "SPOILED",
    "Background",
    "Bench",
    "Rig",
    "Sample",
    "band_emissivity",
    "bench_series",
    "blackbody_movies",
    "capture",
    "compare_procedures",
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
    "reflector_sensitivity",
    "reflector_series",
    "repeat_frames",
    "scene",
    "side_by_side",
    "spoil_pixels",
    "walkers",
]
