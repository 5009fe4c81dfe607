"""The paper's emissivity bench as a simulated twin, and the reflector method beside it.

On the bench an object is heated in steps and reflects, like a mirror, a blackbody set to several
temperatures; a thermocouple sits beside the reflection. By the reflector method the same heated
object and a crumpled foil are recorded in the room. Both are simulated with their typical errors,
and compared over many series.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import calibration, mixing, schema
from dbthermal import response as responses
from dbthermal._arrays import Array
from dbthermal.emissivity import embedded_table

_CAMERA_BAND: Final = "8-14"


@dataclass(frozen=True)
class Sample:
    """An object on the bench."""

    name: str
    emissivity: float  # in the band 8-14 um, in (0, 1)
    kin: str  # material of `emissivity.embedded_table` after which the other bands are scaled
    stray: float  # largest share of its reflection that is of the whole room, not mirror-like


OBJECTS: Final = (
    Sample("chrome ball", 0.10, "brass plate", 0.02),
    Sample("aluminium cup", 0.05, "aluminium, weathered", 0.04),
    Sample("blue paint", 0.87, "black gloss paint", 0.20),
    Sample("glass jar", 0.95, "plate window glass", 0.01),
    Sample("wineglass", 0.95, "plate window glass", 0.01),
)
"""The five objects of the paper (its table of emissivities, doi:10.48550/arXiv.2509.11334), with
its reference values for 8-14 um; the rest is this project's choice."""


def _names(response: xr.Dataset) -> tuple[str, ...]:
    return tuple(str(name) for name in response["band"].values)


@cache
def band_emissivity(sample: Sample, names: tuple[str, ...]) -> xr.DataArray:
    """True emissivity (band) [1] of a sample in bands of `bands.FILTERS`.

    The sample's own value for 8-14 um times the ratio of its kin's: of the emissivities where the
    value is below 0.5 as a metal's, of the reflectances above as a dielectric's, so that the
    result stays between 0 and 1.
    """
    kin = embedded_table()["emissivity"].sel(material=sample.kin, drop=True)
    values = kin.sel(band=list(names))
    if sample.emissivity < 0.5:
        value = sample.emissivity * values / float(kin.sel(band=_CAMERA_BAND))
    else:
        ratio = (1.0 - values) / (1.0 - float(kin.sel(band=_CAMERA_BAND)))
        value = 1.0 - (1.0 - sample.emissivity) * ratio
    return value.assign_attrs(units="1")


@dataclass(frozen=True)
class Bench:
    """Steps and errors of the bench; each `tolerance` is the half width of a uniform error.

    The mirrored excess, over the mean of the room, is that of what a smooth object reflects: the
    camera, and who stands beside it, fill part of that direction. 11 K is a direction nearly filled
    by skin. The reflector method's failure at low emissivity is this assumption: with a room of one
    temperature, (0, 0), it is right within 0.01; with (0, 5) and (0, 11) a chrome ball of 0.10
    seems to have 0.15 and 0.21.
    """

    # Steps [K], of which every pair is measured, and the room: its air, and its walls as a mean.
    object_temperatures: tuple[float, ...] = (300.15, 313.15, 325.15, 338.15)
    blackbody_temperatures: tuple[float, ...] = (288.15, 318.15, 348.15)
    air_temperature: float = 295.15
    reading_std: float = 0.2  # of a thermocouple's reading [K]
    probe_tolerance: float = 0.5  # [K]: type T, class 1 of IEC 60584-1:2013 up to 125 C
    # [K]: data sheet of the paper's Pico TC-08, but for 0.2 % of the reading, at most 0.13 K here.
    logger_tolerance: float = 0.5
    # Least and largest fraction of the object's excess over the air that the thermocouple misses.
    contact: tuple[float, float] = (0.0, 0.05)
    blackbody_std: float = 0.05  # [K]
    blackbody_tolerance: float = 0.3  # [K]
    foil_emissivity: float = 0.04  # of crumpled aluminium foil [1]
    foil_warming: float = 0.2  # fraction of the object's excess that the foil before it takes on
    foil_std: float = 0.3  # of the foil's signal from one part of it to another [K]
    mirrored_excess: tuple[float, float] = (0.0, 11.0)  # least and largest [K]
    # Excess over the air from which the reflector method takes a step [K]; ASTM E1933: 10 K.
    least_excess: float = 10.0

    def bias(self, sample: Sample) -> calibration.Bias:
        """Common errors that an experimenter would state, for `calibration.fit_emissivity`."""
        return calibration.Bias(
            object_tolerance=float(np.hypot(self.probe_tolerance, self.logger_tolerance)),
            contact=self.contact,
            air_temperature=self.air_temperature,
            background_tolerance=self.blackbody_tolerance,
            stray=(0.0, sample.stray),
        )


