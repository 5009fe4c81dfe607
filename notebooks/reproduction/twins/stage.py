"""Stage of a twin (object, camera, surroundings), the scene of it, and its thermocouples."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh
import xarray as xr

from dbthermal import schema, simulation
from dbthermal.simulation import heat
from dbthermal.simulation.rays import Array, Camera, Caster, Hits, Mask, unit
from dbthermal.simulation.surroundings import Actor, incident, painted
from reproduction.twins.people import pacing, person

AMBIENT: Final = 295.15
"""Temperature of the room, of its air, and of all that is not heated [K]."""
TABLE: Final = 0.75
"""Height of the table that the objects stand on [m]."""
STEP: Final = 0.1
"""Longest step of the heat transport [s]."""


def clock(frames: int = 350, rate: float = 10.0) -> Array:
    """Times (frame,) of a capture from 0 on [s], at a frame rate [Hz]."""
    return np.arange(frames) / rate


@dataclass(frozen=True)
class Capture:
    """
    Recording conditions of a twin: emissivity, image size, times and baseline.

    Attributes
    ----------
    emissivity : DataArray
        Emissivity of the object (band) [1], the band of the first camera first.
    shape : tuple of int
        Rows and columns.
    time : ndarray, shape (time,)
        Times [s], two or more; 350 frames at 10 Hz.
    baseline : float
        How far the second camera is to the right of the first [m]. With 0 both see the same
        reflections. Otherwise the object's surface is taken as perfectly registered, and the
        second band sees it from the second camera.
    """

    emissivity: xr.DataArray
    shape: tuple[int, int] = (144, 192)
    time: Array = field(default_factory=clock)
    baseline: float = 0.0

    def __post_init__(self) -> None:
        """Check bands and baseline."""
        if self.emissivity.dims != ("band",):
            raise ValueError(f"Invalid dims {self.emissivity.dims} of emissivity. Must be (band,).")
        if self.baseline and self.emissivity.sizes["band"] != 2:
            names = [str(name) for name in self.emissivity["band"].values]
            raise ValueError(f"Invalid bands {names} for a baseline. Must be two.")


@dataclass(frozen=True)
class Stage:
    """
    Object, camera and surroundings of a twin.

    Name; mesh of the object [m] and its temperature (time, vertex) [K]; first camera; bodies that
    move, or stand, around it; points (thermocouple, 3) of the surface with thermocouples [m].
    """

    name: str
    mesh: trimesh.Trimesh
    temperature: Array
    camera: Camera
    actors: Sequence[Actor]
    thermocouples: npt.ArrayLike = ()


@dataclass(frozen=True)
class _View:
    """The object as the first camera sees it: intersections of the pixels' rays."""

    caster: Caster
    hits: Hits

    @property
    def on_object(self) -> Mask:
        return self.hits.met

    @property
    def seen(self) -> Hits:
        return self.hits.select(self.hits.met)


def take(stage: Stage, capture: Capture) -> xr.Dataset:
    """
    Scene of a stage, ray-traced.

    A scene for `simulation.observe`, and in addition `on_object` (y, x), and `thermocouple_y`,
    `thermocouple_x` (thermocouple): rows and columns of the virtual thermocouples, which the camera
    must see (ValueError). Beside the object, the object temperature is that of the background seen
    directly there, which makes the emissivity, defined everywhere, irrelevant. With a baseline
    `background_temperature` is (band, time, y, x), and `hidden_from_second` (y, x) marks the points
    that the second camera does not see; its background is that of the first there, and off the
    object. A concave object's reflection in itself is of its own temperature (one bounce).
    """
    directions = stage.camera.directions()
    origins = np.array(np.broadcast_to(np.asarray(stage.camera.position), directions.shape))
    caster = Caster(stage.mesh)
    view = _View(caster, caster.cast(origins, directions))
    on = view.on_object
    origins[on], directions[on] = caster.mirrored(view.seen, directions[on])
    background = incident(origins, directions, capture.time, AMBIENT, stage.actors)
    background[:, on] = _with_itself(stage, view, origins[on], directions[on], background[:, on])
    emitted = background.copy()
    emitted[:, on] = view.caster.interpolate(view.seen, stage.temperature)
    warm, cold = (part.reshape(-1, *capture.shape) for part in (emitted, background))
    scene = simulation.scene(capture.time, warm, cold, capture.emissivity)
    scene["on_object"] = (("y", "x"), on.reshape(capture.shape), {"units": "1"})
    if capture.baseline:
        scene = _with_second(scene, stage, capture, view)
    scene = _with_thermocouples(scene, stage, view.caster)
    return scene.assign_attrs(twin=stage.name, baseline=capture.baseline)


def _with_itself(
    stage: Stage, view: _View, origins: Array, directions: Array, reflected: Array
) -> Array:
    """Reflection (time, ray) [K] with the object's own where a reflected ray meets it."""
    again = view.caster.cast(origins, directions)
    reflected[:, again.met] = view.caster.interpolate(again.select(again.met), stage.temperature)
    return reflected


