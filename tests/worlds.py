"""Scenes as the world has them: optics, people, cameras and noise that the paper does not assume.

A maker of its own, beside the library's: films by Gaussian optics and splines, and people as soft
upright shapes. Glass is warmed up, and on the right coated, before five or six people.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.interpolate import interp1d
from scipy.ndimage import affine_transform, gaussian_filter, median_filter
from scipy.special import expit

from dbthermal import response as responses
from dbthermal import schema, simulation

Array = np.ndarray[Any, np.dtype[Any]]
Pair = tuple[float, float]

RIG: Final = simulation.Rig()
RESPONSE: Final = RIG.response()
CURVES: Final = responses.curves(RESPONSE, list(RIG.bands))
SHAPE, MARGIN, FRAMES, RATE = (48, 64), 6, 280, 10.0
ROOM: Final = 295.0  # K


@dataclass(frozen=True)
class World:
    """What a scene has beside the paper's assumptions."""

    noise: Pair = (RIG.noise[0], RIG.noise[1])  # [K]
    blur: Pair = (0.0, 0.0)  # of the lenses [pixel]
    median: tuple[int, int] = (1, 1)  # side of the median filter in each camera [pixel]
    roughness: Pair = (0.0, 0.0)  # blur of what is mirrored [pixel]
    shake: Pair = (0.0, 0.0)  # of the cameras, correlated over 0.15 s [pixel]
    off: float = 0.0  # columns by which the second image lies beside the first [pixel]
    turn: float = 0.0  # of the cameras together about their axis, as they shake [degree]
    sway: float = 0.0  # of their distance, as a share of it [1]
    drift: Pair = (0.0, 0.0)  # of the cameras' pointing along the rows, over the capture [pixel]
    detail: float = 0.0  # of the emissivity [1]
    fabric: Pair | None = None  # emissivities of every second person [1]
    flicker: float = 0.0  # corner frequency of 1/f noise of each pixel [Hz]
    level: Pair = (0.0, 0.0)  # white noise that each frame of a band has in common [K]
    wander: Pair = (0.0, 0.0)  # of each band's level, correlated over 10 s [K]
    lamp: float = 0.0  # amplitude of a spot that is heated at 0.4 Hz [K]
    behind: Pair | None = None  # transmittances, with other people behind [1]
    breath: float = 0.0  # motion of the object at 0.25 Hz [pixel]
    surface: tuple[Pair, Pair] = ((0.86, 0.72), (0.93, 0.82))  # emissivities, left and right
    smooth: bool = False  # one warm spot, and a straight border of the materials
    rate: float = RATE  # of the frames [Hz]
    pace: Pair = (8.0, 20.0)  # of the people [pixel/s]
    together: bool = False  # people all go in one direction
    parallax: float = 0.0  # columns by which the second camera sees what is mirrored displaced
    lag: float = 0.0  # of the second band's frames [s], which are stamped or not
    stamped: bool = False
    jitter: float = 0.0  # of each camera's frames, not stamped [s]
    fast: float = 0.0  # share by which the second camera's clock runs slow, and it too late [1]

    @property
    def clocks(self) -> bool:
        """Two cameras, or bands, whose frames are not known to be of one time."""
        return any((self.parallax, self.lag, self.jitter, self.fast))


Shape = Callable[[Array, float], Array]


def people(rng: np.random.Generator, world: World, number: int) -> Iterator[tuple[Shape, float]]:
    """Yield the share (time, y, x) of each pixel that shows a person, and its warmth [K].

    The share is a function of the times [s] and of the columns by which it is seen displaced.
    """
    y, x = np.indices([size + 2 * MARGIN for size in SHAPE])
    for _ in range(number):
        speed, direction = rng.uniform(*world.pace), rng.choice([-1.0, 1.0])
        speed *= 1.0 if world.together else direction
        start, phase = rng.uniform(0.03, 0.92) * (FRAMES - 1) / world.rate, rng.uniform(0.0, 6.0)
        half, top = rng.uniform(4.0, 8.0), rng.uniform(-0.1, 0.4) * len(y)

        def shape(time: Array, shift: float, own: tuple[float, ...]) -> Array:
            speed, start, phase, half, top = own
            center = 0.5 * x.shape[1] + speed * (time - start) + shift
            center = center + 1.5 * np.sin(np.pi * time + phase)
            beside = np.abs(x - center[:, np.newaxis, np.newaxis]) - half
            return np.asarray(expit(-beside / 0.7) * expit((y - top) / 0.7))

        yield partial(shape, own=(speed, start, phase, half, top)), rng.uniform(5.0, 10.0)


def paths(rng: np.random.Generator, sizes: Pair) -> Array:
    """Motion (camera, time, 2) of 1, correlated in time; cameras of the same size move together."""
    memory = np.exp(-1.0 / RATE / 0.15)
    steps = rng.normal(0.0, 1.0, (2, FRAMES, 2))
    for frame in range(1, FRAMES):
        steps[:, frame] = memory * steps[:, frame - 1] + np.sqrt(1 - memory**2) * steps[:, frame]
    steps[1] = steps[0] if sizes[0] == sizes[1] else steps[1]
    return np.asarray(steps * np.reshape(sizes, (2, 1, 1)))


def moved(image: Array, step: Array, turn: float = 0.0, sway: float = 0.0) -> Array:
    """Image at a place [pixel], turned [rad] and enlarged [1], between its pixels by splines."""
    if not (np.any(step) or turn or sway):
        return image
    cosine, sine = np.cos(turn) / (1.0 + sway), np.sin(turn) / (1.0 + sway)
    matrix = np.array([[cosine, -sine], [sine, cosine]])
    middle = 0.5 * (np.array(image.shape) - 1.0)
    offset = middle - matrix @ (middle + step)
    return np.asarray(affine_transform(image, matrix, offset, order=3, mode="nearest"))


