"""Simulated captures with known truth: scenes and cameras.

Begin with `walkers` and `observe`: a scene, and the counts that a `Rig` records of it. All results
carry `origin = "simulated"`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, _text, bands, calibration, correction, mixing, schema
from dbthermal import response as responses
from dbthermal._arrays import Array

__all__ = [
    "Background",
    "Rig",
    "blackbody_movies",
    "capture",
    "digitise",
    "heating",
    "observe",
    "pattern",
    "scene",
    "side_by_side",
    "walkers",
]
__dir__ = __all__.copy

Randomness = np.random.Generator | int  # or its seed

_BACKGROUNDS: Final = ("pulses", "random walk", "still")
_CALIBRATION_POINTS: Final = 25
_SLOPE_TEMPERATURE: Final = 300.0
_TEMPERATURES: Final = ("object_temperature", "background_temperature")


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

    def draw(self, time: Array, pixels: int, rng: Randomness) -> Array:
        """Background temperature (time, pixel) [K], one realisation a pixel, at times [s]."""
        time, rng = schema.rising_numbers(time, "times of a background", "s"), _generator(rng)
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
            change[0] = rng.standard_normal(pixels)
            for frame in range(1, time.size):
                # AR(1) of unit variance: correlation exp(-dt / correlation_time) from the last.
                kept = np.exp(-(time[frame] - time[frame - 1]) / self.correlation_time)
                fresh = np.sqrt(1.0 - kept**2) * rng.standard_normal(pixels)
                change[frame] = kept * change[frame - 1] + fresh
            change = self.amplitude * change
        ramp = self.drift * (time - time[0]) / (time[-1] - time[0])
        return np.asarray(self.level + ramp[:, np.newaxis] + change)


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
    time = schema.rising_numbers(time, "times of a heating", "s")
    start, stop = _numbers.real_numbers("start and stop [K]", (start, stop), _numbers.FINITE, (2,))
    constant = _numbers.real_numbers("time_constant [s]", time_constant, _numbers.POSITIVE)
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
        Times (time,) [s], two or more, increasing; temperatures (time, y, x), 150 to 3000 [K].
    emissivity : DataArray
        Emissivity (band) or (band, y, x), in [0, 1] [1], with the names of the bands.

    Returns
    -------
    Dataset
        Names, dims and units of the stage `separated` without its deviations.
        TypeError or ValueError if an input is not as described.
    """
    time = schema.rising_numbers(time, "times of a scene", "s")
    pair = object_temperature, background_temperature
    films: dict[str, Any] = dict(zip(_TEMPERATURES, pair, strict=True))
    size = (time.size, *np.shape(object_temperature)[1:], 1, 1)[:3]
    for name, film in films.items():
        films[name] = _numbers.real_numbers(f"{name} [K]", film, _numbers.KELVIN, size)
    # Emissivities of the image, or of each of its pixels.
    schema.check_numbers(emissivity, "the emissivity", "1")
    schema.band_positions(emissivity, [], "the emissivity")
    shape = (emissivity["band"].size, *(size[1:] if emissivity.dims[1:] == ("y", "x") else ()))
    _numbers.real_numbers("emissivity", emissivity.values, (0.0, 1.0), shape)
    films["emissivity"] = np.broadcast_to(emissivity.values.T, (*size[:0:-1], shape[0])).T
    axes = {"band": emissivity["band"].values, "time": ("time", time, {"units": "s"})}
    axes |= dict(zip("yx", map(np.arange, size[1:]), strict=True))
    return xr.Dataset(schema.variables("separated", films), axes, {"origin": "simulated"})


