"""Demonstration; steps from a capture to a result; plan of a capture; data of the package."""

import math
import shutil
import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

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
    simulation,
    store,
)
from dbthermal._cli import PLUS, accepted, files, leaves
from dbthermal._text import check_listed, repeated
from dbthermal.readers._recording import optional
from dbthermal.response import ACCURACY
from dbthermal.separation._doubts import hardly_measured
from dbthermal.separation._quality import MOST_MISSING
from dbthermal.separation._run import BASE

_SWEEP = 64  # frames of each temperature of a blackbody that are taken
_SHAPE: Final = (48, 64)  # rows and columns of the demonstration [pixel]
_FRAMES, _RATE, _STILL = 200, 10.0, 16  # of the scene, its rate [Hz], and of each temperature
_CELSIUS: Final = (5, 25, 45, 70)  # of the blackbody
_PLATE: Final = ["plate window glass", "construction concrete", "ultra flat black paint"]
_VIEW: Final = (2, 4)  # rows and columns by which cameras side by side see the plate apart
_PARALLAX: Final = 3  # further columns by which they see its reflections apart

_NEXT: Final = """\
dbthermal import a.tif b.tif --bands 8-14 9.5 --clock 10 --offset 0 -o scene.zarr
dbthermal calibrate {sweep} --bands 8-14 9.5 --clock 10 -o response.zarr \
--correction-output nuc.zarr
dbthermal separate scene.zarr response.zarr --correction nuc.zarr{views} -o result.zarr
dbthermal report result.zarr -o report.html
dbthermal explore result.zarr -o look.ipynb"""
"""At most five, that take the files to a report and to the explorer."""
_SCENE: Final = (  # of the files, an origin that `readers.tiff` takes over
    "simulated, by no camera: a plate of glass (left) and concrete (right) with a cross of black "
    "tape, its middle heated from 22 to 60 degC while people walk by"
)

_OUTPUTS: Final = {"import": "capture", "correct": "corrected", "align": "corrected"}
_OUTPUTS.update(separate="separated", complete="separated")
"""Command -> stage of what it writes, whose size follows from that of a capture."""


def demo(options: Namespace) -> dict[str, Any]:
    """Command `demo`."""
    tifffile = optional("tifffile", "recordings")
    folder: Path = options.folder
    stacks = _demo_stacks(simulation.Rig(), np.random.default_rng(1), apart=options.side_by_side)
    # All or nothing: a folder that has one of the files is left as it is.
    paths = {folder / f"{name}.tif": stack for name, stack in stacks.items()}
    for path in (path for path in paths if path.exists()):
        raise FileExistsError(f"There is something at '{path}'. Must be a new folder.")
    folder.mkdir(parents=True, exist_ok=True)
    for path, stack in paths.items():
        with store.whole(path, ".tif") as file:
            tifffile.imwrite(file, stack, photometric="minisblack", description=f"origin: {_SCENE}")
    sweep = " ".join(f"--at {step}C a{step}.tif b{step}.tif" for step in _CELSIUS)
    views = " --register translation" if options.side_by_side else " --register none --offset 0"
    commands = [f"cd {quote(str(folder))}", *_NEXT.format(sweep=sweep, views=views).splitlines()]
    return {str(folder): f"{len(paths)} TIFF stacks, {_SCENE}", "next": commands}


def _demo_stacks(rig: simulation.Rig, rng: np.random.Generator, *, apart: bool) -> dict[str, Any]:
    """Counts (time, y, x) of both cameras, a and b: of the scene, and of each blackbody."""
    # A plate larger than the view; by its cross of tape displaced views are registered.
    view, parallax = (_VIEW, _PARALLAX) if apart else ((0, 0), 0)
    size = (_SHAPE[0] + view[0], _SHAPE[1] + view[1])
    table = emissivity.embedded_table()["emissivity"].sel(band=list(rig.bands), material=_PLATE)
    rows, columns = np.ogrid[: size[0], : size[1]]
    tape = xr.DataArray((abs(rows - 23) < 4) | (abs(columns - 32) < 5), dims=("y", "x"))
    plate = simulation.side_by_side(table[:2], size).where(~tape, table[2].drop_vars("material"))
    # Each camera sees its part of it, and the reflections displaced.
    truth = simulation.walkers(np.arange(_FRAMES) / _RATE, size, plate, rng)
    films = []
    for camera, band in enumerate(rig.bands):
        mirrored = truth["background_temperature"].roll(x=-camera * parallax)
        top, left = (camera * shift for shift in view)
        seen = truth.assign(background_temperature=mirrored)
        seen = seen.isel(y=slice(top, top + _SHAPE[0]), x=slice(left, left + _SHAPE[1]))
        seen = seen.assign_coords(y=np.arange(_SHAPE[0]), x=np.arange(_SHAPE[1]))
        films.append(simulation.observe(seen, rig.response(), rng).sel(band=[band]))
    # Raw counts of two detectors, as they show the scene and the blackbody.
    detector = simulation.pattern(rig, _SHAPE, rng)
    shown = simulation.capture(xr.concat(films, dim="band"), detector)
    movies = simulation.blackbody_movies(rig, np.add(_CELSIUS, zero_Celsius), _STILL, detector, rng)
    stacks = dict(zip("ab", shown["counts"].values, strict=True))
    for name, sweep in zip("ab", movies["counts"].values, strict=True):
        stacks |= {f"{name}{step}": film for step, film in zip(_CELSIUS, sweep, strict=True)}
    return stacks


