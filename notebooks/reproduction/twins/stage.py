"""Stage of a twin, its scene and thermocouples, and what two cameras record of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import trimesh
import xarray as xr
from scipy.special import ndtr

from dbthermal import alignment, schema, simulation
from dbthermal._arrays import Array
from reproduction import heat
from reproduction.disturbances import by_cameras
from reproduction.twins.people import pacing, person
from reproduction.twins.rays import Camera, Caster, unit
from reproduction.twins.surroundings import Actor, incident, painted

AMBIENT: Final = 295.15  # temperature of the room, of its air, and of all that is not heated [K]
TABLE: Final = 0.75  # height of the table that the objects stand on [m]
STEP: Final = 0.1  # longest step of the heat transport [s]

_WHOLE: Final = 0.99  # share of a pixel's light from which it shows nothing but the object [1]
_TAIL: Final = 4.0  # standard deviations of the blur beyond which a lens sends no light
_FRAMES: Final = 25  # frames that are ray-traced at once, for the memory
# Newton's method: steps, length of a difference, longest step, and last step [pixel].
_NEWTON, _SLOPE, _LARGEST, _CONVERGED = 30, 0.05, 3.0, 3e-3
_DAMPING: Final = 1e-3  # share of the squared slopes that is added to them


def clock(frames: int = 350, rate: float = 10.0) -> Array:
    """Times (frame,) of a capture from 0 on [s], at a frame rate [Hz]."""
    return np.arange(frames) / rate


@dataclass(frozen=True)
class Capture:
    """Recording conditions of a twin: emissivity, image size, times, baseline and sharpness.

    The lens's blur is taken as Gaussian. Diffraction alone gives 0.42 wavelengths times the
    f-number: 0.35 pixel of 12 um at 10 um and f/1; with aberrations and the focus of a real lens
    0.5 to 0.7. With three rays a pixel along either side a body's outline is drawn to 0.05 pixel.
    """

    emissivity: xr.DataArray  # of the object (band) [1], the band of the first camera first
    shape: tuple[int, int] = (144, 192)  # rows and columns
    time: Array = field(default_factory=clock)  # (time,) [s]
    baseline: float = 0.0  # how far the second camera is to the right of the first [m]
    blur: float = 0.6  # standard deviation [pixel]
    rays: int = 3  # for each pixel along either side


@dataclass(frozen=True)
class Stage:
    """Object, camera and surroundings of a twin.

    Name; mesh of the object [m] and its temperature (time, vertex) [K]; first camera; bodies that
    move, or stand, around it; points (thermocouple, 3) of the surface with thermocouples [m]; how
    far from the object's surface lies what it mirrors, for the true shift of the reflections [m].
    """

    name: str
    mesh: trimesh.Trimesh
    temperature: Array
    camera: Camera
    actors: Sequence[Actor]
    thermocouples: npt.ArrayLike = ()
    mirrored: float = 1.2


def take(stage: Stage, capture: Capture) -> xr.Dataset:
    """Scene of a stage, ray-traced, through the lens and averaged over the pixels.

    A scene for `observe`, and in addition `object_share` (y, x), the share of a pixel's light that
    comes from the object; `on_object` (y, x), where that is all; and `thermocouple_y`,
    `thermocouple_x` (thermocouple): rows and columns of the virtual thermocouples, which the camera
    must see (ValueError). Beside the object, the object temperature is that of the background seen
    directly there, which makes the emissivity, defined everywhere, irrelevant. A concave object's
    reflection in itself is of its own temperature (one bounce).

    Temperatures are blurred, instead of radiances: at an outline 10 K warmer than the room that is
    0.1 K too cold, in both bands. With a baseline, the temperatures that the second camera sees, at
    its own pixels, are `second_object_temperature` and `second_background_temperature`; at the
    first camera's pixels (y, x) stand `place_in_second` (axis) [pixel], where the second sees the
    same point of the surface, NaN if it does not, and `shift` (axis) [pixel], where the first sees
    what the second sees reflected here (`alignment.reflection_shift`), of bodies at the distance
    that the stage says.
    """
    caster = Caster(stage.mesh)
    warm, cold, share = _rendered(stage, capture, caster, stage.camera)
    scene = simulation.scene(capture.time, warm, cold, capture.emissivity)
    scene["object_share"] = (("y", "x"), share, {"units": "1"})
    scene["on_object"] = (("y", "x"), share > _WHOLE, {"units": "1"})
    if capture.baseline:
        second = stage.camera.beside(capture.baseline)
        dims = scene["object_temperature"].dims
        warm, cold, _ = _rendered(stage, capture, caster, second)
        for name, film in (("object", warm), ("background", cold)):
            scene[f"second_{name}_temperature"] = (dims, film.astype(np.float32), {"units": "K"})
        maps = _seen_by_both(stage, caster, second)
        for name, film in zip(("place_in_second", "shift"), maps, strict=True):
            scene[name] = (("axis", "y", "x"), film, {"units": "pixel"})
        scene = scene.assign_coords(axis=["y", "x"])
    # Pixels of the thermocouples.
    points = np.reshape(stage.thermocouples, (-1, 3)).astype(np.float64)
    rows, columns = np.rint(stage.camera.project(points)).astype(np.int64).T
    seen = caster.visible(points, stage.camera.position)
    for row, column, visible in zip(rows, columns, seen, strict=True):
        label = f"Invalid thermocouple at row {row}, column {column}"
        if not (row in scene["y"] and column in scene["x"] and scene["on_object"][row, column]):
            rule = f"Must be on the object, in an image of {stage.camera.shape}"
            raise ValueError(f"{label}. {rule}.")
        if not visible:
            rule = "Must be seen by the camera"
            raise ValueError(f"{label}, behind another part of the object. {rule}.")
    for name, places in (("thermocouple_y", rows), ("thermocouple_x", columns)):
        scene[name] = ("thermocouple", places, {"units": "1", "long_name": name})
    return scene.assign_attrs(twin=stage.name, baseline=capture.baseline)


def _rendered(
    stage: Stage, capture: Capture, caster: Caster, camera: Camera
) -> tuple[Array, Array, Array]:
    """What is emitted and what is reflected (time, y, x) [K], and the object's share (y, x) [1]."""
    rays, (rows, columns) = capture.rays, camera.shape
    # Each row of rays lies a little further right, that upright outlines meet many columns.
    shear = (np.arange(rays) - (rays - 1) / 2.0) / rays**2
    down = _optics(rows, capture)
    right = [_optics(columns, capture, offset) for offset in shear]
    places = np.empty((rows * rays, columns * rays, 2))
    places[..., 0] = _places(rows, rays)[:, np.newaxis]
    places[..., 1] = _places(columns, rays) + np.tile(shear, rows)[:, np.newaxis]
    directions = camera.directions(places.reshape(-1, 2))
    origins = np.array(np.broadcast_to(np.asarray(camera.position), directions.shape))
    hits = caster.cast(origins, directions)
    on, seen = hits.met, hits.select(hits.met)
    origins[on], directions[on] = caster.mirrored(seen, directions[on])
    reflections = caster.cast(origins[on], directions[on])
    itself, bounced = np.flatnonzero(on)[reflections.met], reflections.select(reflections.met)

    def pixels(values: Array) -> Array:
        grid = values.reshape(-1, rows * rays, columns * rays)
        terms = (down[:, n::rays] @ (grid[:, n::rays] @ right[n].T) for n in range(rays))
        return np.asarray(sum(terms))

    warm, cold = np.empty((2, capture.time.size, *camera.shape))
    for start in range(0, capture.time.size, _FRAMES):
        frames = slice(start, start + _FRAMES)
        values = incident(origins, directions, capture.time[frames], AMBIENT, stage.actors)
        values[:, itself] = caster.interpolate(bounced, stage.temperature[frames])
        cold[frames] = pixels(values)
        values[:, on] = caster.interpolate(seen, stage.temperature[frames])
        warm[frames] = pixels(values)
    return warm, cold, pixels(on.astype(np.float64))[0]


