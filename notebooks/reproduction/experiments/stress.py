"""Calibration of the error bars and flags, case by case, on simulated pixels.

Two promises are judged. An error bar: 95 % intervals hold the truth in 95 of 100 cases. A status
of 0: the pixel is right; a pixel whose error is far beyond its error bar should have a flag.
"""

from typing import Final

import numpy as np
import xarray as xr

from reproduction.experiments.cases import score
from reproduction.experiments.scores import INTERVAL

FAR: Final = 4.0
"""Standard deviations of error from which a pixel is bad [1]; of normal errors 1 of 16,000 is."""

AMONG: Final = ("unflagged", "all")
"""Pixels whose intervals are counted: those with status 0, or all that have a value."""

KINDS: Final = ("object", "any")
"""Quantities by which a pixel is bad: its object temperature; or that, or an emissivity."""

_PIXELS: Final = ("y", "x")
_INNER: Final = (0.1587, 0.8413)


def judge(truth: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    r"""Error bars and flags of one separation against the truth.

    A pixel is **bad** in its `object` where

    .. math:: \sqrt{\overline{(\hat x - x)^2}} > 4 \sqrt{\overline{s_x^2}}

    over the frames, and bad in `any` where that is so or the error of an emissivity exceeds four
    of its standard deviations. A pixel without a value is not bad.

    Returns
    -------
    Dataset
        Over all pixels, in [1] but for the error in [K]; NaN where there is nothing to count:

        - `object_coverage` (among): share of samples whose 95 % interval holds the truth;
          `emissivity_coverage` (among, band): share of pixels;
        - `width` (band): stated standard deviation of the emissivity over the robust standard
          deviation of its error, both of all pixels with a value; 1 for a calibrated uncertainty;
        - `object_temperature_rmse` [K] and `emissivity_error` (band), see `cases.score`;
        - `flagged`: share of pixels with any flag;
        - `bad_pixels` (kind): their number; `bad_flagged` (kind): share of them with a flag;
        - `status` (pixel), and `bad` (kind, pixel), true where bad.
    """
    statistics = _coverage(truth, result)
    bad, flagged = _bad(truth, result), _flat(result["status"] != 0)
    statistics |= {
        "flagged": flagged.mean(),
        "width": _width(truth, result),
        "bad_pixels": bad.sum("pixel"),
        "bad_flagged": _share(flagged, bad, ("pixel",)),
        "status": _flat(result["status"]),
        "bad": bad,
    }
    units = {name: value.assign_attrs(units="1") for name, value in statistics.items()}
    errors = score(truth, result)[["object_temperature_rmse", "emissivity_error"]]
    return xr.Dataset(units).merge(errors).assign_attrs(origin="simulated")


def _share(holds: xr.DataArray, counted: xr.DataArray, over: tuple[str, ...]) -> xr.DataArray:
    """Share of the counted samples for which a condition holds; NaN where none is counted."""
    number = counted.sum(over)
    return (holds & counted).sum(over) / number.where(number > 0)


def _flat(image: xr.DataArray) -> xr.DataArray:
    """Pixels of an image in a row."""
    return image.stack(pixel=_PIXELS).drop_vars(["pixel", *_PIXELS])


def _coverage(truth: xr.Dataset, result: xr.Dataset) -> dict[str, xr.DataArray]:
    """Share of 95 % intervals that hold the truth, among the unflagged and among all."""
    label = xr.DataArray(list(AMONG), dims="among", coords={"among": list(AMONG)})
    chosen = (result["status"] == 0) | (label == "all")
    statistics = {}
    for name, over in (("object", ("time", *_PIXELS)), ("emissivity", _PIXELS)):
        full = "object_temperature" if name == "object" else name
        error, std = abs(result[full] - truth[full]), result[f"{full}_std"]
        counted = error.notnull() & chosen
        statistics[f"{name}_coverage"] = _share(error < INTERVAL * std, counted, over)
    return statistics


def _width(truth: xr.Dataset, result: xr.Dataset) -> xr.DataArray:
    """Median stated deviation of the emissivities over the robust one of their errors."""
    error = result["emissivity"] - truth["emissivity"]
    known = error.notnull().all("band")
    shape = (error.sizes["band"], -1)
    errors = error.where(known).values.reshape(shape)[:, known.values.ravel()]
    stds = result["emissivity_std"].values.reshape(shape)[:, known.values.ravel()]
    width = np.full(shape[0], np.nan)
    if errors.size:
        lower, upper = np.quantile(errors, _INNER, axis=1)
        np.divide(2.0 * np.median(stds, axis=1), upper - lower, out=width, where=upper > lower)
    return xr.DataArray(width, dims="band", coords={"band": error["band"]})


def wrong(truth: xr.Dataset, result: xr.Dataset, far: float = FAR) -> xr.DataArray:
    """Pixels (y, x) whose object temperature or an emissivity is off by more than `far` [1]."""
    of_object, of_emissivity = _beyond(truth, result, far)
    return of_object | of_emissivity


def _beyond(truth: xr.Dataset, result: xr.Dataset, far: float) -> tuple[xr.DataArray, xr.DataArray]:
    """Pixels (y, x) with an object, and with an emissivity, beyond so many deviations."""
    squared = (result["object_temperature"] - truth["object_temperature"]) ** 2
    allowed = (result["object_temperature_std"] ** 2).where(squared.notnull())
    of_object = squared.mean("time") > far**2 * allowed.mean("time")
    apart = abs(result["emissivity"] - truth["emissivity"])
    return of_object, (apart > far * result["emissivity_std"]).any("band")


def _bad(truth: xr.Dataset, result: xr.Dataset) -> xr.DataArray:
    """Pixels (kind, pixel) with an error beyond four standard deviations."""
    of_object, of_emissivity = _beyond(truth, result, FAR)
    label = xr.DataArray(list(KINDS), dims="kind", name="kind")
    return xr.concat([_flat(of_object), _flat(of_object | of_emissivity)], label)
