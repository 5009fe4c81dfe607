"""A simulated twin judged as the paper judges a scene: at its thermocouples."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import calibration, emissivity, metrics, separation, simulation
from reproduction import twins
from reproduction.experiments.comparison import MOVING, arguments

BEAD: Final = 3
"""Pixels along a side of the square that a thermocouple's bead covers."""

_STRAY: Final = 0.01


def judge_twin(
    name: str,
    seed: int,
    variants: Mapping[str, Mapping[str, Any]],
    *,
    material: str,
    shape: Sequence[int],
    frames: int,
    rate: float,
    baseline: float = 0.0,
) -> xr.Dataset:
    """
    Simulate a twin, calibrate its emissivity on the bench, and judge it at its thermocouple.

    One of `twins.TWINS`, of a material of `emissivity.embedded_table`, of rows and columns, frames
    and their rate [Hz], by two cameras a baseline apart [m]. Of the variants (see
    `at_thermocouple`), "calibrated" gets the emissivities that the bench finds for a piece of the
    same material, with their deviations.

    Returns
    -------
    Dataset
        Variables of `at_thermocouple`; `emissivity_difference` (band) [1], mean magnitude of the
        default method's emissivity less the calibrated one over the pixels without a flag; `good`
        [1], the share without a flag of the object's pixels in which the background moves.
    """
    rng, rig = np.random.default_rng(seed), simulation.Rig()
    response = rig.response()
    table = emissivity.embedded_table()["emissivity"]
    true = table.sel(material=material, band=list(rig.bands), drop=True)
    time = np.arange(frames) / rate
    setting = twins.Capture(true, (shape[0], shape[1]), time, baseline)
    scene = twins.twin(name, setting, rng)
    corrected = simulation.observe(scene, response, rng)
    fit = on_bench(response, material, rng)
    known = {"emissivity": fit["emissivity"], "emissivity_std": fit["emissivity_std"]}
    informed = {
        label: {**options, **(known if options["method"] == "calibrated" else {})}
        for label, options in variants.items()
    }
    separated = separation.solve(corrected, response)
    good = (separated["status"] == 0) & scene["on_object"]
    apart = abs(separated["emissivity"] - fit["emissivity"]).where(good).mean(("y", "x"))
    background = scene["background_temperature"]
    first = background.isel(band=0) if "band" in background.dims else background
    moving = (first.std("time") > MOVING) & scene["on_object"]
    result = at_thermocouple(scene, corrected, response, informed, rng)
    return result.assign(
        emissivity_difference=apart.assign_attrs(units="1"),
        good=((good & moving).sum() / moving.sum()).assign_attrs(units="1"),
    )


def on_bench(response: xr.Dataset, material: str, rng: np.random.Generator) -> xr.Dataset:
    """Emissivity of a smooth piece of a material, calibrated on the simulated bench."""
    value = float(emissivity.embedded_table()["emissivity"].sel(material=material, band="8-14"))
    sample, bench = simulation.Sample(material, value, material, _STRAY), simulation.Bench()
    series = simulation.bench_series(response, sample, bench, rng)
    stds = (bench.reading_std, bench.blackbody_std)
    return calibration.fit_emissivity(series, response, stds, bench.bias(sample))


def at_thermocouple(
    scene: xr.Dataset,
    corrected: xr.Dataset,
    response: xr.Dataset,
    variants: Mapping[str, Mapping[str, Any]],
    rng: np.random.Generator,
    *,
    probes: int = 20,
) -> xr.Dataset:
    """
    Errors of several methods at the first thermocouple of a twin.

    The estimate is the mean over the pixels that the bead covers. The reading has the errors of a
    probe that was compared with a reference (`twins.thermocouple_readings`), drawn anew for a
    number of probes, so that the result does not depend on one probe's error. Variants are label ->
    `method` of `separation.solve` and its arguments; methods that treat each pixel alone get the
    bead's pixels only.

    Returns
    -------
    Dataset
        `relative_error` (variant) [percent of degrees Celsius], mean over the frames and probes,
        NaN where a pixel of the bead has no value in some frame;
        `temperature` (variant, time) and `reading` (time) of the last probe [K];
        `highest_reading` [degree Celsius], median over the probes.
    """
    square = _square(scene)
    readings = [
        twins.thermocouple_readings(scene, rng, bead=BEAD).isel(thermocouple=0)
        for _ in range(probes)
    ]
    seed = int(rng.integers(2**32))  # of random starts: each capture has its own
    estimates = [
        _mean(corrected, response, square, {"seed": seed, **variant})
        for variant in variants.values()
    ]
    label = xr.DataArray(list(variants), dims="variant", name="variant")
    temperature = xr.concat(estimates, dim=label)
    errors = [metrics.relative_error_celsius(temperature, reading) for reading in readings]
    highest = np.median([float(reading.max()) for reading in readings]) - zero_Celsius
    return xr.Dataset(
        {
            "relative_error": xr.concat(errors, "probe").mean(("probe", "time"), skipna=False),
            "temperature": temperature.assign_attrs(units="K"),
            "reading": readings[-1],
            "highest_reading": ((), highest, {"units": "degree_Celsius"}),
        },
        attrs={"origin": "simulated twin", "twin": scene.attrs["twin"]},
    )


def _square(scene: xr.Dataset) -> dict[str, slice]:
    """Rows and columns that the first bead covers."""
    reach = BEAD // 2
    centre = {dim: int(scene[f"thermocouple_{dim}"][0]) for dim in ("y", "x")}
    return {dim: slice(place - reach, place + reach + 1) for dim, place in centre.items()}


def _mean(
    corrected: xr.Dataset,
    response: xr.Dataset,
    square: Mapping[str, slice],
    variant: Mapping[str, Any],
) -> xr.DataArray:
    """Object temperature (time) [K] of one method, mean over the bead's pixels."""
    seen = corrected
    if not separation.get_method(variant["method"]).whole_image:
        seen = corrected.isel(square)
    estimates = separation.solve(seen, response, **arguments(variant))["object_temperature"]
    part = estimates.isel(square) if estimates.sizes == corrected["counts"][0].sizes else estimates
    return part.mean(("y", "x"), skipna=False)


def share(estimate: xr.DataArray, cause: xr.DataArray) -> float:
    r"""
    Share of a change that another one holds: the slope of a regression through their means [1].

    .. math:: \sum a b / \sum b^2

    with a the first (time, y, x) and b its cause, each less its mean over time, over all samples in
    which the first is known, in one unit. Raises a ValueError if the cause does not change there.
    """
    a, b = (part - part.where(estimate.notnull()).mean("time") for part in (estimate, cause))
    power = float((b**2).where(estimate.notnull()).sum())
    if not power > 0:
        raise ValueError("Invalid cause without change where anything was estimated. Must change.")
    return float((a * b).sum()) / power
