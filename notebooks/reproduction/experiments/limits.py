"""Distance of the separation from its limit, and calibration of its error bars and flags.

Two promises are judged on simulated pixels. An error bar: 95 % intervals hold the truth in 95 of
100 cases. A status of 0: the pixel is right; a pixel whose error is far beyond its error bar should
have a flag.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.ndimage import distance_transform_edt

from dbthermal import alignment, limits, separation
from dbthermal.simulation import Rig
from reproduction.cache import gridded
from reproduction.experiments import cases

KNOWING: Final = ("nothing", "slope", "rest")
"""What a bound is told of the background: nothing; the slope of the response there, as if it were
a line (reflection ratio only); or, with the exact response, in which frames it rests."""

BEFOREHAND: Final = 0.29
"""Standard deviation of an emissivity of which nothing is known, uniform in (0, 1) [1]."""

BORDER: Final = 2.0
"""Distance from a border of two materials within which no label is judged [pixel]."""

FAR: Final = 4.0
"""Standard deviations of error from which a pixel is bad [1]; of normal errors 1 of 16,000 is."""

AMONG: Final = ("unflagged", "all")
"""Pixels whose intervals are counted: those with status 0, or all that have a value."""

KINDS: Final = ("object", "any")
"""Quantities by which a pixel is bad: its object temperature; or that, or an emissivity."""

_PIXELS: Final = ("y", "x")
_INNER: Final = (0.1587, 0.8413)

_BOUNDED: Final = ("reflection_ratio", "object_temperature")
_UNITS: Final = {"object_temperature": "K"}


def near_bound(
    emissivity: Sequence[float],
    noise: Sequence[float],
    *,
    bands: Sequence[str],
    ends: Sequence[float],
    clock: Sequence[float],
    pixels: int,
    seed: int,
) -> xr.Dataset:
    r"""Errors of the separation of independent pixels of one material, beside their bounds.

    Noise and smooth subspace are unknown to the method and known to the bounds. Of those there are
    three (`KNOWING`), by the knowledge of the background:

    - "nothing": `limits.bounds` with one free number a frame and emissivities anywhere in (0, 1).
      At low noise it is loose, for the data tell the emissivities, and with them the level of
      the background and the ratio of the bands' slopes there, which this bound does not know;
    - "slope": the closed form `cases.ratio_variance_bound`, one free number a frame, but the
      slopes are known: of the three the one that fits the reflection ratio. It says nothing of the
      object;
    - "rest": `limits.bounds` that know in which frames the background rests, which the method does
      not.

    Emissivity [1] and noise [K] are of the bands, of which the first is the reference of the ratio
    and must be the quietest; `ends` are the first and last temperature of the object [degree
    Celsius], `clock` the number of frames and their rate [Hz].

    `reflection_ratio_error` (pixel) [1], signed, of the second band, and `reflection_ratio_bound`
    (knowing, pixel); `object_temperature_error` (pixel) [K], root mean square over time, and
    `object_temperature_bound` (knowing, pixel), NaN for "slope"; NaN in pixels without an object
    temperature. `status` (pixel).
    """
    rig = Rig(bands=tuple(bands), noise=tuple(noise))
    case = {"emissivity": list(emissivity), "start": ends[0], "stop": ends[1], "noise_known": False}
    truth, result = cases.run_case(case, rig, np.arange(int(clock[0])) / clock[1], pixels, seed)
    solved = result["object_temperature"].notnull().all("time")
    response = rig.response()
    free = limits.bounds(truth, response, resting=False, emissivity_std=BEFOREHAND)
    line = _as_line(response, rig)
    slope = limits.bounds(truth, line, resting=False, response_kind="linear")
    slope = slope.assign(object_temperature_std=np.nan * free["object_temperature_std"])
    names, kinds = [f"{it}_std" for it in _BOUNDED], (free, slope, limits.bounds(truth, response))
    bound = gridded([kind[names] for kind in kinds], {"knowing": KNOWING})
    second = (1.0 - truth["emissivity"]) / (1.0 - truth["emissivity"].isel(band=0))
    squared = (result["object_temperature"] - truth["object_temperature"]) ** 2
    measured = {
        "reflection_ratio_error": (result["reflection_ratio"] - second).isel(band=1),
        "reflection_ratio_bound": bound["reflection_ratio_std"].isel(band=1),
        "object_temperature_error": squared.mean("time", skipna=False) ** 0.5,
        "object_temperature_bound": (bound["object_temperature_std"] ** 2).mean("time") ** 0.5,
    }
    flat = {name: _row(values.where(solved), name) for name, values in measured.items()}
    flat["status"] = _row(result["status"], "status")
    return xr.Dataset(flat, attrs={"origin": "simulated", "seed": seed})


def summary(measured: xr.Dataset) -> xr.Dataset:
    r"""Errors in units of their bounds, over the pixels of `near_bound` that have a value.

    `reflection_ratio_error` [1] and `object_temperature_error` [K], root mean square over the
    pixels, and `reflection_ratio_bound`, `object_temperature_bound` (knowing) of the same pixels;
    `scatter` (knowing) [1], standard deviation over the pixels of the ratio's error over its bound;
    `excess` (knowing) [1], the object's error over its bound.
    """
    names = [f"{quantity}_{which}" for quantity in _BOUNDED for which in ("error", "bound")]
    figures = {name: _rms(measured[name]) for name in names}
    ratio = measured["reflection_ratio_error"] / measured["reflection_ratio_bound"]
    excess = figures["object_temperature_error"] / figures["object_temperature_bound"]
    for name, values in {"scatter": ratio.std("pixel"), "excess": excess}.items():
        figures[name] = values.assign_attrs(units="1")
    return xr.Dataset(figures, attrs=measured.attrs)


def pooled(
    sizes: Sequence[int],
    emissivity: Sequence[float],
    *,
    ends: Sequence[float],
    clock: Sequence[float],
    pixels: int,
    seed: int,
) -> xr.Dataset:
    r"""Error of the reflection ratio in groups of pixels that are known to be of one material.

    All pixels are of one material, in whole groups of each `size` that share their ratio; 1 is no
    pooling. The error of a group should fall as :math:`1/\sqrt{n}` down to the bias that all pixels
    share. Other parameters as for `near_bound`, of the default `Rig`.

    `reflection_ratio_error` [1], of the median of a group's pixels, root mean square over the
    groups, and `reflection_ratio_bound`, a single pixel's ("slope") over :math:`\sqrt{n}`;
    `object_temperature_error` [K], root mean square over pixels and time; `stated` [1], the
    separation's own standard deviation of the ratio, root mean square.
    """
    uneven = [size for size in sizes if size < 1 or pixels % size]
    if uneven:
        raise ValueError(f"Invalid size {uneven[0]} of a group. Must divide the {pixels} pixels.")
    rig, case = Rig(), {"emissivity": list(emissivity), "start": ends[0], "stop": ends[1]}
    time = np.arange(int(clock[0])) / clock[1]
    truth, capture, response = cases.simulate(case, rig, time, pixels, seed)
    line = _as_line(response, rig)
    bound = limits.bounds(truth, line, resting=False, response_kind="linear")
    single = _rms(_row(bound["reflection_ratio_std"].isel(band=1), "reflection_ratio"))
    ratio, errors = cases.reflection_ratio(list(emissivity)).item(), []
    for size in sizes:
        labels = xr.DataArray(np.arange(pixels)[np.newaxis] // size, dims=("y", "x"))
        result = separation.solve(capture, response, pool=None if size == 1 else labels)
        lowest = (single / np.sqrt(size)).assign_attrs(units="1")
        errors.append(_of_groups(size, truth, result, ratio).assign(reflection_ratio_bound=lowest))
    groups = gridded(errors, {"size": sizes})
    return groups.drop_vars("band", errors="ignore").assign_attrs(origin="simulated")


def _of_groups(size: int, truth: xr.Dataset, result: xr.Dataset, ratio: float) -> xr.Dataset:
    """Errors of `pooled` in groups of one size, of a material with a reflection ratio."""
    of_groups = {
        "reflection_ratio_error": result["reflection_ratio"] - ratio,
        "stated": result["reflection_ratio_std"],
    }
    # The median, for a pixel that the separation excludes from its group keeps a separate ratio.
    measured = {
        name: _rms(_row(values.isel(band=1).coarsen(x=size).median(), "reflection_ratio"))
        for name, values in of_groups.items()
    }
    error = result["object_temperature"] - truth["object_temperature"]
    rms = _rms(error.stack(pixel=error.dims))
    measured["object_temperature_error"] = rms.assign_attrs(units="K")
    return xr.Dataset(measured)


def stressed(
    case: Mapping[str, Any],
    *,
    clock: Sequence[float],
    pixels: int,
    seed: int,
    aligned: bool = False,
) -> xr.Dataset:
    """Error bars and flags (`judge`) of one case of `cases.simulate`.

    Aligned, the bands are first brought onto one clock by `alignment.align`; `frames_lost` [1] is
    the number of frames that this leaves empty in a band.
    """
    rig, time = Rig(), np.arange(int(clock[0])) / clock[1]
    if not aligned:
        judged = judge(*cases.run_case(case, rig, time, pixels, seed))
        return judged.assign(frames_lost=((), 0, {"units": "1"}))
    truth, capture, response = cases.simulate(case, rig, time, pixels, seed)
    together = alignment.align(capture)
    result = separation.solve(together, response)
    judged = judge(on_clock(truth, result["time"]), result)
    lost = max(together.attrs["frames_lost"])
    return judged.assign(frames_lost=((), lost, {"units": "1"}))


def on_clock(truth: xr.Dataset, time: xr.DataArray) -> xr.Dataset:
    """Scene with a smooth object at other times [s], by linear interpolation; NaN outside."""
    return truth.interp(time=time).assign_attrs(truth.attrs)


def border_kept(labels: xr.DataArray, truth: xr.DataArray) -> xr.Dataset:
    """Labels (y, x) of `separation.materials`, -1 for none, against the true panels (y, x).

    `right` [1], share of the pixels farther than `BORDER` from a border that carry the label most
    frequent in their panel; `bleeding` [1], number of labels that are on both sides of a border,
    that far from it.
    """
    estimate, panels = labels.values, np.unique(truth.values)
    distance = np.zeros(estimate.shape)
    for panel in panels:
        distance += distance_transform_edt(truth.values == panel)
    inner = [estimate[(truth.values == panel) & (distance > BORDER)] for panel in panels]
    right = sum(int(np.bincount(labelled[labelled >= 0], minlength=1).max()) for labelled in inner)
    sides = [set(np.unique(labelled[labelled >= 0])) for labelled in inner]
    bleeding = sum(sum(label in side for side in sides) > 1 for label in set().union(*sides))
    return cases.scalars(right=right / sum(labelled.size for labelled in inner), bleeding=bleeding)


def _as_line(response: xr.Dataset, rig: Rig) -> xr.Dataset:
    """Response with the noise [count] that is the rig's [K] by the linear slopes."""
    slopes = response["linear_slope"].sel(band=list(rig.bands))
    linear = (slopes * list(rig.noise)).assign_attrs(response["noise"].attrs)
    return response.assign(noise=linear)


