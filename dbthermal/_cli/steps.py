"""Steps from a capture to a result; the plan of a capture; the data of the package."""

import argparse
import math
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import (
    alignment,
    bands,
    calibration,
    correction,
    emissivity,
    limits,
    scene,
    schema,
    separation,
)
from dbthermal._cli import PLUS, accepted, files, leaves
from dbthermal._cli.summary import outline
from dbthermal._warnings import warned
from dbthermal.limits._planner import SKY_LEVEL
from dbthermal.response import ACCURACY
from dbthermal.separation._doubts import hardly_measured
from dbthermal.separation._run import BASE

_SWEEP = 64  # frames of each temperature of a blackbody that are taken
_OUTPUTS: Final = {
    "import": "capture",
    **dict.fromkeys(("correct", "align"), "corrected"),
    **dict.fromkeys(("separate", "complete"), "separated"),
}
"""Command -> stage of what it writes, whose size follows from that of a capture."""


def calibrate(options: argparse.Namespace) -> dict[str, Any]:
    """Command `calibrate`."""
    stated = [name for name in ("at", "blackbody", "sweep", "maker") if getattr(options, name)]
    if len(stated) != 1:
        label = f"Invalid sources {stated}" if stated else "Missing source"
        raise ValueError(f"{label}. Must be one of --at, --blackbody, --sweep or --maker.")
    # The constants of the cameras' maker.
    if options.maker:
        response = calibration.maker_response(files.opened(options.maker).attrs.get("files", {}))
        return files.saved(response, options)
    # Movies of a blackbody: statistics of each pixel, then one curve for all.
    blackbody = _blackbody(options)
    known = {name: blackbody.attrs[name] for name in ACCURACY if name in blackbody.attrs}
    if "frame" in blackbody.dims:
        blackbody = correction.blackbody_statistics(blackbody)
    fitted = correction.fit_correction(blackbody) if "y" in blackbody.dims else None
    counts = blackbody["counts"] if fitted is None else fitted["level"]
    known |= accepted(calibration.fit_response, options)
    response = calibration.fit_response(counts, blackbody.get("noise"), **known)
    # The response names the files that it was fitted to.
    named = leaves([options.at, options.blackbody, options.sweep])
    paths = [str(leaf) for leaf in named if isinstance(leaf, str | Path) and leaf != PLUS]
    response.attrs["blackbody"] += f"; of {', '.join(paths)}"
    summary = files.saved(response, options)
    if fitted is not None and options.correction_output:
        summary |= files.saved(fitted, options, options.correction_output)
    return summary


def _blackbody(options: argparse.Namespace) -> xr.Dataset:
    """Counts of a blackbody at all temperatures."""
    frames = files.between(options, "frames", most=_SWEEP)
    if options.blackbody:
        return files.opened(options.blackbody).load()
    if options.sweep:
        from dbthermal.instruments import recording  # noqa: PLC0415 - optional

        return recording.open_sweep(*options.sweep, frames=frames.stop)
    # Files of each temperature.
    movies = []
    for temperature, *paths in options.at:
        if isinstance(temperature, Path):
            raise ValueError(f"Invalid --at {temperature}. Must begin with a temperature: 20C.")
        offset = [0.0] * (len(options.bands or "ab") - 1)  # nothing moves: any will do
        still = files.capture(paths, options, offset)
        good = np.arange(still.sizes["time"])
        if "exposure_time" in still:  # padded and damaged frames have none
            good = np.flatnonzero(still["exposure_time"].notnull().all("band"))
        movie = still["counts"].isel(time=good[frames]).load()
        movie = movie.drop_vars("time").rename(time="frame")
        movies.append(movie.expand_dims(temperature=[temperature]))
    # All temperatures have the frames of the shortest recording.
    number = min(movie.sizes["frame"] for movie in movies)
    counts = xr.concat([movie.isel(frame=slice(number)) for movie in movies], dim="temperature")
    counts = counts.transpose("band", "temperature", "frame", "y", "x").sortby("temperature")
    return counts.to_dataset(name="counts")