def _places(size: int, rays: int) -> Array:
    """Places (ray,) of the rays of a row or column [pixel]."""
    return np.asarray((np.arange(size * rays) + 0.5) / rays - 0.5)


def _optics(size: int, capture: Capture, offset: float = 0.0) -> Array:
    """Weights (pixel, ray) of the rays along a row or column: a pixel's square, blurred."""
    away = _places(size, capture.rays) + offset - np.arange(size)[:, np.newaxis]
    weights = ndtr((away + 0.5) / capture.blur) - ndtr((away - 0.5) / capture.blur)
    weights[abs(away) > 0.5 + _TAIL * capture.blur] = 0.0
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _seen_by_both(stage: Stage, caster: Caster, second: Camera) -> tuple[Array, Array]:
    """Where the second camera sees a surface point, and where the first sees its reflection."""
    camera, shape = stage.camera, (2, *stage.camera.shape)
    hits = caster.cast(np.asarray(camera.position), camera.directions())
    points = caster.points(hits.select(hits.met))
    seen = caster.visible(points, second.position)
    met, points = np.flatnonzero(hits.met)[seen], points[seen]
    places, shift = np.full((2, 2, hits.met.size), np.nan)
    places[:, met] = second.project(points).T
    towards = unit(points - np.asarray(second.position))
    way = caster.cast(np.asarray(second.position), towards)
    origins, directions = caster.mirrored(way, towards)
    pixels = np.stack(np.unravel_index(met, camera.shape), axis=-1).astype(np.float64)
    place = _reflecting(caster, camera, pixels, origins + stage.mirrored * directions)
    shift[:, met] = (place - pixels).T
    return places.reshape(shape), shift.reshape(shape)