def calibrate(options: Namespace) -> dict[str, Any]:
    """Command `calibrate`."""
    stated = [name for name in ("at", "blackbody", "sweep", "maker") if getattr(options, name)]
    if len(stated) != 1:
        label = f"Invalid sources {stated}" if stated else "Missing source"
        raise ValueError(f"{label}. Must be one of --at, --blackbody, --sweep or --maker.")
    if options.maker:
        response = calibration.maker_response(files.opened(options.maker).attrs.get("files", {}))
        return files.saved(response, options)
    # Movies of a blackbody: statistics of each pixel, then one curve for all.
    blackbody = _blackbody(options)
    accuracies = {name: blackbody.attrs[name] for name in ACCURACY if name in blackbody.attrs}
    if "frame" in blackbody.dims:
        blackbody = correction.blackbody_statistics(blackbody)
    fitted = correction.fit_correction(blackbody) if "y" in blackbody.dims else None
    if fitted is None and options.correction_output:
        rule = f"Must be left out: '{options.blackbody}' has no pixels"
        raise ValueError(f"Unused option --correction-output. {rule}.")
    counts = blackbody["counts"] if fitted is None else fitted["level"]
    accuracies |= accepted(calibration.fit_response, options)
    response = calibration.fit_response(counts, blackbody.get("noise"), **accuracies)
    # The response names the files that it was fitted to.
    named = leaves([options.at, options.blackbody, options.sweep])
    paths = [str(leaf) for leaf in named if isinstance(leaf, str | Path) and leaf != PLUS]
    response.attrs["blackbody"] += f"; of {', '.join(paths)}"
    response.attrs |= schema.origin(blackbody.attrs)
    summary = files.saved(response, options)
    if fitted is not None and options.correction_output:
        summary |= files.saved(fitted, options, options.correction_output)
    return summary


def _blackbody(options: Namespace) -> xr.Dataset:
    """Counts of a blackbody at all temperatures."""
    frames = files.between(options, "frames", most=_SWEEP)
    if options.blackbody:
        return files.opened(options.blackbody).load()
    if options.sweep:
        from dbthermal.instruments import recording  # noqa: PLC0415 - optional

        return recording.open_sweep(*options.sweep, frames=frames.stop)
    movies = []
    for temperature, *paths in options.at:
        if isinstance(temperature, Path):
            raise ValueError(f"Invalid --at {temperature}. Must begin with a temperature: 20C.")
        try:  # nothing moves: any offset will do
            still = files.capture(paths, options, [0.0] * (len(options.bands or "ab") - 1))
        except ValueError as error:  # which names files; of one temperature there may be none
            raise ValueError(f"Blackbody at {temperature - zero_Celsius:g}C: {error}") from error
        stamps = still.get("exposure_time", still["time"].expand_dims("band"))
        good = np.flatnonzero(stamps.notnull().all("band"))  # padded and damaged frames have none
        files.check_all(good[frames].size, options, "frames", f"the blackbody at {temperature:g} K")
        movie = still[["counts"]].isel(time=good[frames]).load().drop_vars("time")
        movies.append(movie.rename(time="frame").expand_dims(temperature=[temperature]))
    if twice := repeated(temperature for temperature, *_ in options.at):
        rule = "Must be stated once: join its files, or leave some out"
        raise ValueError(f"Repeated --at {twice[0]}K ({twice[0] - zero_Celsius:g}C). {rule}.")
    # All temperatures have the frames of the shortest recording.
    number = min(movie.sizes["frame"] for movie in movies)
    joined: Any = {"dim": "temperature", "combine_attrs": lambda attrs, **_: schema.origin(*attrs)}
    counts = xr.concat([movie.isel(frame=slice(number)) for movie in movies], **joined)
    return counts.transpose("band", "temperature", "frame", "y", "x").sortby("temperature")