def bench_series(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> xr.Dataset:
    """One series of measurements on the paper's bench, with all its errors: the stage `contact`.

    The noise of the response is that of one pixel and frame: it stands for the drift of the camera
    between shutter events, which no mean over pixels removes. Common errors are drawn once.
    """
    grids = np.meshgrid(bench.object_temperatures, bench.blackbody_temperatures)
    warm, cold = (grid.ravel() for grid in grids)
    counts = _counts(response, sample, bench, warm, cold, rng.uniform(0.0, sample.stray))
    shown = cold + rng.uniform(-1, 1) * bench.blackbody_tolerance
    read = {
        "object_temperature": _thermocouple(warm, bench, rng),
        "background_temperature": shown + rng.normal(0, bench.blackbody_std, cold.size),
        "counts": _noisy(response, counts, rng),
    }
    return _series(response, "contact", read)


def reflector_series(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> xr.Dataset:
    """One series by the reflector method, with all its errors: the stage `reflector`.

    The foil gives the mean of the room, and a little of its own emission. Of the object's
    reflection all but the stray part is mirror-like, of a temperature higher by
    `Bench.mirrored_excess`. Parameters are those of `bench_series`. Raises a ValueError if no step
    of the object is `Bench.least_excess` above the air.
    """
    steps = np.array(bench.object_temperatures)
    warm = steps[steps >= bench.air_temperature + bench.least_excess]
    if warm.size == 0:
        raise ValueError(
            f"Invalid object temperatures {bench.object_temperatures} K. One must be "
            f"{bench.least_excess} K above the air's {bench.air_temperature} K."
        )
    air = np.full_like(warm, bench.air_temperature)
    stray, mirrored = rng.uniform(0.0, sample.stray), air + rng.uniform(*bench.mirrored_excess)
    counts = _counts(response, sample, bench, warm, mirrored, stray)
    uneven = _blackbody(response, air + rng.normal(0, bench.foil_std, air.size))
    emitted = _blackbody(response, air + bench.foil_warming * (warm - air))
    foil = mixing.leaving(bench.foil_emissivity, emitted, uneven)
    read = {
        "counts": _noisy(response, counts, rng),
        "reflected_counts": _noisy(response, foil, rng),
        "object_temperature": _thermocouple(warm, bench, rng),
    }
    return _series(response, "reflector", read)


def _blackbody(response: xr.Dataset, temperature: Array) -> Array:
    """Counts of a blackbody (band, measurement), the temperatures checked against the response."""
    return responses.counts(response, xr.DataArray(temperature, dims="measurement")).values


def _counts(
    response: xr.Dataset, sample: Sample, bench: Bench, warm: Array, mirrored: Array, stray: float
) -> Array:
    """Counts (band, measurement) of a warm mirror, of whose reflection a share is of the room."""
    room = _blackbody(response, np.full_like(warm, bench.air_temperature))
    reflected = (1.0 - stray) * _blackbody(response, mirrored) + stray * room
    share = band_emissivity(sample, _names(response)).values[:, np.newaxis]
    return mixing.leaving(share, _blackbody(response, warm), reflected)


def _noisy(response: xr.Dataset, counts: Array, rng: np.random.Generator) -> Array:
    """Counts (band, measurement) with the response's noise."""
    noise = responses.noise(response, [*_names(response)])[:, np.newaxis]
    return np.asarray(counts + noise * rng.standard_normal(counts.shape))


def _thermocouple(temperature: Array, bench: Bench, rng: np.random.Generator) -> Array:
    """Readings: offsets and contact error drawn once, scatter for each."""
    offset = (
        rng.uniform(-1, 1) * bench.probe_tolerance + rng.uniform(-1, 1) * bench.logger_tolerance
    )
    missed = rng.uniform(*bench.contact) * (temperature - bench.air_temperature)
    scatter = rng.normal(0, bench.reading_std, temperature.size)
    return np.asarray(temperature + offset - missed + scatter)


def _series(response: xr.Dataset, stage: str, read: dict[str, Array]) -> xr.Dataset:
    """Readings by name as a series of a stage."""
    variables = schema.variables(stage, read)
    return xr.Dataset(variables, {"band": response["band"].values}, {"origin": "simulated"})


def contact_measurements(
    response: xr.Dataset,
    emissivity: xr.DataArray,
    object_temperature: np.ndarray,
    background_temperature: np.ndarray,
    stds: tuple[float, float],
    rng: np.random.Generator,
) -> xr.Dataset:
    """Readings for the calibration of an emissivity (band) [1]: the stage `contact`.

    Of true temperatures (measurement,) [K] and standard deviations of a reading of thermocouple and
    blackbody [K]. ValueError if a temperature lies outside the response, or the emissivity lacks a
    band.
    """
    places = schema.band_positions(emissivity, [*_names(response)], "the emissivity")
    true = {
        "object_temperature": object_temperature,
        "background_temperature": background_temperature,
    }
    signals = (_blackbody(response, level) for level in true.values())
    clean = mixing.leaving(emissivity.values[places][:, np.newaxis], *signals)
    read = {"counts": _noisy(response, clean, rng)}
    for (name, level), std in zip(true.items(), stds, strict=True):
        read[name] = level + rng.normal(0, std, len(level))
    return _series(response, "contact", read)


PROCEDURES: Final = ("bench", "bench, plain fit", "reflector")
"""Procedures that `compare_procedures` compares: the paper's bench with the common errors in the
fit, and without as the paper's equation has it; and the reflector method, which is told the
thermocouple's. ("Method" is a word of xarray's own.)"""


def compare_procedures(
    response: xr.Dataset, rng: np.random.Generator, *, repeats: int = 100
) -> xr.Dataset:
    """Statistics of many measurements of objects on the bench and by the reflector method.

    A series' common errors are drawn anew for each of two or more repeats. `true` (object, band);
    over (object, procedure, band): `mean` of the estimates, their standard deviation `spread`,
    their `largest` error, and `coverage`, the share of errors within the stated deviation, 0.68 for
    a calibrated uncertainty [1].
    """
    true, bench = _true(response, repeats), Bench()
    estimates = np.array(
        [[_measured(response, sample, bench, rng) for _ in range(repeats)] for sample in OBJECTS]
    )  # (object, repeat, value or deviation, procedure, band)
    value, std = estimates[:, :, 0], estimates[:, :, 1]
    error = value - true.values[:, np.newaxis, np.newaxis]
    statistics = {
        "mean": value.mean(axis=1),
        "spread": value.std(axis=1, ddof=1),
        "largest": np.abs(error).max(axis=1),
        "coverage": np.mean(np.abs(error) < std, axis=1),
    }
    dims, unit = ("object", "procedure", "band"), {"units": "1"}
    return xr.Dataset(
        {"true": true, **{name: (dims, statistic, unit) for name, statistic in statistics.items()}},
        coords={"procedure": list(PROCEDURES)},
        attrs={"origin": "simulated twin", "repeats": repeats},
    )


def reflector_sensitivity(
    response: xr.Dataset,
    rng: np.random.Generator,
    excesses: Sequence[float] = (0.0, 5.0, 11.0),
    repeats: int = 100,
) -> xr.Dataset:
    """Emissivity by the reflector method over the excess of the reflected direction over the room.

    The excesses [K] are the largest of a smooth object's reflection; a series' own is drawn evenly
    from 0. `mean` of the estimates (object, excess, band), `true` (object, band) [1]. With 0 K the
    foil gives what the object reflects, and the method is right; beyond, its error is the
    emissivity's share in the excess, whatever the foil.
    """
    true = _true(response, repeats)
    benches = [replace(Bench(), mirrored_excess=(0.0, float(excess))) for excess in excesses]
    runs = [
        [[_by_reflector(response, it, bench, rng)[0] for _ in range(repeats)] for bench in benches]
        for it in OBJECTS
    ]
    mean = np.mean(runs, axis=2)
    return xr.Dataset(
        {"true": true, "mean": (("object", "excess", "band"), mean, {"units": "1"})},
        coords={"excess": ("excess", [float(excess) for excess in excesses], {"units": "K"})},
        attrs={"origin": "simulated twin", "repeats": repeats},
    )


def _true(response: xr.Dataset, repeats: int) -> xr.DataArray:
    """True emissivity (object, band) of the objects."""
    if repeats < 2:
        rule = "Must be twice or more"
        raise ValueError(f"Invalid comparison of {len(OBJECTS)} samples, {repeats} times. {rule}.")
    names = _names(response)
    return xr.DataArray(
        [band_emissivity(sample, names).values for sample in OBJECTS],
        coords={"object": [sample.name for sample in OBJECTS], "band": list(names)},
        attrs={"units": "1"},
    )


def _by_reflector(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Emissivity (band,) of one series by the reflector method, and its deviation."""
    series = reflector_series(response, sample, bench, rng)
    stds = (bench.reading_std, bench.foil_std)
    estimates = calibration.reflector_emissivity(series, response, stds, bench.bias(sample))
    return estimates["emissivity"].values, estimates["emissivity_std"].values


def _measured(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> Array:
    """Emissivity and its deviation by every procedure, (2, procedure, band)."""
    bias, stds = bench.bias(sample), (bench.reading_std, bench.blackbody_std)
    series = bench_series(response, sample, bench, rng)
    fits = [calibration.fit_emissivity(series, response, stds, *biases) for biases in ((bias,), ())]
    estimates = [(fit["emissivity"].values, fit["emissivity_std"].values) for fit in fits]
    return np.stack([*estimates, _by_reflector(response, sample, bench, rng)], axis=1)
