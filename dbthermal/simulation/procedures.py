"""Two procedures for an emissivity side by side: the paper's bench, and the reflector method."""

from typing import Final

import numpy as np
import xarray as xr

from dbthermal import calibration
from dbthermal.simulation.bench import Bench, bench_series, reflector_series
from dbthermal.simulation.samples import OBJECTS, Sample, band_emissivity

PROCEDURES: Final = ("bench", "bench, plain fit", "reflector")
"""Procedures that `compare_procedures` compares: the paper's bench with the common errors in the
fit, and without as the paper's equation has it; and the reflector method, which is told the
thermocouple's. ("Method" is a word of xarray's own.)"""


def compare_procedures(
    response: xr.Dataset,
    rng: np.random.Generator,
    *,
    bench: Bench | None = None,
    samples: tuple[Sample, ...] = OBJECTS,
    repeats: int = 100,
) -> xr.Dataset:
    """
    Measure objects on the bench and by the reflector method, many times over.

    Parameters
    ----------
    response : Dataset
        With `noise`.
    rng : Generator
        Source of the errors; a series' common errors are drawn anew each time.
    bench : Bench, optional
        Steps and errors; the defaults of `Bench` if not given.
    samples : tuple of Sample
        The objects.
    repeats : int
        Series of each.

    Returns
    -------
    Dataset
        `true` (object, band); over (object, procedure, band): `mean` of the estimates, their
        standard deviation `spread`, their root mean square `error` and `largest` error, root mean
        square `stated` of the stated standard deviations, and `coverage`, the share of errors
        within one, 0.68 if the error bars are true [1].

    Raises
    ------
    ValueError
        If there is no sample, or fewer than two repeats.
    """
    if not samples or repeats < 2:
        raise ValueError(
            f"Invalid comparison of {len(samples)} samples, {repeats} times. Must be at least one, "
            "twice."
        )
    here = Bench() if bench is None else bench
    names = [str(name) for name in response["band"].values]
    true = np.stack([band_emissivity(sample, names).values for sample in samples])
    found = np.array(
        [[_measured(response, sample, here, rng) for _ in range(repeats)] for sample in samples]
    )  # (object, repeat, value or deviation, procedure, band)
    value, std = found[:, :, 0], found[:, :, 1]
    error = value - true[:, np.newaxis, np.newaxis]
    statistics = {
        "mean": value.mean(axis=1),
        "spread": value.std(axis=1, ddof=1),
        "error": np.sqrt(np.mean(error**2, axis=1)),
        "largest": np.abs(error).max(axis=1),
        "stated": np.sqrt(np.mean(std**2, axis=1)),
        "coverage": np.mean(np.abs(error) < std, axis=1),
    }
    unit = {"units": "1"}
    return xr.Dataset(
        {
            "true": (("object", "band"), true, unit),
            **{
                name: (("object", "procedure", "band"), part, unit)
                for name, part in statistics.items()
            },
        },
        coords={
            "object": [sample.name for sample in samples],
            "procedure": list(PROCEDURES),
            "band": names,
        },
        attrs={"origin": "simulated twin", "repeats": repeats},
    )


def _measured(
    response: xr.Dataset, sample: Sample, bench: Bench, rng: np.random.Generator
) -> np.ndarray:
    """Emissivity and its deviation by every procedure, (2, procedure, band)."""
    bias, stds = bench.bias(sample), (bench.reading_std, bench.blackbody_std)
    series = bench_series(response, sample, bench, rng)
    foil = reflector_series(response, sample, bench, rng)
    fits = (
        calibration.fit_emissivity(series, response, stds, bias),
        calibration.fit_emissivity(series, response, stds),
        calibration.reflector_emissivity(foil, response, (bench.reading_std, bench.foil_std), bias),
    )
    kept = ("emissivity", "emissivity_std")
    return np.array([[fit[name].values for fit in fits] for name in kept])
