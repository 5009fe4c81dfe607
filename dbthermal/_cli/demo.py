"""Demonstration: the files of a simulated rig, and the commands that take them to a report."""

import argparse
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import emissivity, simulation, store
from dbthermal.readers._recording import optional

_SHAPE: Final = (48, 64)  # rows and columns [pixel]
_FRAMES, _RATE, _SWEEP = 200, 10.0, 16  # of the scene, its rate [Hz], and of each temperature
_CELSIUS: Final = (5, 25, 45, 70)  # of the blackbody
_PLATE: Final = ["plate window glass", "construction concrete", "ultra flat black paint"]
_VIEW: Final = (2, 4)  # rows and columns by which cameras side by side see the plate apart
_PARALLAX: Final = 3  # further columns by which they see its reflections apart

_COMMANDS: Final = """\
dbthermal import a.tif b.tif --simulated --bands 8-14 9.5 --clock 10 --offset 0 -o scene.zarr
dbthermal calibrate {sweep} --simulated --bands 8-14 9.5 --clock 10 -o response.zarr \
--correction-output nuc.zarr
dbthermal separate scene.zarr response.zarr --correction nuc.zarr{views} -o result.zarr
dbthermal report result.zarr -o report.html
dbthermal explore result.zarr -o look.ipynb"""
"""At most five, that take the files to a report and to the explorer."""
_SCENE: Final = (
    "simulated, by no camera: a plate of glass (left) and concrete (right) with a cross of black "
    "tape, heated from 22 to 60 degC while people walk by"
)


def demo(options: argparse.Namespace) -> dict[str, Any]:
    """Command `demo`."""
    tifffile = optional("tifffile", "recordings")
    folder: Path = options.folder
    rig, rng = simulation.Rig(), np.random.default_rng(1)
    stacks = _stacks(rig, rng, apart=options.side_by_side)
    # All or nothing: a folder that has one of the files is left as it is.
    paths = {folder / f"{name}.tif": stack for name, stack in stacks.items()}
    for path in (path for path in paths if path.exists()):
        raise FileExistsError(f"There is something at '{path}'. Must be a new folder.")
    folder.mkdir(parents=True, exist_ok=True)
    for path, stack in paths.items():
        with store.whole(path, ".tif") as draft:
            tifffile.imwrite(draft, stack, photometric="minisblack", description=_SCENE)
    sweep = " ".join(f"--at {step}C a{step}.tif b{step}.tif" for step in _CELSIUS)
    views = " --register translation" if options.side_by_side else " --register none --offset 0"
    commands = _COMMANDS.format(sweep=sweep, views=views).splitlines()
    return {str(folder): f"{len(paths)} TIFF stacks, {_SCENE}", "next": [f"cd {folder}", *commands]}


def _stacks(rig: simulation.Rig, rng: np.random.Generator, *, apart: bool) -> dict[str, Any]:
    """Counts (time, y, x) of both cameras, a and b: of the scene, and of each blackbody."""
    # A plate larger than the view; by its cross of tape displaced views are registered.
    view, parallax = (_VIEW, _PARALLAX) if apart else ((0, 0), 0)
    size = (_SHAPE[0] + view[0], _SHAPE[1] + view[1])
    table = emissivity.embedded_table()["emissivity"].sel(band=list(rig.bands), material=_PLATE)
    rows, columns = np.ogrid[: size[0], : size[1]]
    tape = xr.DataArray((abs(rows - 23) < 4) | (abs(columns - 32) < 5), dims=("y", "x"))
    plate = simulation.side_by_side(table[:2], size).where(~tape, table[2].drop_vars("material"))
    # Each camera sees its part of it, and the reflections displaced.
    truth = simulation.walkers(np.arange(_FRAMES) / _RATE, size, plate, rng)
    films = []
    for camera, band in enumerate(rig.bands):
        mirrored = truth["background_temperature"].roll(x=-camera * parallax)
        top, left = (camera * shift for shift in view)
        seen = truth.assign(background_temperature=mirrored)
        seen = seen.isel(y=slice(top, top + _SHAPE[0]), x=slice(left, left + _SHAPE[1]))
        seen = seen.assign_coords(y=np.arange(_SHAPE[0]), x=np.arange(_SHAPE[1]))
        films.append(simulation.observe(seen, rig.response(), rng).sel(band=[band]))
    # Raw counts of two detectors, as they show the scene and the blackbody.
    detector = simulation.pattern(rig, _SHAPE, rng)
    shown = simulation.capture(xr.concat(films, dim="band"), detector)
    kelvin = np.array(_CELSIUS) + zero_Celsius
    movies = simulation.blackbody_movies(rig, kelvin, _SWEEP, detector, rng)
    stacks = dict(zip("ab", shown["counts"].values, strict=True))
    for name, sweep in zip("ab", movies["counts"].values, strict=True):
        stacks |= {f"{name}{step}": film for step, film in zip(_CELSIUS, sweep, strict=True)}
    return stacks