def _reflecting(caster: Caster, camera: Camera, start: Array, bodies: Array) -> Array:
    """Pixels (point, 2) in which a camera sees points reflected, by Newton's method, else NaN."""
    # Two directions across the way to each body, in which a reflected ray may miss it.
    across = np.linalg.svd(unit(bodies)[:, np.newaxis])[2][:, 1:]

    def miss(place: Array) -> Array:
        directions, result = camera.directions(place), np.full_like(place, np.nan)
        hits = caster.cast(np.asarray(camera.position), directions)
        origins, reflected = caster.mirrored(hits.select(hits.met), directions[hits.met])
        gap = reflected - unit(bodies[hits.met] - origins)
        result[hits.met] = np.einsum("pax,px->pa", across[hits.met], gap)
        return result

    place = start.copy()
    for _ in range(_NEWTON):
        gap, steps = miss(place), _SLOPE * np.eye(2)
        slope = np.stack([(miss(place + step) - gap) / _SLOPE for step in steps], axis=-1)
        # Damped, for along an edge that is straight the reflection hardly changes.
        normal = np.einsum("pai,paj->pij", slope, slope)
        normal += _DAMPING * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        solvable, step = np.isfinite(normal).all(axis=(1, 2)), np.full_like(place, np.nan)
        towards = -np.einsum("pai,pa->pi", slope, gap)[solvable, :, np.newaxis]
        step[solvable] = np.linalg.solve(normal[solvable], towards)[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        place = place + step / np.maximum(1.0, length / _LARGEST)
    return np.where(length < _CONVERGED, place, np.nan)


def thermocouple_readings(
    scene: xr.Dataset,
    rng: np.random.Generator,
    *,
    std: float = 0.05,
    offset_std: float = 0.1,
    bead: int = 3,
) -> xr.DataArray:
    """Readings (thermocouple, time) [K] of the virtual thermocouples of a twin: means over a bead.

    The errors are of a single reading (`std`) and constant of a probe (`offset_std`) [K]; 0.1 is a
    probe that was compared with a reference, 0.5 one that was not. A bead covers a square of an odd
    number of pixels along a side, all on the object; else a ValueError.
    """
    if bead < 1 or bead % 2 == 0:
        raise ValueError(f"Invalid bead {bead} pixels. Must be odd and positive.")
    readings, reach = [], bead // 2
    centres = (scene[f"thermocouple_{axis}"].values for axis in ("y", "x"))
    for row, column in zip(*centres, strict=True):
        rows, columns = (slice(it - reach, it + reach + 1) for it in (row, column))
        square = scene.isel(y=rows, x=columns)
        on = square["on_object"]
        if min(row, column) < reach or on.size < (2 * reach + 1) ** 2 or not on.all():
            label = f"Invalid thermocouple at row {row}, column {column}"
            raise ValueError(f"{label}: its bead reaches beyond the object. Must lie on it.")
        readings.append(square["object_temperature"].mean(("y", "x")).values)
    size = (len(readings), scene.sizes["time"])
    error = rng.normal(0.0, offset_std, (len(readings), 1)) + rng.normal(0.0, std, size)
    return xr.DataArray(
        np.reshape(readings, size) + error,
        dims=("thermocouple", "time"),
        coords={"time": scene["time"]},
        attrs=schema.STAGES["separated"]["object_temperature"].attrs,
        name="thermocouple_temperature",
    )


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
    return [actor for route in routes for actor in person(route, height=-TABLE)]


def since(
    start: float,
    mesh: trimesh.Trimesh,
    wall: tuple[float, heat.Solid],
    time: Array,
    exchanges: Sequence[heat.Exchange],
) -> Array:
    """Temperature (time, vertex) [K] of a thin-walled object at the times [s] of a capture.

    Until the start [s] all was at room temperature; from then on the wall, of a thickness [m] and
    a solid, has its exchanges.
    """
    shell = heat.Shell(mesh, *wall)
    before = np.array([start]) if start < time[0] else np.empty(0)
    times = np.concatenate([before, time])
    return heat.simulate(shell, times, AMBIENT, exchanges, step=STEP)[before.size :]


Registration = Literal["perfect", "found"]


def observe(scene: xr.Dataset, response: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """Capture of a twin, as `simulation.observe`: each band at the pixels of its own camera."""
    if not scene.attrs["baseline"]:
        return simulation.observe(scene, response, rng)
    names = ("object_temperature", "background_temperature")
    second = scene.assign({name: scene[f"second_{name}"] for name in names})
    return by_cameras((scene, second), response, rng)


def registered(
    scene: xr.Dataset, corrected: xr.Dataset, registration: Registration = "perfect"
) -> xr.Dataset:
    """Capture with all views on the first camera's grid, by `alignment.align`.

    A registration is "perfect", by the surface's geometry: each pixel shows the same point of the
    surface in both bands, NaN where the second camera does not see it, and beside the object; or
    "found" from the pictures, by `alignment.register`. The views of one place stay as they are.
    """
    if not scene.attrs["baseline"]:
        return corrected
    if registration == "found":
        return alignment.align(corrected, offset=0.0, transform=alignment.register(corrected))
    # Rows and columns (band, axis, y, x) [pixel] of the surface's points in each view.
    second = scene["place_in_second"]
    first = xr.zeros_like(second).copy(data=np.indices(scene["on_object"].shape))
    places = xr.concat([first, second], scene["band"])
    return alignment.align(corrected, offset=0.0, transform=places)
