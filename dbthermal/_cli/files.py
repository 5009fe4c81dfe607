"""Stores and files that commands read, the stores that they write, and what these are."""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from tqdm import tqdm

from dbthermal import _rows, readers, schema, store
from dbthermal._cli import PLUS, is_source, leaves
from dbthermal._cli.unused import kind_of
from dbthermal._warnings import warned

_MADE_BY = {
    "capture": "import",
    "correction": "calibrate --correction-output",
    "corrected": "correct ('separate --correction' takes raw counts)",
    "response": "calibrate",
    "separated": "separate",
}
_NOT_RECORDED = {"dry_run", "json", "overwrite", "place", "traceback"}


def opened(path: Path) -> xr.Dataset:
    """Dataset of a store, or stage `capture` of a recording."""
    dataset = store.open_dataset(path)
    if "frames_written" not in dataset.attrs:
        return dataset
    from dbthermal.instruments import recording  # noqa: PLC0415 - optional

    return recording.open_capture(path)


def staged(options: argparse.Namespace, **stages: str) -> list[xr.Dataset]:
    """Stores that arguments name, each of a stage of `schema`, or of one of several: ``a|b``."""
    datasets = {name: opened(getattr(options, name)) for name in stages}
    found = {name: _stage(dataset) for name, dataset in datasets.items()}
    for name, wanted in stages.items():
        if found[name] not in wanted.split("|"):
            others = [one for one in stages if found[name] in stages[one].split("|")]
            hint = f" Exchanged with the {others[0]}?" if others else ""
            label = f"{name} '{getattr(options, name)}' of stage '{found[name]}'"
            stage = wanted.partition("|")[0]
            rule = f"Must be of stage '{stage}', as from: dbthermal {_MADE_BY[stage]}"
            raise ValueError(f"Invalid {label}. {rule}.{hint}")
    return [*datasets.values()]


def recording(paths: list[Path], options: argparse.Namespace) -> xr.Dataset:
    """Recording of one camera, with its origin."""
    made = _read(paths, options)
    return made.assign_attrs(origin="simulated") if options.simulated else made


def _read(paths: list[Path], options: argparse.Namespace) -> xr.Dataset:
    """Recording of one camera, by the kind of its files."""
    kind, clock = kind_of(paths[0], options), options.clock
    if kind == "FLIR":
        return readers.flir(paths, clock=clock)
    for name in ("unit", "clock"):
        if getattr(options, name) is None:
            raise ValueError(f"Missing --{name}: '{paths[0].name}' does not tell. Must be stated.")
    if kind == "TIFF":
        return readers.tiff(paths, unit=options.unit, clock=clock)
    if len(paths) > 1:
        raise ValueError(f"Invalid list of {len(paths)} {kind}. Must be one file of all frames.")
    if kind == "arrays":
        return readers.array(paths[0], options.variable, unit=options.unit, clock=clock)
    return readers.raw(
        paths[0],
        tuple(options.shape),
        byte_order=options.byte_order or "unknown",
        unit=options.unit,
        clock=clock,
        header=options.header,
        frame_header=options.frame_header,
    )


def capture(paths: list[Path], options: argparse.Namespace, offset: float | None) -> xr.Dataset:
    """Capture of two bands: a store, or the files of one camera, a '+', and of the other."""
    if len(paths) == 1 and paths[0].is_dir():
        return opened(paths[0])
    if len(paths) == 2 and PLUS not in paths:
        paths = [paths[0], PLUS, paths[1]]
    place = paths.index(PLUS) if PLUS in paths else 0
    if paths.count(PLUS) != 1 or place in {0, len(paths) - 1}:
        found = f"{len(paths)} files: which are of the second camera is not clear"
        raise ValueError(f"Invalid {found}. Must be one of each, or: a*.tif + b*.tif.")
    if options.bands is None:
        raise ValueError("Missing --bands. Must name both, such as: --bands 8-14 9.5.")
    first, second = options.bands
    both = [recording(part, options) for part in (paths[:place], paths[place + 1 :])]
    return readers.two_bands(*both, bands=(first, second), offset=offset)


def make_capture(options: argparse.Namespace) -> dict[str, Any]:
    """Command `import`."""
    from dbthermal import separation  # noqa: PLC0415 - takes long

    made = capture(options.files, options, options.offset)
    fewest = separation.get_method("subspace").minimum_frames
    if (frames := made.sizes["time"]) < fewest:
        rule = f"Must be at least {fewest} to be separated, better 200 to 400"
        made = warned(made, f"The capture has {frames} frames. {rule}.")
    return saved(made, options)


