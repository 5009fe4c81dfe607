"""Path of the data to the object temperature: few modules, few returns.

A reader reads every function when it is first called. A room is a module; a return is a step back
into a room that was left before. Methods of records that are handed along, and modules below
`separation`, which are looked up from anywhere, do not count; in `separate`, those of `alignment`
do.
"""

import sys
import threading
from collections.abc import Callable
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FrameType

import numpy as np
import pytest
import xarray as xr
from captures import GLASS
from scenes import Shelf

import dbthermal
from dbthermal import separation, simulation

PACKAGE = Path(dbthermal.__file__).parent
MOST_ROOMS, MOST_RETURNS = 14, 8
MOST_OF_SEPARATE = {"one place": (30, 34), "apart": (40, 78)}

Function = tuple[str, str]


def functions_read(call: Callable[[], xr.Dataset]) -> list[Function]:
    """Room and name of each function of the package that a call reads, in order of first call."""
    read: dict[Function, None] = {}
    seen: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code in seen:
            return
        seen.add(code)
        path = Path(code.co_filename)
        if code.co_flags & CO_OPTIMIZED and PACKAGE in path.parents:  # no body of a module or class
            room = str(path.relative_to(PACKAGE).with_suffix(""))
            read.setdefault((room, code.co_qualname.split(".<locals>")[0]))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(read)


def way_of(read: list[Function], *packages: str) -> list[Function]:
    """First function read at each entrance into a room of some packages, without methods."""
    way = [(room, name) for room, name in read if room.startswith(packages) and "." not in name]
    rooms = [room for room, _ in way]
    return [step for place, step in enumerate(way) if place == 0 or step[0] != rooms[place - 1]]


def returns(way: list[Function]) -> list[str]:
    """Steps of a way back into a room that was left before."""
    rooms = [room for room, _ in way]
    return [
        f"{rooms[place - 1]} -> {room}.{name}"
        for place, (room, name) in enumerate(way)
        if room in rooms[:place]
    ]


@pytest.mark.parametrize("jump", [0.0, 6.0])
def test_way_of_the_data_is_short(jump: float) -> None:
    """The default method crosses at most 14 modules, with at most 8 returns."""
    rig, rng = simulation.Rig(), np.random.default_rng(1)
    scene = simulation.walkers(np.arange(200) / 10.0, (8, 16), GLASS, rng, crossings=3)
    step = jump * (scene["time"] > 10.0)
    moved = scene.assign(object_temperature=scene["object_temperature"] + step)
    capture = simulation.observe(moved, rig.response(), rng)
    response = rig.response()
    separation.solve(capture, response)  # imports are not part of the way
    read = functions_read(lambda: separation.solve(capture, response, workers=1))
    assert len({room for room, _ in read}) <= MOST_ROOMS
    assert len(returns(way_of(read, "separation"))) <= MOST_RETURNS


@pytest.mark.parametrize("name", ["one place", pytest.param("apart", marks=pytest.mark.slow)])
def test_way_of_separate_is_bounded(name: str, shelf: Shelf) -> None:
    """So many modules of separation and alignment are crossed, with so many returns."""
    scene = shelf.scene(name)
    separation.separate(scene.capture, scene.response)  # imports, and what is kept after it
    read = functions_read(lambda: separation.separate(scene.capture, scene.response, workers=1))
    way = way_of(read, "separation", "alignment")
    rooms, steps = {room for room, _ in way}, returns(way)
    print(f"{len(rooms)} modules, {len(steps)} returns:", *steps, sep="\n")
    assert len(rooms) <= MOST_OF_SEPARATE[name][0]
    assert len(steps) <= MOST_OF_SEPARATE[name][1]
