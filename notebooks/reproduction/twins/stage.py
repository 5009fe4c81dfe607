"""The stage of a twin: what is before the camera, and how a scene is taken of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal.simulation import _scenes as scenes
from dbthermal.simulation import heat
from dbthermal.simulation._mesh import Surface
from dbthermal.simulation._rays import Array, Camera, Caster, Hits, Mask
from dbthermal.simulation._surroundings import Actor, Room, distance, incident, painted
from dbthermal.simulation._times import increasing
from reproduction.twins import surfaces
from reproduction.twins.people import pacing, person

AMBIENT: Final = 295.15
"""Temperature of the room, of its air, and of whatever is not heated [K]."""
TABLE: Final = 0.75
"""Height of the table that the objects stand on [m]."""
STEP: Final = 0.1
"""Longest step of the heat transport [s]."""


def clock(frames: int = 350, rate: float = 10.0) -> Array:
    """
    Times of a capture.

    Parameters
    ----------
    frames : int
        Number of frames.
    rate : float
        Frames a second [1/s].

    Returns
    -------
    ndarray, shape (time,)
        Times from 0 [s].
    """
    return np.arange(frames) / rate


@dataclass(frozen=True)
class Capture:
    """
    How a twin is recorded.

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
        """Refuse an emissivity that is no list of bands, a baseline without two, a single frame."""
        increasing(self.time, "a capture")
        if self.emissivity.dims != ("band",):
            raise ValueError(f"Invalid dims {self.emissivity.dims} of emissivity. Must be (band,).")
        if self.baseline and self.emissivity.sizes["band"] != 2:
            names = [str(name) for name in self.emissivity["band"].values]
            raise ValueError(f"Invalid bands {names} for a baseline. Must be two.")


@dataclass(frozen=True)
class Stage:
    """
    What is before the camera.

    Attributes
    ----------
    name : str
        Name of the twin.
    surface : Surface
        The object.
    temperature : ndarray, shape (time, vertex)
        Its temperature [K].
    camera : Camera
        The first camera.
    actors : sequence of Actor
        What moves, or stands, around it.
    room : Room
        What is behind all of it.
    thermocouples : ndarray, shape (thermocouple, 3)
        Points of the surface where thermocouples are [m].
    """

    name: str
    surface: Surface
    temperature: Array
    camera: Camera
    actors: Sequence[Actor]
    room: Room
    thermocouples: npt.ArrayLike = ()


@dataclass(frozen=True)
class _View:
    """The object as one camera sees it: which pixels, where, and whether it is in the way."""

    caster: Caster
    directions: Array
    hits: Hits
    temperature: Array

    @property
    def on_object(self) -> Mask:
        return self.hits.met

    @property
    def seen(self) -> Hits:
        return self.hits.of(self.hits.met)


def take(stage: Stage, capture: Capture) -> xr.Dataset:
    """
    Take a scene.

    Parameters
    ----------
    stage : Stage
        What is before the camera.
    capture : Capture
        How it is recorded.

    Returns
    -------
    Dataset
        A scene as from `scenes.scene`, for `simulation.observe`, and in addition
        `on_object` (y, x), and `thermocouple_y`, `thermocouple_x` (thermocouple): rows and
        columns of the virtual thermocouples. Where the object is not, its temperature is that of
        the background seen directly there, which makes the emissivity, given everywhere,
        irrelevant. With a baseline `background_temperature` is (band, time, y, x), and
        `hidden_from_second` (y, x) marks the points that the second camera does not see; its
        background is that of the first there, and off the object. A concave object's reflection
        in itself is of its own temperature (one bounce).

    Raises
    ------
    ValueError
        If a thermocouple is not seen by the camera.
    """
    directions = stage.camera.directions()
    caster = Caster(stage.surface)
    hits = caster.cast(_repeated(stage.camera.position, directions), directions)
    view = _View(caster, directions, hits, stage.temperature)
    background = _background(stage, capture, view)
    emitted = background.copy()
    emitted[:, view.on_object] = caster.interpolate(view.seen, stage.temperature)
    warm, cold = (part.reshape(-1, *capture.shape) for part in (emitted, background))
    scene = scenes.scene(capture.time, warm, cold, capture.emissivity)
    scene["on_object"] = (("y", "x"), view.on_object.reshape(capture.shape), {"units": "1"})
    if capture.baseline:
        scene = _with_second(scene, stage, capture, view)
    scene = _with_thermocouples(scene, stage, caster)
    return scene.assign_attrs(twin=stage.name, baseline=capture.baseline)