def correct(options: Namespace) -> dict[str, Any]:
    """Command `correct`."""
    stages = {"correction": "correction"} if options.correction else {}
    raw, *fitted = files.staged(options, capture="capture|corrected", **stages)
    named = {**accepted(correction.correct_capture, options), "shutter": not options.no_shutter}
    gain = _gain(options, raw, fitted)
    return files.saved(correction.correct_capture(raw, gain, lazy=True, **named), options)


def _gain(options: Namespace, raw: xr.Dataset, fitted: list[xr.Dataset]) -> xr.Dataset:
    """Gain and offset of each pixel: of a file, or corrected by the cameras."""
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
    is_part = "rows" in raw.attrs and raw.sizes["y"] < gain.sizes["y"]  # as of import --rows
    return gain.isel(y=slice(*raw.attrs["rows"])) if is_part else gain


def align(options: Namespace) -> dict[str, Any]:
    """Command `align`."""
    (corrected,) = files.staged(options, capture="corrected")
    options.register = options.register or "homography"
    if options.reference is not None:
        check_listed("Unknown --reference", options.reference, corrected["band"].values.tolist())
    named = {**_aligning(options, corrected), "clock": options.reference}
    if options.register != "none":
        named["transform"] = alignment.register(corrected, model=options.register)
    return files.saved(alignment.align(corrected, lazy=True, **named), options)


def _aligning(options: Namespace, capture: xr.Dataset) -> dict[str, Any]:
    """Options of an alignment, with the offset of each band."""
    named = accepted(alignment.align, options)
    if "offset" in named:
        first, *bands = capture["band"].values.tolist()
        if len(named["offset"]) != len(bands):
            rule = f"Must be {len(bands)}, one for each of the bands {bands}"
            raise ValueError(f"Invalid --offset {named['offset']}. {rule}.")
        offset = xr.DataArray([0.0, *named["offset"]], {"band": [first, *bands]}, "band")
        stamps = capture.get("exposure_time", capture["time"]) + offset
        shared = (stamps >= stamps.min("time").max()) & (stamps <= stamps.max("time").min())
        common, number = (int(it.sum("time").min()) for it in (shared, stamps.notnull()))
        if common < MOST_MISSING * number:
            label = f"{named['offset']}: it leaves {common} of {number} frames that all bands have"
            raise ValueError(f"Invalid --offset {label}. Must be in seconds, and leave half.")
        named["offset"] = offset
    return named


def separate(options: Namespace) -> dict[str, Any]:
    """Command `separate`."""
    # Inputs of the stages that the way needs.
    is_raw = bool(options.correction or options.corrected_by_camera)
    stages = {"capture": "capture|corrected" if is_raw else "corrected", "response": "response"}
    stages |= {"correction": "correction"} if options.correction else {}
    source, response, *fitted = files.staged(options, **stages)
    response.load()
    named = accepted(separation.run if options.method else separation.separate, options)
    named["progress"] = sys.stderr.isatty()
    if is_raw:  # all steps of a raw capture, by rows
        options.register = options.register or "homography"
        steps: Any = {"target": options.output, "provenance": files.provenance(options)}
        steps["registration"] = None if options.register == "none" else options.register
        steps |= {"aligning": _aligning(options, source), "separating": named}
        scene.separate_capture(source, _gain(options, source, fitted), response, **steps)
    elif options.method is None:  # the default call, in memory
        notes = [note for data in (source, response) for note in data.attrs.get("warnings", [])]
        result = separation.separate(source.load(), response, **named)
        return files.saved(schema.warned(result, *notes, *hardly_measured(result)), options)
    else:  # a single method, by rows
        if options.emissivity:
            axis = {"band": source["band"].values}
            if len(options.emissivity) != len(axis["band"]):
                rule = f"Must be one for each of the bands {axis['band'].tolist()}"
                raise ValueError(f"Invalid --emissivity {options.emissivity}. {rule}.")
            named["emissivity"] = xr.DataArray(options.emissivity, dims="band", coords=axis)
        made_by = files.provenance(options)
        separation.run(options.capture, options.output, response, provenance=made_by, **named)
    return {str(options.output): files.summary(store.open_dataset(options.output))}


def complete(options: Namespace) -> dict[str, Any]:
    """Command `complete`."""
    stages = {"result": "separated", "capture": "corrected", "response": "response"}
    result, source, response = (dataset.load() for dataset in files.staged(options, **stages))
    named = {**accepted(separation.complete, options), "materials": result.get("material")}
    return files.saved(separation.complete(result, source, response, **named), options)