def seen(world: World, seed: int) -> tuple[xr.Dataset, Array]:
    """Capture of a world, and the object's temperature (time, y, x) [K]."""
    rng = np.random.default_rng(seed)
    size = tuple(side + 2 * MARGIN for side in SHAPE)
    y, x = np.indices(size)
    time = np.arange(FRAMES) / world.rate
    # The object: two materials, warmed unevenly.
    spot = np.exp(-np.hypot(y - 0.5 * size[0], x - 0.5 * size[1]) / 12.0)
    coated = x > (39.5 + MARGIN if world.smooth else 0.55 * size[1] + 3.0 * np.sin(y / 9.0))
    texture = gaussian_filter(rng.standard_normal(size), 1.2)
    texture *= world.detail / texture.std()
    emissivity = [
        np.where(coated, right, left) + (1.0 + 0.3 * band) * texture
        for band, (left, right) in enumerate(zip(*world.surface, strict=True))
    ]
    warmth = gaussian_filter(spot if world.smooth else rng.standard_normal(size), 9.0)
    warmth = 5.0 + 20.0 * (warmth - warmth.min()) / np.ptp(warmth)
    rise = 1.0 - np.exp(-2.0 * time / time[-1]) + 0.08 * np.sin(5.0 * time / time[-1])
    truth = ROOM + 1.5 + rise[:, np.newaxis, np.newaxis] * warmth
    truth += world.lamp * np.sin(0.8 * np.pi * time)[:, np.newaxis, np.newaxis] * spot
    # What it mirrors, and what is behind it.
    before, beyond = list(people(rng, world, 6)), list(people(rng, world, 4))
    motion = paths(rng, world.shake)
    held = [np.deg2rad(world.turn), world.sway] * paths(np.random.default_rng([seed, 2]), (1, 1))[0]
    motion[..., 1] += np.outer(world.drift, time / time[-1] - 0.5)
    motion[1, :, 1] += world.off
    times = np.stack([time, (time + world.lag) * (1.0 + world.fast)])
    if world.jitter:
        times = times + world.jitter * np.random.default_rng([seed, 1]).standard_normal(times.shape)
    common = levels(np.random.default_rng([seed, 3]), world)
    breath = world.breath * np.outer(np.sin(0.5 * np.pi * time), [1.0, 0.3])
    film = np.empty((2, FRAMES, *SHAPE), dtype=np.float32)
    inside = slice(MARGIN, -MARGIN)
    for band, curve in enumerate(CURVES):
        room = curve.counts(ROOM)
        views = []
        for group, fabric in ((before, world.fabric), (beyond, None)):
            view = np.full(truth.shape, room)
            for number, (person, warmer) in enumerate(group):
                share = person(times[band], world.parallax * band)
                skin = fabric[band] if fabric is not None and number % 2 == 0 else 1.0
                view += share * (room + skin * (curve.counts(ROOM + warmer) - room) - view)
            views.append(view)
        clear = world.behind[band] if world.behind is not None else 0.0
        film_of_object = truth
        if np.any(times[band] != time):
            film_of_object = interp1d(time, truth, axis=0, fill_value="extrapolate")(times[band])
        noise = noise_of(rng, world.flicker) * world.noise[band] + common[band]
        noise *= curve.reference_slope
        for frame in range(FRAMES):
            share, warm = (
                moved(image, breath[frame]) for image in (emissivity[band], film_of_object[frame])
            )
            front = gaussian_filter(views[0][frame], world.roughness[band])
            image = share * curve.counts(warm) + (1.0 - share - clear) * front
            image = gaussian_filter(image + clear * views[1][frame], world.blur[band])
            view = moved(image, motion[band, frame], *held[frame])[inside, inside]
            film[band, frame] = median_filter(view + noise[frame], world.median[band])
    coordinates = {
        "band": list(RIG.bands),
        "time": ("time", time, {"units": "s"}),
        "y": np.arange(SHAPE[0]),
        "x": np.arange(SHAPE[1]),
    }
    capture = xr.Dataset(schema.variables("corrected", {"counts": film}), coordinates)
    if world.stamped:
        capture["exposure_time"] = ("band", "time"), times, {"units": "s"}
    return capture.assign_attrs(origin="simulated"), truth[:, inside, inside]


def levels(rng: np.random.Generator, world: World) -> Array:
    """Noise (band, time, 1, 1) [K] that whole frames have in common, of mean zero."""
    memory = np.exp(-1.0 / RATE / 10.0)
    steps = rng.standard_normal((2, FRAMES))
    for frame in range(1, FRAMES):
        steps[:, frame] *= np.sqrt(1.0 - memory**2)
        steps[:, frame] += memory * steps[:, frame - 1]
    steps -= steps.mean(axis=1, keepdims=True)
    white = rng.standard_normal(steps.shape) * np.reshape(world.level, (2, 1))
    return np.asarray(
        (white + steps * np.reshape(world.wander, (2, 1)))[..., np.newaxis, np.newaxis]
    )


def noise_of(rng: np.random.Generator, corner: float) -> Array:
    """White noise (time, y, x) of 1, and 1/f noise that is as strong at a frequency [Hz]."""
    white = rng.standard_normal((FRAMES, *SHAPE))
    if corner == 0.0:
        return white
    frequency = np.fft.rfftfreq(FRAMES, 1.0 / RATE)[:, np.newaxis, np.newaxis]
    spectrum = np.fft.rfft(rng.standard_normal(white.shape), axis=0)
    spectrum *= np.sqrt(np.where(frequency > 0.0, corner / np.maximum(frequency, 1e-9), 0.0))
    return white + np.fft.irfft(spectrum, FRAMES, axis=0)
