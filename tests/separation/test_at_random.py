"""Scenes at random: materials, fronts, ramps, still parts, cameras at one place or apart."""

from typing import Final

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of

from dbthermal import schema, separation, simulation
from reproduction.experiments.cases import INTERVAL
from reproduction.experiments.pictures import ROOM, Picture, smooth_shift

RIG: Final = simulation.Rig()
TIME: Final = np.arange(300) / 10.0  # s
SHAPE: Final = (56, 72)
RISES: Final = (None, (6.0, 20.0), (2.0, 6.0), (0.5, 2.0))  # s
FAR: Final = 5.0  # deviations, root mean square over time, beyond which a pixel is wrong


def at_random(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Scene of a seed, and its capture."""
    rng = np.random.default_rng(seed)
    picture = Picture(
        shape=SHAPE,
        walkers=int(rng.integers(4, 12)),
        hottest=ROOM + rng.uniform(5.0, 40.0),
        rise=RISES[rng.integers(len(RISES))],
        still=float(rng.choice([0.0, 0.3, 0.5])),
    )
    first = rng.uniform(0.6, 0.95, 3)
    second = first - rng.uniform(0.05, 0.25, 3)
    rows, columns = np.indices(SHAPE)
    middle = rng.uniform(0.3, 0.7, 2) * SHAPE
    part = np.where(columns > middle[1], 1, np.where(rows > middle[0], 2, 0)) % rng.integers(1, 4)
    emissivity = emissivity_of(1.0, 1.0) * xr.DataArray(
        np.stack([first[part], second[part]]), dims=("band", "y", "x")
    )
    along = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 6.0)
    apart = smooth_shift(SHAPE, along, rng.uniform(0.0, 2.0)) if rng.random() < 0.75 else None
    scene = picture.draw(TIME, emissivity, rng, apart)
    for _ in range(rng.integers(3)):  # ramps of a part of the object
        begin, length, height = rng.uniform([5.0, 0.3, -10.0], [25.0, 4.0, 15.0])
        place, width = rng.uniform(0.0, 1.0, 2) * SHAPE, rng.uniform(10.0, 40.0)
        spot = np.exp(-((rows - place[0]) ** 2 + (columns - place[1]) ** 2) / width**2)
        ramp = height * np.clip((TIME - begin) / length, 0.0, 1.0)[:, None, None] * spot
        scene["object_temperature"] = scene["object_temperature"].copy(
            data=scene["object_temperature"] + ramp
        )
    return scene, simulation.observe(scene, RIG.response(), rng)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:The bands do not show the same at the same time")
def test_hardly_a_pixel_is_wrong_without_a_flag() -> None:
    """Of eight scenes: pixels beyond five deviations, and the intervals of all, in each way."""
    counted = dict.fromkeys(("without a flag", "completed"), np.zeros(3))
    for seed in range(8):
        scene, capture = at_random(seed)
        result = separation.separate(capture, RIG.response())
        error = result["object_temperature"] - scene["object_temperature"]
        score = (error / result["object_temperature_std"]).values
        status = result["status"].values
        ways = (status == 0, (status & int(schema.COMPLETED)) != 0)
        for name, here in zip(counted, ways, strict=True):
            far = np.sqrt(np.mean(score[:, here] ** 2, axis=0)) > FAR
            inside = np.mean(np.abs(score[:, here]) < INTERVAL, axis=0)
            counted[name] = counted[name] + [here.sum(), far.sum(), inside.sum()]
            print(f"{seed}: {here.sum()} {name}, {far.sum()} far off")
    for name, (pixels, far, inside) in counted.items():
        print(f"{name}: {far / pixels:.4f} far off, {inside / pixels:.3f} of the intervals hold")
        assert far < 0.02 * pixels
        assert inside > 0.88 * pixels
    assert counted["without a flag"][0] > 0.5 * 8 * SHAPE[0] * SHAPE[1]