def saved(
    result: xr.Dataset, options: argparse.Namespace, path: Path | None = None
) -> dict[str, Any]:
    """Save a result with its provenance, a capture by rows, which may be lazy, and describe it."""
    path, parts = path or options.output, [slice(None)]
    if "counts" in result and result["counts"].ndim == 4:
        parts = [*_rows.blocks(result["counts"].shape)]
    shown = tqdm(parts, desc=options.command, unit="block", disable=not sys.stderr.isatty())
    rows = (result.isel(y=one, missing_dims="ignore") for one in shown)
    store.save_rows(rows, path, provenance(options))
    return described(path)


def described(path: Path) -> dict[str, Any]:
    """Summary of a store that was written."""
    return {str(path): summary(store.open_dataset(path))}


def provenance(options: argparse.Namespace) -> dict[str, Any]:
    """Provenance of a command: its options, and the checksums of what it reads."""
    parameters, inputs = dict[str, Any](), dict[str, Path]()
    for name, value in vars(options).items():
        parts = [*leaves(value)]
        sources = [one for one in parts if is_source(name, one)]
        inputs |= {f"{name} {number}": path for number, path in enumerate(sources)}
        plain = [one for one in parts if one is not None and not isinstance(one, Path)]
        if plain and name not in _NOT_RECORDED:
            parameters[name] = plain if isinstance(value, list) else value
    return store.provenance(parameters, inputs)


def info(options: argparse.Namespace) -> dict[str, Any]:
    """Command `info`."""
    paths: list[Path] = options.files
    is_store = len(paths) == 1 and (paths[0] / "zarr.json").is_file() and options.unit is None
    dataset = opened(paths[0]) if is_store else recording(paths, options)
    return {str(paths[0]): summary(dataset, everything=True)}


def outline(dataset: xr.Dataset) -> dict[str, Any]:
    """Stage, sizes, bands and clock of a dataset."""
    said: dict[str, Any] = {"stage": _stage(dataset), "sizes": dict(dataset.sizes)}
    if "band" in dataset.coords:
        said["bands"] = [str(band) for band in np.atleast_1d(dataset["band"].values)]
    if dataset.sizes.get("time", 0) > 1 and "time" in dataset.coords:
        time = dataset["time"].values
        said["seconds"] = round(float(time[-1] - time[0]), 6)
        said["frame_rate_Hz"] = round(float(1 / np.median(np.diff(time))), 6)
    return said


def summary(dataset: xr.Dataset, *, everything: bool = False) -> dict[str, Any]:
    """Outline and flags of a dataset; and everything else, if that is wanted."""
    said = outline(dataset)
    for name in ("status", "frame_flags"):
        if name in dataset and "flag_masks" in dataset[name].attrs:
            said[f"{name}_shares"] = _shares(dataset[name])
    frames = ("frames_missing", "frames_bridged")
    said |= {name: round(dataset.attrs[name], 1) for name in frames if name in dataset.attrs}
    found = {name: dataset.attrs.get(name) for name in ("time_offset", "time_offset_std")}
    said |= {
        f"{name}_s": np.round(one, 6).tolist() for name, one in found.items() if one is not None
    }
    said |= {"frames_lost": dataset.attrs["frames_lost"]} if "frames_lost" in dataset.attrs else {}
    views = len(dataset.attrs.get("transform", ())) / 9  # a matrix each
    if {"y", "x"} <= dataset.sizes.keys() and views and views == dataset.sizes.get("band"):
        said["view_shift_pixel"] = _view_shifts(dataset)
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


def _view_shifts(dataset: xr.Dataset) -> dict[str, list[float]]:
    """Rows down and columns to the right, by which each view shows the image's centre elsewhere."""
    column, row = (0.5 * (dataset.sizes[dim] - 1) for dim in ("x", "y"))
    matrices = np.reshape(dataset.attrs["transform"], (-1, 3, 3))
    right, down, scale = (matrices @ [column, row, 1.0]).T
    shifts = np.stack([down / scale - row, right / scale - column], axis=1).round(2)
    return dict(zip(map(str, dataset["band"].values), shifts.tolist(), strict=True))


def _shares(flags: xr.DataArray) -> dict[str, float]:
    """Share of the values without a flag, and of each flag found."""
    values = flags.values
    shares = {"no_flag": float((values == 0).mean())}
    for name in str(flags.attrs["flag_meanings"]).split():
        share = float(schema.has_flag(flags, name).mean())
        shares |= {name: share} if share else {}
    return {name: round(share, 6) for name, share in shares.items()}