def foreseen(options: Namespace, sources: list[Path], targets: list[Path]) -> dict[str, Any]:
    """Inputs and outputs of a command with their bytes, and the memory that a separation takes."""
    inputs = dict[str, Any]()
    for path in sources:
        contents = [file for file in (path, *path.rglob("*")) if file.is_file()]
        inputs[str(path)] = {"bytes": sum(file.stat().st_size for file in contents)}
        if (path / "zarr.json").is_file():
            inputs[str(path)] |= files.outline(files.opened(path))
    summary: dict[str, Any] = {"would_read": inputs, "would_write": [*map(str, targets)]}
    if options.command == "import":
        summary["would_be"] = files.outline(files.capture(options.files, options, options.offset))
    # Bytes of an output before its compression, and those that the disk has for it.
    outlines = [summary.get("would_be", {}), *inputs.values()]
    sized = [it["sizes"] for it in outlines if "time" in it.get("sizes", {})]
    if sized and (stage := _OUTPUTS.get(options.command)):
        lengths = {**sized[0], "axis": 2, "cause": len(schema.CAUSES)}
        lengths["other_band"] = lengths["band"]
        summary["would_write_bytes_at_most"] = sum(
            math.prod(lengths[dim] for dim in variable.dims) * np.dtype(variable.dtype).itemsize
            for variable in {**schema.STAGES[stage], **schema.OPTIONAL[stage]}.values()
        )
    if targets:
        place = next(folder for folder in targets[0].absolute().parents if folder.is_dir())
        summary["free_bytes"] = shutil.disk_usage(place).free
    if options.command == "separate":
        sizes = inputs[str(options.capture)].get("sizes", {})
        time, y, x = (sizes.get(dim, 0) for dim in ("time", "y", "x"))
        most = 2e9 if options.method else math.inf
        if options.correction or options.corrected_by_camera:
            most = max(3e9, BASE + scene.ROW * time * x)
        summary["memory_at_most_GB"] = round(min(BASE + scene.SAMPLE * time * y * x, most) / 1e9, 1)
    return summary


def plan(options: Namespace) -> dict[str, Any]:
    """Command `plan`."""
    table = emissivity.embedded_table()
    if options.materials:
        for name in options.materials:
            check_listed("Unknown material", name, table["material"].values.tolist())
        table = table.sel(material=[*dict.fromkeys(options.materials)])
    level = {"level": limits.SKY_LEVEL} if options.outdoors else {}
    design = limits.CaptureDesign(**accepted(limits.CaptureDesign, options), **level)
    noise = emissivity.filter_noise(options.noise, table["band"].values.tolist())
    plans = limits.plan(table, noise, design, outdoors=options.outdoors)
    deviations = plans["object_temperature_std"].transpose("filter", "material").to_pandas()
    numbers = dict[str, dict[str, Any]]()
    for name, best in plans["best"].to_series().items():
        stds = deviations[name].round(4).to_dict()
        numbers[str(name)] = {"best_filter": str(best), "object_temperature_std_K": stds}
    if options.outdoors:
        for name, costs in plans["sky_error"].transpose("filter", "material").to_pandas().items():
            numbers[str(name)]["sky_error_K"] = costs.round(4).to_dict()
    return {"answer": [*_table(numbers, noise, design, plans.attrs["beside"])], "numbers": numbers}


def _table(
    numbers: dict[str, Any], noise: xr.DataArray, design: limits.CaptureDesign, beside: str
) -> Iterator[str]:
    """Yield the lines of a plan: what it assumes, and a row for each material."""
    filters = [*next(iter(numbers.values()))["object_temperature_std_K"]]
    rises = f"the object rises by {design.span:g} K, the reflections by {design.amplitude:g} K for "
    rises += f"{design.duration:g} s in every {design.period:g} s"
    yield f"Assumed: {design.seconds:g} s at {design.rate:g} Hz; {rises}."
    behind = ", ".join(f"{float(noise.sel(band=name)):.2g} K ({name} um)" for name in filters)
    yield f"Noise of a frame behind a filter: {behind}."
    yield f"Deviation of the object's temperature [K], of band {beside} and a filter [um]:"
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


def data(_: Namespace) -> dict[str, Any]:
    """Command `data`."""
    table = emissivity.embedded_table()["emissivity"]
    edges = {name: (1e6 * it.lower, 1e6 * it.upper) for name, it in bands.FILTERS.items()}
    return {
        "filters_um": {name: np.round(it, 3).tolist() for name, it in edges.items()},
        "emissivity": table.transpose("band", "material").to_pandas().round(3).to_dict(),
        "outside_files": "listed by data_manifest.yaml of a clone, and fetched there by: make data",
    }