def correct(options: argparse.Namespace) -> dict[str, Any]:
    """Command `correct`."""
    stages = {"correction": "correction"} if options.correction else {}
    raw, *fitted = files.staged(options, capture="capture|corrected", **stages)
    by_camera = options.corrected_by_camera
    records = raw.attrs.get("files", {}).values()
    # Planck constants of the maker hold for all pixels: such a camera has corrected its offsets.
    by_maker = bool(records) and all("file_planck_R1" in attrs for attrs in records)
    if by_camera == bool(options.correction) and (by_camera or not by_maker):
        sources = "both a file and --corrected-by-camera" if by_camera else "neither"
        rule = "Must be the file of 'dbthermal calibrate --correction-output nuc.zarr' or, only if "
        rule += "the cameras correct gain and offset themselves, --corrected-by-camera"
        raise ValueError(f"Invalid correction of gain and offset: {sources}. {rule}.")
    gain = fitted[0].load() if fitted else correction.corrected_by_camera(raw)
    named = accepted(correction.correct_capture, options)
    shutter = not options.no_shutter
    corrected = correction.correct_capture(raw, gain, lazy=True, shutter=shutter, **named)
    return files.saved(corrected, options)


def align(options: argparse.Namespace) -> dict[str, Any]:
    """Command `align`."""
    (corrected,) = files.staged(options, capture="corrected")
    options.register = options.register or "homography"
    named = {**_aligning(options, corrected), "clock": options.reference}
    if options.register != "none":
        named["transform"] = alignment.register(corrected, model=options.register)
    return files.saved(alignment.align(corrected, lazy=True, **named), options)


def _aligning(options: argparse.Namespace, capture: xr.Dataset) -> dict[str, Any]:
    """Options of an alignment, with the offset of each band."""
    named = accepted(alignment.align, options)
    if "offset" in named:
        first, *bands = capture["band"].values.tolist()
        if len(named["offset"]) != len(bands):
            rule = f"Must be {len(bands)}, one for each of the bands {bands}"
            raise ValueError(f"Invalid --offset {named['offset']}. {rule}.")
        named["offset"] = xr.DataArray([0.0, *named["offset"]], {"band": [first, *bands]}, "band")
    return named


def separate(options: argparse.Namespace) -> dict[str, Any]:
    """Command `separate`."""
    # Inputs of the stages that the way needs.
    stages = {"capture": "corrected", "response": "response"}
    if options.correction:
        stages |= {"capture": "capture|corrected", "correction": "correction"}
        options.register = options.register or "homography"
    source, response, *fitted = files.staged(options, **stages)
    response.load()
    progress = {"progress": sys.stderr.isatty()}
    if options.correction:  # all steps of a raw capture, by rows
        scene.separate_capture(
            source,
            fitted[0].load(),
            response,
            registration=None if options.register == "none" else options.register,
            aligning=_aligning(options, source),
            separating=accepted(separation.separate, options) | progress,
            target=options.output,
            provenance=files.provenance(options),
        )
    elif options.method is None:  # the default call, in memory
        notes = [note for data in (source, response) for note in data.attrs.get("warnings", [])]
        named = accepted(separation.separate, options) | progress
        result = separation.separate(source.load(), response, **named)
        return files.saved(warned(result, *notes, *hardly_measured(result)), options)
    else:  # a single method, by rows
        named = accepted(separation.run, options) | progress
        if options.emissivity:
            axis = {"band": source["band"].values}
            if len(options.emissivity) != len(axis["band"]):
                rule = f"Must be one for each of the bands {axis['band'].tolist()}"
                raise ValueError(f"Invalid --emissivity {options.emissivity}. {rule}.")
            named["emissivity"] = xr.DataArray(options.emissivity, dims="band", coords=axis)
        made_by = files.provenance(options)
        separation.run(options.capture, options.output, response, provenance=made_by, **named)
    return files.described(options.output)


def complete(options: argparse.Namespace) -> dict[str, Any]:
    """Command `complete`."""
    stages = {"result": "separated", "capture": "corrected", "response": "response"}
    result, source, response = (dataset.load() for dataset in files.staged(options, **stages))
    named = {**accepted(separation.complete, options), "materials": result.get("material")}
    return files.saved(separation.complete(result, source, response, **named), options)


