"""Summary of a dataset: stage, sizes, clock, flags, shifts, and of a result its answer."""

from typing import Any

import numpy as np
import xarray as xr

from dbthermal import schema
from dbthermal.explorer._answer import answer


def outline(dataset: xr.Dataset) -> dict[str, Any]:
    """Stage, sizes, bands and clock of a dataset."""
    lines: dict[str, Any] = {"stage": stage_of(dataset), "sizes": dict(dataset.sizes)}
    if "band" in dataset.coords:
        lines["bands"] = [str(band) for band in np.atleast_1d(dataset["band"].values)]
    if dataset.sizes.get("time", 0) > 1 and "time" in dataset.coords:
        time = dataset["time"].values
        lines["seconds"] = round(float(time[-1] - time[0]), 6)
        lines["frame_rate_Hz"] = round(float(1 / np.median(np.diff(time))), 6)
    return lines


def summary(dataset: xr.Dataset, *, everything: bool = False) -> dict[str, Any]:
    """Outline, flags, clocks, views and medians of a dataset; with everything its attributes."""
    lines, attrs = outline(dataset), dataset.attrs
    if lines["stage"] == "separated" and "x" in dataset.sizes:
        sentences, numbers = answer(dataset)
        lines = {"answer": sentences, "numbers": numbers, **lines}
    # Shares of the flags, frames that were lost or bridged, and the offset of the clocks.
    for name in ("status", "frame_flags"):
        if name in dataset and "flag_masks" in dataset[name].attrs:
            lines[f"{name}_shares"] = _shares(dataset[name])
    places = {"frames_missing": 1, "frames_bridged": 1, "frames_lost": 1}
    places |= {"time_offset": 6, "time_offset_std": 6}  # decimals
    for name, decimals in places.items():
        if attrs.get(name) is not None:
            unit = "_s" if name.startswith("time") else ""
            lines[f"{name}{unit}"] = np.round(attrs[name], decimals).tolist()
    lines |= _shifts(dataset)
    # Medians over the pixels without a flag, where every band has one.
    for name, unit in (("netd", "_K"), ("emissivity", "")):
        if name in dataset and dataset[name].dims[:1] == ("band",):
            good = dataset[name].astype(float).where(np.isfinite)
            good = good.where(dataset["status"] == 0 if "status" in dataset else True)
            medians = good.median([dim for dim in good.dims if dim != "band"])
            if medians.notnull().all():
                lines[f"median_{name}{unit}"] = medians.round(4).to_series().to_dict()
    if not everything:
        return lines
    lines["variables"] = {
        str(name): f"{array.dtype} {array.dims} [{array.attrs.get('units', '-')}]"
        for name, array in dataset.data_vars.items()
    }
    long = ("provenance", "files", "transform")
    lines["attributes"] = {name: value for name, value in attrs.items() if name not in long}
    return lines | {name: attrs.get(name, {}) for name in long[:2]}


def stage_of(dataset: xr.Dataset) -> str:
    """Stage of `schema` that a dataset fits, "other" if none."""
    if "counts" in dataset and dataset["counts"].dims == ("time", "y", "x"):
        return "recording of one band"
    fitting = ["other"]
    for stage, variables in sorted(schema.STAGES.items(), key=lambda stage: len(stage[1])):
        try:
            schema.check(dataset, stage)
        except (TypeError, ValueError):
            continue
        raw = "counts" in variables and dataset["counts"].dtype.kind != "f"
        if stage not in {"capture", "corrected"} or raw == (stage == "capture"):
            fitting.append(stage)
    return fitting[-1]


def _shifts(dataset: xr.Dataset) -> dict[str, Any]:
    """Rows down and columns to the right by which views and reflections show a point elsewhere.

    Of a view, for which there is a matrix for each band, the centre of the image.
    """
    lines, views = dict[str, Any](), len(dataset.attrs.get("transform", ())) / 9
    if {"y", "x"} <= dataset.sizes.keys() and views and views == dataset.sizes.get("band"):
        column, row = (0.5 * (dataset.sizes[dim] - 1) for dim in ("x", "y"))
        matrices = np.reshape(dataset.attrs["transform"], (-1, 3, 3))
        right, down, scale = (matrices @ [column, row, 1.0]).T
        shifts = np.stack([down / scale - row, right / scale - column], axis=1).round(2).tolist()
        lines["view_shift_pixel"] = dict(zip(map(str, dataset["band"].values), shifts, strict=True))
    if "reflection_shift" in dataset:
        shifts = dataset["reflection_shift"].median(("y", "x")).values.round(2).tolist()
        lines["reflection_shift_pixel"] = dict(zip(("rows", "columns"), shifts, strict=True))
    return lines


def _shares(flags: xr.DataArray) -> dict[str, float]:
    """Share of the values without a flag, and of each flag found."""
    shares = {"no_flag": float((flags.values == 0).mean())}
    for name in str(flags.attrs["flag_meanings"]).split():
        share = float(schema.has_flag(flags, name).mean())
        shares |= {name: share} if share else {}
    return {name: round(share, 6) for name, share in shares.items()}
