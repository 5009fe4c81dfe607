"""Intervals in situations that the paper does not assume hold, or their pixels have a flag."""

import numpy as np
import pytest
from worlds import RESPONSE, World, seen

from dbthermal import separation

WORLDS = {
    "plain": World(),
    "fine detail": World(detail=0.01),
    "lenses blur unlike": World(blur=(0.5, 1.3)),
    "lenses blur alike": World(blur=(0.9, 0.9)),
    "second camera sharper": World(blur=(1.2, 0.4)),
    "rough surface": World(roughness=(2.0, 2.8)),
    "cameras shake": World(shake=(0.3, 0.3), detail=0.01),
    "each camera shakes": World(shake=(0.25, 0.3), detail=0.01),
    "fabrics": World(fabric=(0.92, 0.80)),
    "1/f noise": World(flicker=0.5),
    "lock-in": World(lamp=0.3),
    "foil": World(behind=(0.10, 0.15), surface=((0.75, 0.60), (0.75, 0.60))),
    "breathing skin": World(breath=0.5, detail=0.003, surface=((0.93, 0.85), (0.93, 0.85))),
}
PLAIN = ("plain", "lenses blur alike")


def judged(name: str, seed: int) -> tuple[float, float, float, list[str]]:
    """Share of the intervals that hold, of pixels without a flag, their RMSE, and warnings."""
    capture, truth = seen(WORLDS[name], seed)
    with pytest.warns() if name not in PLAIN else _nothing():
        result = separation.separate(capture, RESPONSE)
    sound = result["status"].values == 0
    error = (result["object_temperature"].values - truth)[:, sound]
    holds = np.abs(error) < 1.96 * result["object_temperature_std"].values[:, sound]
    rmse = float(np.sqrt(np.mean(error**2))) if sound.any() else 0.0
    cover = float(holds.mean()) if sound.any() else 1.0
    print(f"{name}: {cover:.3f} hold of {sound.mean():.3f} without a flag, RMSE {rmse:.3f} K")
    return cover, float(sound.mean()), rmse, result.attrs.get("warnings", [])
