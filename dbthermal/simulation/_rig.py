"""Simulated cameras: response by Planck's law, fixed pattern, noise, 16-bit counts."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, bands, calibration, correction, mixing, planck, schema
from dbthermal import response as responses
from dbthermal._coordinates import laid_on
from dbthermal.response import require_range

_CALIBRATION_POINTS: Final = 25
_SLOPE_TEMPERATURE: Final = 300.0


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
        if len(self.noise) != len(self.bands):
            raise ValueError(f"Invalid noise {self.noise} K. Must be one for each of {self.bands}.")
        planck.require_positive("noise [K]", self.noise)
        _numbers.real_number("offset [count]", self.offset, _numbers.FINITE)
        for name in ("counts_per_kelvin", "lowest", "highest", "gain_std", "offset_std"):
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


def _blackbody(response: xr.Dataset, temperature: xr.DataArray) -> list[np.ndarray]:
    """Counts of a blackbody in each band; the temperature may differ between the bands."""
    names = [str(name) for name in response["band"].values]
    levels = [temperature] * len(names)
    if "band" in temperature.dims:
        places = schema.band_positions(temperature, names, str(temperature.name))
        levels = [temperature.isel(band=place) for place in places]
    curves = responses.curves(response, names)
    return [
        curve.counts(require_range(level.values, curve, str(temperature.name)))
        for level, curve in zip(levels, curves, strict=True)
    ]


def observe(
    scene: xr.Dataset, response: xr.Dataset, rng: np.random.Generator, dtype: str = "float32"
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
    rng, dtype : Generator, str
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
    _numbers.real_numbers("emissivity of the scene", scene["emissivity"].values, (0.0, 1.0))
    schema.check(response, "response", ("noise",))
    names = [str(name) for name in response["band"].values]
    emitted = _blackbody(response, scene["object_temperature"])
    reflected = _blackbody(response, background)
    schema.band_positions(scene, names, "the scene")
    # Mix emission and reflection in counts, and add noise.
    movie = np.empty((len(names), *scene["object_temperature"].shape), dtype=dtype)
    for index, name in enumerate(names):
        emissivity = scene["emissivity"].sel(band=name).values
        clean = mixing.leaving(emissivity, emitted[index], reflected[index])
        noise = float(response["noise"].sel(band=name))
        movie[index] = clean + rng.normal(0.0, noise, clean.shape)
    attrs = {"origin": "simulated"}
    attrs |= {"twin": scene.attrs["twin"]} if "twin" in scene.attrs else {}
    coords = {"band": names, **{name: scene[name] for name in ("time", "y", "x")}}
    variables = schema.variables("corrected", {"counts": movie})
    return schema.check(xr.Dataset(variables, coords, attrs), "corrected")


def pattern(rig: Rig, shape: tuple[int, int], rng: np.random.Generator) -> xr.Dataset:
    """Random fixed pattern of a rig's detectors.

    Parameters
    ----------
    rig, shape, rng : Rig, tuple of int, Generator
        Bands and deviations; rows and columns; source of all randomness.

    Returns
    -------
    Dataset
        `gain` (band, y, x) [1] and `offset` (band, y, x) [count] that the detector applies,
        relative to the mean of the live pixels, a smooth vignette (narcissus) included; `dead`
        (band, y, x).
    """
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

    TypeError or ValueError if the detector lacks a band, or a count does not fit into 16 bits.

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
    schema.check(corrected, "corrected")
    detector = laid_on(detector, corrected, "the detector", "the counts")
    counts = np.empty(corrected["counts"].shape, dtype=np.uint16)
    for index, movie in enumerate(corrected["counts"]):
        counts[index] = digitise(movie.values, _of_band(detector, str(movie["band"].item())))
    raw = corrected.assign(schema.variables("capture", {"counts": counts}))
    return schema.check(raw, "capture")


def blackbody_movies(
    rig: Rig, temperatures: np.ndarray, frames: int, detector: xr.Dataset, rng: np.random.Generator
) -> xr.Dataset:
    """Raw movies of a blackbody that fills the view: the stage `blackbody_movies`.

    Parameters
    ----------
    rig, detector : Rig, Dataset
        The rig, and its `pattern`.
    temperatures, frames : ndarray, int
        Blackbody temperatures [K], increasing, within the rig's range; frames at each.
    rng : Generator
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
    response = rig.response()
    shape = (frames, *detector["gain"].shape[1:])
    level = xr.DataArray(temperatures, dims="temperature", name="temperature")
    movies = np.empty((len(rig.bands), len(temperatures), *shape), dtype=np.uint16)
    for index, counts in enumerate(_blackbody(response, level)):
        noise, of_band = float(response["noise"][index]), _of_band(detector, rig.bands[index])
        for place, mean in enumerate(counts):
            movies[index, place] = digitise(mean + rng.normal(0.0, noise, shape), of_band)
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
    if not (raw.min() >= 0 and raw.max() <= correction.DETECTOR_MAXIMUM):  # a NaN fails it, too
        message = f"Invalid counts {raw.min()} to {raw.max()} in band '{detector['band'].item()}'"
        raise ValueError(f"{message}. Must lie in [0, {correction.DETECTOR_MAXIMUM}].")
    return np.where(detector["dead"].values, 0, raw).astype(np.uint16)


def _of_band(detector: xr.Dataset, band: str) -> xr.Dataset:
    """Pattern (y, x) of one band."""
    schema.band_positions(detector, [band], "the detector")
    dead = schema.OPTIONAL["correction"]["bad"]  # a map of other bands would be filled with NaN
    schema.check_variable(detector["dead"], dead, "'dead' of the detector")
    return detector.sel(band=band)
