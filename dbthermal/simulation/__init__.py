"""Simulated captures with known truth: scenes and cameras.

Begin with `walkers` and `observe`: a scene, and the counts that a `Rig` records of it. All results
carry `origin = "simulated"`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, _text, planck, schema
from dbthermal._arrays import Array
from dbthermal.simulation._rig import Rig, blackbody_movies, capture, digitise, observe, pattern

__all__ = [
    "Background",
    "Rig",
    "blackbody_movies",
    "capture",
    "digitise",
    "heating",
    "independent_pixels",
    "observe",
    "pattern",
    "scene",
    "side_by_side",
    "walkers",
]
__dir__ = __all__.copy

_BACKGROUNDS: Final = ("pulses", "random walk", "still")


@dataclass(frozen=True)
class Background:
    """Temporal variation of the background.

    Attributes
    ----------
    kind : {"pulses", "random walk", "still"}
        People who walk by now and then; a background that never rests (a first-order
        autoregressive process); or a constant one.
    level, drift : float
        Resting temperature, and its change over the capture, linear in time [K].
    amplitude, correlation_time : float
        Height of a pulse, or standard deviation of the walk [K]; correlation time of the walk [s].
    count, duration : tuple of int, tuple of float
        Fewest and most pulses in the capture; shortest and longest pulse [s].
    """

    kind: str = "pulses"
    level: float = 295.15
    amplitude: float = 3.0
    count: tuple[int, int] = (6, 9)
    duration: tuple[float, float] = (1.0, 3.0)
    correlation_time: float = 3.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        _text.check_listed("Unknown background", self.kind, _BACKGROUNDS)
        _numbers.real_number("level [K]", self.level, _numbers.KELVIN)
        for name in ("amplitude", "drift"):
            _numbers.real_number(f"{name} [K]", getattr(self, name), _numbers.FINITE)
        for name in ("count", "duration"):
            _numbers.real_numbers(name, getattr(self, name), (0.0, schema.LARGEST), (2,))
        if not 0 <= self.count[0] <= self.count[1]:
            raise ValueError(f"Invalid count {self.count} of pulses. Must be two, not falling.")
        if not 0 < self.duration[0] <= self.duration[1]:
            raise ValueError(f"Invalid duration {self.duration} s. Must be positive, not falling.")
        _numbers.real_number("correlation_time [s]", self.correlation_time, _numbers.POSITIVE)

    def draw(self, time: Array, pixels: int, rng: np.random.Generator) -> Array:
        """Background temperature (time, pixel) [K], one realisation a pixel, at times [s]."""
        increasing(time, "a background")
        change = np.zeros((time.size, pixels))
        if self.kind == "pulses":
            number = rng.integers(self.count[0], self.count[1] + 1, pixels)
            for pulse in range(self.count[1]):
                start = rng.uniform(time[0], time[-1], pixels)
                stop = start + rng.uniform(*self.duration, pixels)
                active = (time[:, np.newaxis] >= start) & (time[:, np.newaxis] < stop)
                # Pulses beyond the pixel's number are drawn, but not added.
                change += self.amplitude * (active & (pulse < number))
        elif self.kind == "random walk":
            change = self._walk(time, pixels, rng)
        ramp = self.drift * (time - time[0]) / (time[-1] - time[0])
        return np.asarray(self.level + ramp[:, np.newaxis] + change)

    def _walk(self, time: Array, pixels: int, rng: np.random.Generator) -> Array:
        change = np.empty((time.size, pixels))
        change[0] = rng.standard_normal(pixels)
        for frame in range(1, time.size):
            # AR(1) of unit variance: correlation exp(-dt / correlation_time) from frame to frame.
            kept = np.exp(-(time[frame] - time[frame - 1]) / self.correlation_time)
            fresh = np.sqrt(1.0 - kept**2) * rng.standard_normal(pixels)
            change[frame] = kept * change[frame - 1] + fresh
        return self.amplitude * change


def heating(time: Array, start: float, stop: float, time_constant: npt.ArrayLike) -> Array:
    r"""Temperature (time, ...) [K] of a body that relaxes exponentially, over the capture.

    .. math:: T(t) = T_0 + (T_1 - T_0) \frac{1 - e^{-t / \tau}}{1 - e^{-t_1 / \tau}}

    the solution of Newton's law of heating, the object prior of the paper
    (doi:10.48550/arXiv.2509.11334).

    Parameters
    ----------
    time, time_constant : ndarray, array_like
        Times (time,) [s], two or more, increasing; time constants (...), positive [s].
    start, stop : float
        First and last temperature [K].

    Examples
    --------
    >>> heating(np.array([0.0, 10.0, 20.0]), 293.15, 313.15, 10.0).round(2).tolist()
    [293.15, 307.77, 313.15]
    """
    increasing(time, "a heating")
    constant = planck.require_positive("time_constant [s]", time_constant)
    elapsed = (time - time[0]).reshape(-1, *(1,) * constant.ndim)
    # expm1 keeps the digits of a capture that is short against the time constant.
    rise = np.expm1(-elapsed / constant) / np.expm1(-elapsed[-1] / constant)
    return np.asarray(start + (stop - start) * rise)


def scene(
    time: Array, object_temperature: Array, background_temperature: Array, emissivity: xr.DataArray
) -> xr.Dataset:
    """Scene of given temperatures: the truth of a simulated capture.

    Parameters
    ----------
    time, object_temperature, background_temperature : Array
        Times (time,) [s], two or more, increasing; temperatures (time, y, x), positive [K].
    emissivity : DataArray
        Emissivity (band) or (band, y, x), in [0, 1], or a ValueError [1].

    Returns
    -------
    Dataset
        Names, dims and units of the stage `separated` without its deviations.
    """
    increasing(time, "a scene")
    planck.require_positive("object_temperature [K]", object_temperature)
    planck.require_positive("background_temperature [K]", background_temperature)
    schema.check_numbers(emissivity, "the emissivity", "1")
    _numbers.real_numbers("emissivity", emissivity.values, (0.0, 1.0))
    height, width = object_temperature.shape[1:]
    values = emissivity.values.reshape(emissivity.shape[0], *emissivity.shape[1:] or (1, 1))
    films = {
        "object_temperature": object_temperature,
        "background_temperature": background_temperature,
        "emissivity": np.broadcast_to(values, (emissivity.shape[0], height, width)),
    }
    axes = {"band": emissivity["band"].values, "time": ("time", time, {"units": "s"})}
    axes |= {"y": np.arange(height), "x": np.arange(width)}
    return xr.Dataset(schema.variables("separated", films), axes, {"origin": "simulated"})


def side_by_side(emissivity: xr.DataArray, shape: tuple[int, int]) -> xr.DataArray:
    """Emissivity (band, y, x) [1] of panels of equal width, one a material.

    Parameters
    ----------
    emissivity, shape : DataArray, tuple of int
        Emissivity (material, band) [1]; rows and columns of the image.
    """
    panel = np.arange(shape[1]) * emissivity.sizes["material"] // shape[1]
    columns = emissivity.values[panel].T[:, np.newaxis, :]
    image = np.broadcast_to(columns, (emissivity.sizes["band"], *shape))
    axes = {"band": emissivity["band"].values}
    return xr.DataArray(image, axes, ("band", "y", "x"), attrs={"units": "1"})


def independent_pixels(
    time: Array,
    emissivity: xr.DataArray,
    background: Background,
    pixels: int,
    rng: np.random.Generator,
    *,
    start: float,
    stop: float,
    time_constant: tuple[float, float] = (8.0, 20.0),
) -> xr.Dataset:
    """Scene of one row of pixels of one material, each with its own heating and background.

    Parameters
    ----------
    time, emissivity : ndarray, DataArray
        Times (time,) [s]; emissivity (band) [1].
    background, pixels, rng : Background, int, Generator
        Variation of the background; number of pixels; source of randomness.
    start, stop, time_constant : float, float, tuple of float
        First and last object temperature [K]; range of the heating's time constant [s].
    """
    constants = rng.uniform(*time_constant, pixels)
    warm = heating(time, start, stop, constants)
    cold = background.draw(time, pixels, rng)
    return scene(time, warm[:, np.newaxis], cold[:, np.newaxis], emissivity)


def walkers(
    time: Array,
    shape: tuple[int, int],
    emissivity: xr.DataArray,
    rng: np.random.Generator,
    *,
    temperatures: Sequence[float] = (295.15, 305.15, 333.15),
    crossings: int = 7,
    time_constant: float = 12.0,
) -> xr.Dataset:
    """Plate, heated in its middle, that reflects people who walk by.

    Each person is an upright ellipse with a head, warmer than the room, that crosses the view once
    at a steady pace.

    Parameters
    ----------
    time, shape : ndarray, tuple of int
        Times (time,) [s]; rows and columns.
    emissivity : DataArray
        (band) or (band, y, x) [1].
    rng, crossings : Generator, int
        Source of the paths; number of people.
    temperatures, time_constant : sequence of float, float
        Temperatures of the room, of people, and of the plate's middle at the end [K]; time constant
        of the heating [s].

    Returns
    -------
    Dataset
        The scene, see `scene`.

    Examples
    --------
    >>> import numpy as np
    >>> from dbthermal import emissivity, simulation
    >>> table = emissivity.embedded_table()["emissivity"]
    >>> glass = table.sel(material="plate window glass", band=["8-14", "9.5"], drop=True)
    >>> rng = np.random.default_rng(1)
    >>> truth = simulation.walkers(np.arange(50) / 10.0, (24, 32), glass, rng)
    >>> capture = simulation.observe(truth, simulation.Rig().response(), rng)
    >>> dict(capture["counts"].sizes)
    {'band': 2, 'time': 50, 'y': 24, 'x': 32}
    """
    stated = _numbers.real_numbers("temperatures [K]", temperatures, _numbers.KELVIN, (3,))
    level, skin, hottest = stated
    rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    # Object: heated in its middle.
    profile = np.exp(-(rows**2 + columns**2) / (2 * 0.5**2))
    curve = heating(time, 0.0, hottest - level, time_constant)
    warm = level + curve[:, np.newaxis, np.newaxis] * profile
    cold = np.full(warm.shape, level)
    # Background: each person crosses the view once.
    places = np.arange(crossings) + rng.random(crossings)
    for start in time[0] + (time[-1] - time[0]) * places / crossings:
        # In either direction, from beyond the edge of the view.
        pace = rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.2)
        centre = np.sign(pace) * -1.6 + pace * (time - start)
        half = 0.30  # of the body's width
        visible = np.flatnonzero(np.abs(centre) < 1.0 + half)  # frames with the body in view
        distance = columns - centre[visible, np.newaxis, np.newaxis]
        # An ellipse each, in units of half the view.
        body = (distance / half) ** 2 + ((rows - 0.55) / 0.75) ** 2 < 1
        head = (distance / 0.14) ** 2 + ((rows + 0.35) / 0.2) ** 2 < 1
        cold[visible] = np.where(body | head, skin, cold[visible])
    return scene(time, warm, cold, emissivity)


def increasing(times: npt.ArrayLike, name: str) -> Array:
    """Checked times (time,) [s] of a named thing: two or more, finite, increasing."""
    array = _numbers.real_numbers(f"times [s] of {name}", times)
    if array.ndim != 1 or array.size < 2:
        raise ValueError(f"Invalid times of shape {array.shape} of {name}. Must be two or more.")
    # A NaN fails the comparison, too.
    wrong = np.flatnonzero(~np.isfinite(array) | ~(np.diff(array, prepend=-np.inf) > 0))
    if wrong.size:
        rule = "Must be finite, and increase strictly"
        raise ValueError(f"Invalid time {array[wrong[0]]} s of {name}. {rule}.")
    return array