def _row(image: xr.DataArray, name: str) -> xr.DataArray:
    """Pixels of an image one row high, as a dimension of their own."""
    row = image.isel(y=0).rename(x="pixel").drop_vars(["y", "pixel", "band"], errors="ignore")
    return row.assign_attrs(units=_UNITS.get(name.rsplit("_", 1)[0], "1"))


def _rms(values: xr.DataArray) -> xr.DataArray:
    """Root mean square over the pixels that have a value."""
    return ((values**2).mean("pixel") ** 0.5).assign_attrs(values.attrs)


def judge(truth: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    r"""Error bars and flags of one separation against the truth.

    A pixel is **bad** in its `object` where

    .. math:: \sqrt{\overline{(\hat x - x)^2}} > 4 \sqrt{\overline{s_x^2}}

    over the frames, and bad in `any` where that is so or the error of an emissivity exceeds four
    of its standard deviations. A pixel without a value is not bad.

    Over all pixels, in [1] but for the error in [K], NaN where there is nothing to count:
    `object_coverage` (among), share of samples whose 95 % interval holds the truth;
    `emissivity_coverage` (among, band), share of pixels; `width` (band), stated standard deviation
    of the emissivity over the robust standard deviation of its error, both of all pixels with a
    value, 1 for a calibrated uncertainty; `object_temperature_rmse` [K] and `emissivity_error`
    (band), see `cases.score`; `flagged`, share of pixels with any flag; `bad_pixels` (kind), their
    number; `bad_flagged` (kind), share of them with a flag; `status` (pixel), and `bad` (kind,
    pixel), true where bad.
    """
    statistics = _coverage(truth, result)
    # Pixels (kind, pixel) with an error beyond four standard deviations.
    of_object, of_emissivity = _beyond(truth, result, FAR)
    beyond = [_flat(of_object), _flat(of_object | of_emissivity)]
    bad = xr.concat(beyond, xr.DataArray(list(KINDS), dims="kind", name="kind"))
    flagged = _flat(result["status"] != 0)
    statistics |= {
        "flagged": flagged.mean(),
        "width": _width(truth, result),
        "bad_pixels": bad.sum("pixel"),
        "bad_flagged": _share(flagged, bad, ("pixel",)),
        "status": _flat(result["status"]),
        "bad": bad,
    }
    units = {name: value.assign_attrs(units="1") for name, value in statistics.items()}
    errors = cases.score(truth, result)[["object_temperature_rmse", "emissivity_error"]]
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
    for name, over in {"object_temperature": ("time", *_PIXELS), "emissivity": _PIXELS}.items():
        error, key = abs(result[name] - truth[name]), name.removesuffix("_temperature")
        within = error < cases.INTERVAL * result[f"{name}_std"]
        statistics[f"{key}_coverage"] = _share(within, error.notnull() & chosen, over)
    return statistics


def _width(truth: xr.Dataset, result: xr.Dataset) -> xr.DataArray:
    """Median stated deviation of the emissivities over the robust one of their errors."""
    error = result["emissivity"] - truth["emissivity"]
    solved = error.notnull().all("band")
    shape = (error.sizes["band"], -1)
    errors = error.where(solved).values.reshape(shape)[:, solved.values.ravel()]
    stds = result["emissivity_std"].values.reshape(shape)[:, solved.values.ravel()]
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
