"""Path of the data from `solve` to the object temperature: few modules, few returns.

A reader reads every function when it is first called. A room is a module; a return is a step back
into a room of `separation` that was left before. Methods of records that are handed along, and
modules below `separation`, which are looked up from anywhere, do not count.
"""

import sys
import threading
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
import xarray as xr

import dbthermal
from dbthermal import separation, simulation

PACKAGE = Path(dbthermal.__file__).parent
MOST_ROOMS, MOST_RETURNS = 14, 8


def functions_read(capture: xr.Dataset, response: xr.Dataset) -> list[tuple[str, str]]:
    """Room and name of each function of the package that a solve calls, in order of first call."""
    read: dict[tuple[str, str], None] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and PACKAGE in path.parents:
            room = str(path.relative_to(PACKAGE).with_suffix(""))
            read.setdefault((room, frame.f_code.co_qualname.split(".<locals>")[0]))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        separation.solve(capture, response, workers=1)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(read)


@pytest.mark.parametrize("jump", [0.0, 6.0])
def test_way_of_the_data_is_short(jump: float) -> None:
    """The default method crosses at most 14 modules, with at most 8 returns."""
    rig, rng = simulation.Rig(), np.random.default_rng(1)
    emissivity = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    scene = simulation.walkers(np.arange(200) / 10.0, (8, 16), emissivity, rng, crossings=3)
    step = jump * (scene["time"] > 10.0)
    moved = scene.assign(object_temperature=scene["object_temperature"] + step)
    capture = simulation.observe(moved, rig.response(), rng)
    separation.solve(capture, rig.response())  # imports are not part of the way
    read = functions_read(capture, rig.response())
    rooms = list(dict.fromkeys(room for room, _ in read))
    way = [room for room, name in read if room.startswith("separation") and "." not in name]
    way = [room for place, room in enumerate(way) if room != way[place - 1] or place == 0]
    returns = len(way) - len(set(way))
    assert len(rooms) <= MOST_ROOMS
    assert returns <= MOST_RETURNS
