"""Two procedures for an emissivity side by side: the paper's bench, and the reflector method."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import calibration
from reproduction.experiments.bench import (
    OBJECTS,
    Bench,
    Sample,
    band_emissivity,
    bench_series,
    reflector_series,
)

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
    names = tuple(str(name) for name in response["band"].values)
    return xr.DataArray(
        [band_emissivity(sample, names).values for sample in OBJECTS],
        coords={"object": [sample.name for sample in OBJECTS], "band": list(names)},
        attrs={"units": "1"},
    )


def _by_reflector(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Emissivity (band,) of one series by the reflector method, and its deviation."""
    series = reflector_series(response, sample, bench, rng)
    stds = (bench.reading_std, bench.foil_std)
    estimates = calibration.reflector_emissivity(series, response, stds, bench.bias(sample))
    return estimates["emissivity"].values, estimates["emissivity_std"].values


def _measured(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> np.ndarray:
    """Emissivity and its deviation by every procedure, (2, procedure, band)."""
    bias, stds = bench.bias(sample), (bench.reading_std, bench.blackbody_std)
    series = bench_series(response, sample, bench, rng)
    fits = [calibration.fit_emissivity(series, response, stds, *biases) for biases in ((bias,), ())]
    estimates = [(fit["emissivity"].values, fit["emissivity_std"].values) for fit in fits]
    return np.stack([*estimates, _by_reflector(response, sample, bench, rng)], axis=1)