def foreseen(
    options: argparse.Namespace, sources: list[Path], targets: list[Path]
) -> dict[str, Any]:
    """Inputs and outputs of a command with their bytes, and the memory that a separation takes."""
    inputs = dict[str, Any]()
    for path in sources:
        contents = [file for file in (path, *path.rglob("*")) if file.is_file()]
        inputs[str(path)] = {"bytes": sum(file.stat().st_size for file in contents)}
        if (path / "zarr.json").is_file():
            inputs[str(path)] |= outline(files.opened(path))
    summary: dict[str, Any] = {"would_read": inputs, "would_write": [*map(str, targets)]}
    if options.command == "import":
        summary["would_be"] = outline(files.capture(options.files, options, options.offset))
    # Bytes of an output before its compression, and those that the disk has for it.
    outlines = [summary.get("would_be", {}), *inputs.values()]
    sized = [it["sizes"] for it in outlines if "time" in it.get("sizes", {})]
    if sized and (stage := _OUTPUTS.get(options.command)):
        lengths = {"axis": 2, "cause": len(schema.CAUSES), "other_band": sized[0]["band"]}
        lengths |= sized[0]
        summary["would_write_bytes_at_most"] = sum(
            math.prod(lengths[dim] for dim in variable.dims) * np.dtype(variable.dtype).itemsize
            for variable in {**schema.STAGES[stage], **schema.OPTIONAL[stage]}.values()
        )
    if targets:
        place = next(folder for folder in targets[0].absolute().parents if folder.is_dir())
        summary["free_bytes"] = shutil.disk_usage(place).free
    if options.command == "separate":
        sizes = inputs[str(options.capture)].get("sizes", {})
        memory = BASE + scene.SAMPLE * math.prod(sizes.get(dim, 0) for dim in ("time", "y", "x"))
        row = BASE + scene.ROW * math.prod(sizes.get(dim, 0) for dim in ("time", "x"))
        most = max(3e9, row) if options.correction else 2e9 if options.method else math.inf
        summary["memory_at_most_GB"] = round(min(memory, most) / 1e9, 1)
    return summary


def plan(options: argparse.Namespace) -> dict[str, Any]:
    """Command `plan`."""
    # Materials, all or those that are named.
    table = emissivity.embedded_table()
    if options.materials:
        names = table["material"].values.tolist()
        for name in options.materials:
            if name not in names:
                raise ValueError(f"Unknown material '{name}'. Must be one of {names}.")
        table = table.sel(material=options.materials)
    # Plan of the capture, and its best filter by material.
    level = {"level": SKY_LEVEL} if options.outdoors else {}
    design = limits.CaptureDesign(**accepted(limits.CaptureDesign, options), **level)
    noise = emissivity.filter_noise(options.noise, table["band"].values.tolist())
    plans = limits.plan(table, noise, design, outdoors=options.outdoors)
    deviations = plans["object_temperature_std"].transpose("filter", "material").to_pandas()
    numbers = {
        str(name): {
            "best_filter": str(best),
            "object_temperature_std_K": deviations[name].round(4).to_dict(),
        }
        for name, best in plans["best"].to_series().items()
    }
    if options.outdoors:
        for name, costs in plans["sky_error"].transpose("filter", "material").to_pandas().items():
            numbers[str(name)]["sky_error_K"] = costs.round(4).to_dict()
    return {"answer": [*_table(numbers, noise, design)], "numbers": numbers}


def _table(
    numbers: dict[str, Any], noise: xr.DataArray, design: limits.CaptureDesign
) -> Iterator[str]:
    """Yield the lines of a plan: what it assumes, and a row for each material."""
    filters = [*next(iter(numbers.values()))["object_temperature_std_K"]]
    yield (
        f"Assumed: {design.seconds:g} s at {design.rate:g} Hz; the object rises by {design.span:g} "
        f"K, the reflections by {design.amplitude:g} K for {design.duration:g} s in every "
        f"{design.period:g} s."
    )
    behind = ", ".join(f"{float(noise.sel(band=name)):.2g} K ({name} um)" for name in filters)
    yield f"Noise of a frame behind a filter: {behind}."
    yield "Deviation of the object's temperature [K], second band behind the filter [um]:"
    wide = max(len(name) for name in [*numbers, "material"])
    yield "  ".join(["material".ljust(wide), "best", *(name.rjust(8) for name in filters)])
    for name, entry in numbers.items():
        cells = [f"{value:8.3f}" for value in entry["object_temperature_std_K"].values()]
        yield "  ".join([name.ljust(wide), entry["best_filter"].ljust(4), *cells])
        if "sky_error_K" in entry:
            cells = [f"{value:8.3f}" for value in entry["sky_error_K"].values()]
            yield "  ".join(["  by a sky taken for gray".ljust(wide + 6), *cells])
    if any(entry["best_filter"] == "none" for entry in numbers.values()):
        yield "Best none: no filter tells more than the range of the temperatures does."


def data(_: argparse.Namespace) -> dict[str, Any]:
    """Command `data`."""
    table = emissivity.embedded_table()["emissivity"]
    return {
        "filters_um": {
            name: [round(1e6 * band.lower, 3), round(1e6 * band.upper, 3)]
            for name, band in bands.FILTERS.items()
        },
        "emissivity": table.transpose("band", "material").to_pandas().round(3).to_dict(),
        "outside_files": "listed by data_manifest.yaml of a clone, and fetched there by: make data",
    }