def _with_second(scene: xr.Dataset, stage: Stage, capture: Capture, view: _View) -> xr.Dataset:
    """The scene with a background for each band, the second from a second camera."""
    other = stage.camera.beside(capture.baseline)
    points = view.caster.points(view.seen)
    seen = view.caster.visible(points, other.position)
    rays = view.caster.mirrored(view.seen, unit(points - np.asarray(other.position)))
    reflected = incident(*rays, capture.time, AMBIENT, stage.actors)
    reflected = _with_itself(stage, view, *rays, reflected)
    first = scene["background_temperature"]
    second = first.values.copy().reshape(capture.time.size, -1)
    second[:, np.flatnonzero(view.on_object)[seen]] = reflected[:, seen]
    both = np.stack([first.values, second.reshape(first.shape)])
    hidden = np.zeros(view.on_object.size, dtype=bool)
    hidden[view.on_object] = ~seen
    scene["background_temperature"] = (("band", *first.dims), both, first.attrs)
    scene["hidden_from_second"] = (("y", "x"), hidden.reshape(capture.shape), {"units": "1"})
    return scene


def _with_thermocouples(scene: xr.Dataset, stage: Stage, caster: Caster) -> xr.Dataset:
    """The scene with the pixels of the thermocouples."""
    points = np.reshape(stage.thermocouples, (-1, 3)).astype(np.float64)
    rows, columns = np.rint(stage.camera.project(points)).astype(np.int64).T
    seen = caster.visible(points, stage.camera.position)
    for row, column, visible in zip(rows, columns, seen, strict=True):
        if not (row in scene["y"] and column in scene["x"] and scene["on_object"][row, column]):
            raise ValueError(
                f"Invalid thermocouple at row {row}, column {column}. Must be on the object, in "
                f"an image of {stage.camera.shape}."
            )
        if not visible:
            raise ValueError(
                f"Invalid thermocouple at row {row}, column {column}, behind another part of the "
                "object. Must be seen by the camera."
            )
    for name, places in (("thermocouple_y", rows), ("thermocouple_x", columns)):
        scene[name] = ("thermocouple", places, {"units": "1", "long_name": name})
    return scene


def thermocouple_readings(
    scene: xr.Dataset,
    rng: np.random.Generator,
    *,
    std: float = 0.05,
    offset_std: float = 0.1,
    bead: int = 3,
) -> xr.DataArray:
    """
    Readings (thermocouple, time) [K] of the virtual thermocouples of a twin: means over a bead.

    The errors are of a single reading (`std`) and constant of a probe (`offset_std`) [K]; 0.1 is a
    probe that was compared with a reference, 0.5 one that was not. A bead covers a square of an odd
    number of pixels along a side, all on the object; else a ValueError.
    """
    if bead < 1 or bead % 2 == 0:
        raise ValueError(f"Invalid bead {bead} pixels. Must be odd and positive.")
    readings = [
        _bead_mean(scene, int(row), int(column), bead // 2)
        for row, column in zip(scene["thermocouple_y"], scene["thermocouple_x"], strict=True)
    ]
    size = (len(readings), scene.sizes["time"])
    error = rng.normal(0.0, offset_std, (len(readings), 1)) + rng.normal(0.0, std, size)
    return xr.DataArray(
        np.reshape(readings, size) + error,
        dims=("thermocouple", "time"),
        coords={"time": scene["time"]},
        attrs=schema.STAGES["separated"]["object_temperature"].attrs,
        name="thermocouple_temperature",
    )


def _bead_mean(scene: xr.Dataset, row: int, column: int, reach: int) -> Array:
    """Mean object temperature (time,) [K] over a square of pixels."""
    square = {
        "y": slice(row - reach, row + reach + 1),
        "x": slice(column - reach, column + reach + 1),
    }
    on = scene["on_object"].isel(square)
    if min(row, column) < reach or on.size < (2 * reach + 1) ** 2 or not on.all():
        raise ValueError(
            f"Invalid thermocouple at row {row}, column {column}: its bead reaches beyond the "
            "object. Must lie on it."
        )
    return np.asarray(scene["object_temperature"].isel(square).mean(("y", "x")).values)


def table(height: float = 0.0) -> Actor:
    """A table at room temperature with its top at a height [m]; it hides all below it."""
    top = trimesh.creation.box((1.2, 0.7, 0.03)).apply_translation((0.0, 0.0, height - 0.016))
    return painted([(top, AMBIENT)])


WALKS: Final = (
    ((-1.8, -1.1), (-0.2, -1.2), (1.8, -1.1)),
    ((0.4, -1.6), (1.4, -1.4), (1.2, 1.2), (-1.3, 1.3)),
)
"""Routes of two people, x and y from the object [m]: one behind the camera, one all around."""


def passers_by(time: Array, rng: np.random.Generator) -> list[Actor]:
    """Two people who walk back and forth near the object, on the floor below the table."""
    routes = [pacing(corners, time, rng) for corners in WALKS]
    return [part for route in routes for part in person(route, height=-TABLE)]


def since(
    start: float,
    mesh: trimesh.Trimesh,
    wall: tuple[float, heat.Solid],
    time: Array,
    exchanges: Sequence[heat.Exchange],
) -> Array:
    """
    Temperature (time, vertex) [K] of a thin-walled object at the times [s] of a capture.

    Until the start [s] all was at room temperature; from then on the wall, of a thickness [m] and
    a solid, has its exchanges.
    """
    shell = heat.Shell(mesh.vertices, mesh.faces, *wall)
    before = np.array([start]) if start < time[0] else np.empty(0)
    times = np.concatenate([before, time])
    return heat.simulate(shell, times, AMBIENT, exchanges, step=STEP)[before.size :]