def table(height: float = 0.0) -> Actor:
    """A table at room temperature with its top at a height [m]; it hides what is below it."""
    top = surfaces.box((1.2, 0.7, 0.03), 0.1)
    return painted([(surfaces.moved(top, translation=(0.0, 0.0, height - 0.031)), AMBIENT)])


WALKS: Final = (
    ((-1.8, -1.1), (-0.2, -1.2), (1.8, -1.1)),
    ((0.4, -1.6), (1.4, -1.4), (1.2, 1.2), (-1.3, 1.3)),
)
"""Ways of two people, x and y from the object [m]: one behind the camera, one all around."""


def passers_by(time: Array, rng: np.random.Generator) -> list[Actor]:
    """
    Two people who walk back and forth near the object, on the floor below the table.

    Parameters
    ----------
    time : ndarray, shape (time,)
        Times [s].
    rng : Generator
        Source of their ways.

    Returns
    -------
    list of Actor
        Their limbs.
    """
    routes = [pacing(way, time, rng) for way in WALKS]
    return [part for route in routes for part in person(route, height=-TABLE)]


def since(
    start: float, shell: heat.Shell, time: Array, exchanges: Sequence[heat.Exchange]
) -> Array:
    """
    Temperature of an object during a capture that something happened to before.

    Parameters
    ----------
    start : float
        When all was still at the temperature of the room [s].
    shell : heat.Shell
        The object.
    time : ndarray, shape (time,)
        Times of the capture [s].
    exchanges : sequence of heat.Exchange
        What it exchanges from the start on.

    Returns
    -------
    ndarray, shape (time, vertex)
        Temperature [K].
    """
    before = np.array([start]) if start < time[0] else np.empty(0)
    times = np.concatenate([before, time])
    return heat.simulate(shell, times, AMBIENT, exchanges, step=STEP)[before.size :]


def _background(stage: Stage, capture: Capture, view: _View) -> Array:
    """Temperature (time, pixel) [K] that the first camera sees mirrored, or directly."""
    origins, directions = _repeated(stage.camera.position, view.directions), view.directions.copy()
    on = view.on_object
    origins[on], directions[on] = view.caster.mirrored(view.seen, view.directions[on])
    result = incident(origins, directions, capture.time, stage.room, stage.actors)
    result[:, on] = _with_itself(view, origins[on], directions[on], result[:, on])
    return result


def _with_itself(view: _View, origins: Array, directions: Array, reflected: Array) -> Array:
    """Reflection (time, ray) [K] with the object's own where a mirrored ray meets it."""
    again = view.caster.cast(origins, directions)
    own = view.caster.interpolate(again.of(again.met), view.temperature)
    reflected[:, again.met] = own
    return reflected


def _with_second(scene: xr.Dataset, stage: Stage, capture: Capture, view: _View) -> xr.Dataset:
    """The scene with a background for each band, the second from a second camera."""
    other = stage.camera.beside(capture.baseline)
    points = view.caster.points(view.seen)
    way = points - np.asarray(other.position)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    seen = view.caster.visible(points, other.position)
    rays = view.caster.mirrored(view.seen, way)
    reflected = incident(*rays, capture.time, stage.room, stage.actors)
    reflected = _with_itself(view, *rays, reflected)
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
    for row, column, lit in zip(rows, columns, seen, strict=True):
        if not (row in scene["y"] and column in scene["x"] and scene["on_object"][row, column]):
            raise ValueError(
                f"Invalid thermocouple at row {row}, column {column}. Must be on the object, in "
                f"an image of {stage.camera.shape}."
            )
        if not lit:
            raise ValueError(
                f"Invalid thermocouple at row {row}, column {column}, behind another part of the "
                "object. Must be seen by the camera."
            )
    for name, places in (("thermocouple_y", rows), ("thermocouple_x", columns)):
        scene[name] = ("thermocouple", places, {"units": "1", "long_name": name})
    return scene


def _repeated(position: npt.ArrayLike, directions: Array) -> Array:
    return np.array(np.broadcast_to(np.asarray(position, dtype=np.float64), directions.shape))


def obstructed(stage: Stage, time: Array) -> Mask:
    """
    Pixels of the object that an actor hides from the camera at some time.

    A scene has no place for what is between the object and the camera: a twin must have none.

    Parameters
    ----------
    stage : Stage
        What is before the camera.
    time : ndarray, shape (time,)
        Times [s].

    Returns
    -------
    ndarray of bool, shape (y, x)
        True where an actor is nearer than the object.
    """
    directions = stage.camera.directions()
    origins = _repeated(stage.camera.position, directions)
    hits = Caster(stage.surface).cast(origins, directions)
    nearest = distance(origins, directions, time, stage.actors)
    return np.asarray((hits.met & (nearest < hits.distance)).reshape(stage.camera.shape))
