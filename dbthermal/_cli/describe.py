"""Description of a store or a recording, as a mapping that JSON takes."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from dbthermal import schema


def info(options: argparse.Namespace) -> dict[str, Any]:
    """Command `info`."""
    from dbthermal._cli import files  # noqa: PLC0415 - it describes what it saves

    paths: list[Path] = options.files
    is_store = len(paths) == 1 and (paths[0] / "zarr.json").is_file() and options.unit is None
    dataset = files.opened(paths[0]) if is_store else files.recording(paths, options)
    return {str(paths[0]): summary(dataset, everything=True)}


def summary(dataset: xr.Dataset, *, everything: bool = False) -> dict[str, Any]:
    """Stage, sizes, clock, bands and flags of a dataset; and everything else, if that is wanted."""
    said: dict[str, Any] = {"stage": _stage(dataset), "sizes": dict(dataset.sizes)}
    if "band" in dataset.coords:
        said["bands"] = [str(band) for band in np.atleast_1d(dataset["band"].values)]
    if dataset.sizes.get("time", 0) > 1 and "time" in dataset.coords:
        time = dataset["time"].values
        said["seconds"] = round(float(time[-1] - time[0]), 6)
        said["frame_rate_Hz"] = round(float(1 / np.median(np.diff(time))), 6)
    for name in ("status", "frame_flags"):
        if name in dataset and "flag_masks" in dataset[name].attrs:
            said[f"{name}_shares"] = _shares(dataset[name])
    frames = ("frames_missing", "frames_bridged")
    said |= {name: round(dataset.attrs[name], 1) for name in frames if name in dataset.attrs}
    for name, unit in (("netd", "_K"), ("emissivity", "")):
        if name in dataset and dataset[name].dims[:1] == ("band",):
            good = dataset[name].where(dataset["status"] == 0 if "status" in dataset else True)
            values = [one[np.isfinite(one)] for one in np.atleast_1d(good.values)]
            if all(one.size for one in values):  # of no pixel without a flag there is none
                medians = [round(float(np.median(one)), 4) for one in values]
                said[f"median_{name}{unit}"] = dict(zip(said["bands"], medians, strict=True))
    if not everything:
        return said
    said["variables"] = {
        str(name): f"{one.dtype} {one.dims} [{one.attrs.get('units', '-')}]"
        for name, one in dataset.data_vars.items()
    }
    long = ("provenance", "files", "transform")
    said["attributes"] = {name: dataset.attrs[name] for name in dataset.attrs if name not in long}
    return said | {name: dataset.attrs.get(name, {}) for name in long[:2]}


def _stage(dataset: xr.Dataset) -> str:
    """Stage of `schema` that a dataset fits, "other" if none."""
    if "counts" in dataset and dataset["counts"].dims == ("time", "y", "x"):
        return "recording of one band"
    fitting = ["other"]
    for stage, variables in sorted(schema.STAGES.items(), key=lambda one: len(one[1])):
        try:
            schema.check(dataset, stage)
        except (TypeError, ValueError):
            continue
        raw = "counts" in variables and dataset["counts"].dtype.kind != "f"
        if stage not in {"capture", "corrected"} or raw == (stage == "capture"):
            fitting.append(stage)
    return fitting[-1]


def _shares(flags: xr.DataArray) -> dict[str, float]:
    """Share of the values without a flag, and of each flag found."""
    values = flags.values
    shares = {"no_flag": float((values == 0).mean())}
    bit = schema.Status.COMPLETED_FRAMES
    if bit.label in str(flags.attrs["flag_meanings"]).split():
        shares["no_flag_but_for_some_frames"] = float((values == bit).mean())
    for name in str(flags.attrs["flag_meanings"]).split():
        share = float(schema.has_flag(flags, name).mean())
        shares |= {name: share} if share else {}
    return {name: round(share, 6) for name, share in shares.items()}