def side_by_side(emissivity: xr.DataArray, shape: tuple[int, int]) -> xr.DataArray:
    """Emissivity (band, y, x) [1] of panels of equal width, one a material.

    Parameters
    ----------
    emissivity, shape : DataArray, tuple of int
        Emissivity (material, band) [1]; rows and columns of the image.
    """
    shape = _image(shape)
    schema.check_numbers(emissivity, "the emissivity", "1")
    table = emissivity.transpose("band", "material").values
    panel = np.arange(shape[1]) * table.shape[1] // shape[1]
    image = np.broadcast_to(table[:, np.newaxis, panel], (len(table), *shape))
    axes = {"band": emissivity["band"].values}
    return xr.DataArray(image, axes, ("band", "y", "x"), attrs={"units": "1"})


def walkers(
    time: Array,
    shape: tuple[int, int],
    emissivity: xr.DataArray,
    rng: Randomness,
    *,
    temperatures: Sequence[float] = (295.15, 305.15, 333.15),
    crossings: int = 7,
    time_constant: float = 12.0,
) -> xr.Dataset:
    """`scene` of a plate, heated in its middle, that reflects people who walk by.

    Each person is an upright ellipse with a head, warmer than the room, that crosses the view once
    at a steady pace.

    Parameters
    ----------
    time, shape : ndarray, tuple of int
        Times (time,) [s]; rows and columns.
    emissivity : DataArray
        (band) or (band, y, x) [1].
    rng, crossings : Generator or seed, int
        Source of the paths; number of people.
    temperatures, time_constant : sequence of float, float
        Temperatures of the room, of people, and of the plate's middle at the end [K]; time constant
        of the heating [s].

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
    time, rng = schema.rising_numbers(time, "times of a scene", "s"), _generator(rng)
    shape = _image(shape)
    rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    # Object: heated in its middle.
    profile = np.exp(-(rows**2 + columns**2) / (2 * 0.5**2))
    curve = heating(time, 0.0, hottest - level, time_constant)
    warm = level + curve[:, np.newaxis, np.newaxis] * profile
    cold = np.full(warm.shape, level)
    # Background: each person crosses the view once.
    late = rng.random(_numbers.whole_number("crossings", crossings, (0, 2**31)))
    for start in time[0] + (time[-1] - time[0]) * (np.arange(crossings) + late) / crossings:
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


def _image(shape: Sequence[int]) -> tuple[int, int]:
    """Rows and columns of an image, of a pixel or more."""
    _numbers.real_numbers("shape", shape, shape=(2,))
    rows, columns = (_numbers.whole_number("shape", size, (1, 2**16)) for size in shape)
    return rows, columns


def _generator(rng: Randomness) -> np.random.Generator:
    """Generator of random numbers, or that of a seed."""
    try:
        return np.random.default_rng(rng)
    except (TypeError, ValueError) as error:
        raise TypeError(f"Invalid rng {_text.shown(rng)}. Must be a Generator or seed.") from error


@dataclass(frozen=True)
class Rig:
    """Simulated cameras, one a band: response, noise and fixed pattern.

    By default about the camera of the paper, a 16-bit 640x512 microbolometer. Behind a filter the
    counts shrink with the band's share of dB/dT; their noise stays.

    Attributes
    ----------
    bands, noise : tuple of str, tuple of float
        Names in `bands.FILTERS`; noise of each band, as NETD near 25 degrees Celsius [K].
    counts_per_kelvin, offset : float
        Slope of the 8-14 um band at 300 K [count/K]; counts of a body at 0 K [count].
    lowest, highest : float
        Range of the simulated response [K].
    gain_std, offset_std, bad_fraction : float
        Fixed pattern of pixels: relative gain [1], offset [count]; share of dead pixels [1].

    Examples
    --------
    >>> from dbthermal import simulation
    >>> response = simulation.Rig(noise=(0.04, 0.4)).response()
    >>> response["netd"].values.round(3).tolist()
    [0.04, 0.4]
    """

    bands: tuple[str, ...] = ("8-14", "9.5")
    noise: tuple[float, ...] = (0.03, 0.35)
    counts_per_kelvin: float = 115.0
    offset: float = 15500.0
    lowest: float = 263.15
    highest: float = 353.15
    gain_std: float = 0.02
    offset_std: float = 40.0
    bad_fraction: float = 0.001

    def __post_init__(self) -> None:
        for name in self.bands:
            bands.get(name)
        _numbers.real_numbers("noise [K]", self.noise, _numbers.NETD, (len(self.bands),))
        _numbers.real_number("offset [count]", self.offset, _numbers.FINITE)
        _numbers.real_numbers("range [K]", (self.lowest, self.highest), _numbers.KELVIN)
        for name in ("counts_per_kelvin", "gain_std", "offset_std"):
            _numbers.real_number(name, getattr(self, name), (0.0, schema.LARGEST))
        if not 0 <= _numbers.real_number("bad_fraction", self.bad_fraction) < 1:
            raise ValueError(f"Invalid bad_fraction {self.bad_fraction}. Must lie in [0, 1).")

    def response(self) -> xr.Dataset:
        """Response of the rig, from Planck's law in each band: the stage `response` with `noise`.

        The Sakuma-Hattori curve through exact in-band radiances, which it meets within 0.05 mK
        between -10 and 80 degrees Celsius. It states no error of a calibration, for there is none:
        bars of what is made with it are those of the noise alone.
        """
        temperature = np.linspace(self.lowest, self.highest, _CALIBRATION_POINTS)
        unit = self.counts_per_kelvin / bands.get("8-14").slope(_SLOPE_TEMPERATURE)
        values = [self.offset + unit * bands.get(name).radiance(temperature) for name in self.bands]
        axes = {"band": list(self.bands), "temperature": temperature}
        counts = xr.DataArray(values, axes, ("band", "temperature"))
        noiseless = calibration.fit_response(counts)
        # Noise in counts: NETD times the slope of the response near 25 degrees Celsius.
        slopes = [curve.reference_slope for curve in responses.curves(noiseless, self.bands)]
        noise = xr.DataArray(np.array(self.noise) * slopes, {"band": list(self.bands)}, "band")
        result = calibration.fit_response(counts, noise, **responses.EXACT)
        return result.assign_attrs(origin="simulated")


def _blackbody(curve: responses.Curve, temperature: xr.DataArray) -> Array:
    """Counts of a blackbody in a band; the temperature may differ between the bands."""
    if "band" in temperature.dims:
        (place,) = schema.band_positions(temperature, [curve.band], str(temperature.name))
        temperature = temperature.isel(band=place)
    return curve.counts(responses.require_range(temperature.values, curve, str(temperature.name)))


def observe(
    scene: xr.Dataset, response: xr.Dataset, rng: Randomness, dtype: str = "float32"
) -> xr.Dataset:
    r"""Counts of a scene in a perfectly corrected rig: the stage `corrected`.

    .. math:: I_m = e_m U_m(x) + (1 - e_m) U_m(y) + \mathrm{noise}

    TypeError or ValueError if a temperature lies outside the response, an emissivity outside
    [0, 1], or something is missing.

    Parameters
    ----------
    scene : Dataset
        As from `scene`; the background may be one for each band, (band, time, y, x) [K], as two
        cameras see it that stand side by side.
    response : Dataset
        With `noise`, e.g. from `Rig.response`.
    rng, dtype : Generator or seed, str
        Source of the noise; floating dtype of the counts.

    Examples
    --------
    >>> from dbthermal import simulation
    >>> glass = xr.DataArray([0.86, 0.72], coords={"band": ["8-14", "9.5"]}, dims="band")
    >>> time, still = np.arange(100) / 10.0, np.full((100, 1, 1), 300.0)
    >>> truth = simulation.scene(time, still, still, glass)
    >>> rng = np.random.default_rng(1)
    >>> corrected = simulation.observe(truth, simulation.Rig().response(), rng)
    >>> corrected["counts"].mean("time").squeeze().values.round().tolist()
    [23040.0, 16182.0]
    """
    schema.check(scene, "separated", ("object_temperature", "emissivity"), "the scene")
    background: Any = scene.get("background_temperature")
    schema.check_numbers(background, "'background_temperature' of the scene", "K")
    schema.check(response, "response", ("noise",))
    names = [str(name) for name in response["band"].values]
    schema.band_positions(scene, names, "the scene")
    # Mix emission and reflection in counts, and add noise.
    rng = _generator(rng)
    movie = np.empty((len(names), *scene["object_temperature"].shape), dtype=dtype)
    for index, curve in enumerate(responses.curves(response, names)):
        emissivity = scene["emissivity"].sel(band=curve.band).values
        signals = (_blackbody(curve, film) for film in (scene["object_temperature"], background))
        clean = mixing.leaving(emissivity, *signals)
        noise = float(response["noise"].sel(band=curve.band))
        movie[index] = clean + rng.normal(0.0, noise, clean.shape)
    attrs = {"origin": "simulated"}
    attrs |= {"twin": scene.attrs["twin"]} if "twin" in scene.attrs else {}
    coords = {"band": names, **{name: scene[name] for name in ("time", "y", "x")}}
    variables = schema.variables("corrected", {"counts": movie})
    return schema.check_corrected(xr.Dataset(variables, coords, attrs))


def pattern(rig: Rig, shape: tuple[int, int], rng: Randomness) -> xr.Dataset:
    """Random fixed pattern of a rig's detectors.

    Parameters
    ----------
    rig, shape, rng : Rig, tuple of int, Generator or seed
        Bands and deviations; rows and columns; source of all randomness.

    Returns
    -------
    Dataset
        `gain` (band, y, x) [1] and `offset` (band, y, x) [count] that the detector applies,
        relative to the mean of the live pixels, a smooth vignette (narcissus) included; `dead`
        (band, y, x).
    """
    schema.require(rig, Rig, "rig")
    shape, rng = _image(shape), _generator(rng)
    size = (len(rig.bands), *shape)
    rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    # Random gains and offsets with a vignette, relative to the live pixels.
    vignette = rows**2 + columns**2
    dead = rng.random(size) < rig.bad_fraction
    gain = rig.gain_std * (rng.standard_normal(size) - vignette)
    offset = rig.offset_std * (rng.standard_normal(size) + 2.0 * vignette)
    mean_gain, mean_offset = (
        np.mean(image, axis=(1, 2), where=~dead, keepdims=True) for image in (gain, offset)
    )
    dims = ("band", "y", "x")
    maps: dict[str, Any] = {"gain": (dims, 1.0 + gain - mean_gain, {"units": "1"})}
    maps["offset"] = (dims, offset - mean_offset, {"units": "count"})
    maps["dead"] = (dims, dead)
    return xr.Dataset(maps, {"band": list(rig.bands)}, {"origin": "simulated"})


def capture(corrected: xr.Dataset, detector: xr.Dataset) -> xr.Dataset:
    """Raw 16-bit counts: fixed pattern, dead pixels and rounding added to corrected counts.

    TypeError or ValueError if the counts are raw, the detector lacks a band or a map, or a count
    does not fit into 16 bits.

    Parameters
    ----------
    corrected, detector : Dataset
        From `observe` and `pattern`, with the same bands and shape.

    Examples
    --------
    >>> from dbthermal import simulation
    >>> rig, rng = simulation.Rig(bad_fraction=0.1), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], coords={"band": list(rig.bands)}, dims="band")
    >>> scene = simulation.walkers(np.arange(3) / 10, (24, 32), glass, rng)
    >>> corrected = simulation.observe(scene, rig.response(), rng)
    >>> raw = simulation.capture(corrected, simulation.pattern(rig, (24, 32), rng))
    >>> raw["counts"].dtype.name, round(float((raw["counts"] == 0).mean()), 1)  # dead pixels
    ('uint16', 0.1)
    """
    schema.check_corrected(corrected)
    detector = schema.laid_on(detector, corrected, "the detector", "the counts")
    counts = np.empty(corrected["counts"].shape, dtype=np.uint16)
    for index, movie in enumerate(corrected["counts"]):
        counts[index] = digitise(movie.values, _of_band(detector, str(movie["band"].item())))
    raw = corrected.assign(schema.variables("capture", {"counts": counts}))
    return schema.check(raw, "capture")


def blackbody_movies(
    rig: Rig, temperatures: np.ndarray, frames: int, detector: xr.Dataset, rng: Randomness
) -> xr.Dataset:
    """Raw movies of a blackbody that fills the view: the stage `blackbody_movies`.

    Parameters
    ----------
    rig, detector : Rig, Dataset
        The rig, and its `pattern`.
    temperatures, frames : ndarray, int
        Blackbody temperatures [K], increasing, within the rig's range; frames at each.
    rng : Generator or seed
        Source of the noise.

    Examples
    --------
    >>> from dbthermal import simulation
    >>> rig, rng = simulation.Rig(bad_fraction=0.0), np.random.default_rng(1)
    >>> detector = simulation.pattern(rig, (24, 32), rng)
    >>> steps = np.array([283.15, 303.15])  # K
    >>> movies = simulation.blackbody_movies(rig, steps, 4, detector, rng)
    >>> rise = movies["counts"].mean(("frame", "y", "x")).diff("temperature").squeeze()
    >>> (rise / 20.0).values.round().tolist()  # count/K in each band
    [108.0, 11.0]
    """
    schema.require(rig, Rig, "rig")
    response, rng = rig.response(), _generator(rng)
    temperatures = schema.rising_numbers(temperatures, "temperatures", "K", least=1)
    patterns = [_of_band(detector, name) for name in rig.bands]
    _numbers.whole_number("number of frames", frames, (1, 2**31))
    shape = (frames, *patterns[0]["gain"].shape)
    movies = np.empty((len(rig.bands), len(temperatures), *shape), dtype=np.uint16)
    for index, curve in enumerate(responses.curves(response, rig.bands)):
        noise = float(response["noise"][index])
        levels = curve.counts(responses.require_range(temperatures, curve, "temperature"))
        for place, mean in enumerate(levels):
            movies[index, place] = digitise(mean + rng.normal(0.0, noise, shape), patterns[index])
    coords = {"band": list(rig.bands), "temperature": ("temperature", temperatures, {"units": "K"})}
    variables = schema.variables("blackbody_movies", {"counts": movies})
    return xr.Dataset(variables, coords, {"origin": "simulated"})


def digitise(counts: np.ndarray, detector: xr.Dataset) -> np.ndarray:
    """Raw counts of one band, uint16 (..., y, x): fixed pattern, rounding, dead pixels at 0.

    Parameters
    ----------
    counts : array
        Corrected counts (..., y, x) [count]; ValueError if one does not fit into 16 bits.
    detector : Dataset
        The `pattern` (y, x) of this band.
    """
    raw = np.rint(detector["gain"].values * counts + detector["offset"].values)
    name = f"counts in band '{detector['band'].item()}'"
    _numbers.real_numbers(name, raw, (0, correction.DETECTOR_MAXIMUM))
    return np.where(detector["dead"].values, 0, raw).astype(np.uint16)


def _of_band(detector: xr.Dataset, band: str) -> xr.Dataset:
    """Pattern (y, x) of one band."""
    schema.check(detector, "correction", ("gain", "offset"), "the detector")
    schema.band_positions(detector, [band], "the detector")
    dead: Any = detector.get("dead")  # a map of other bands would be filled with NaN
    schema.check_variable(dead, schema.OPTIONAL["correction"]["bad"], "'dead' of the detector")
    return detector.sel(band=band)
