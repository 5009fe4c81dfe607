"""Steps from a capture to a result, the plan of a capture, and the data of the package."""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

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
    separation,
)
from dbthermal._cli import PLUS, leaves
from dbthermal._cli.files import (
    capture,
    described,
    opened,
    outline,
    provenance,
    saved,
    staged,
)
from dbthermal._warnings import warned
from dbthermal.separation._doubts import hardly_measured
from dbthermal.separation._run import BASE


def calibrate(options: argparse.Namespace) -> dict[str, Any]:
    """Command `calibrate`."""
    stated = [name for name in ("at", "blackbody", "sweep", "maker") if getattr(options, name)]
    if len(stated) != 1:
        raise ValueError(
            f"Invalid sources {stated}. Must be --at, --blackbody, --sweep or --maker."
        )
    if options.maker:
        response = calibration.maker_response(opened(options.maker).attrs.get("files", {}))
        return saved(response, options)
    blackbody = _blackbody(options)
    if "frame" in blackbody.dims:
        blackbody = correction.blackbody_statistics(blackbody)
    fitted = correction.fit_correction(blackbody) if "y" in blackbody.dims else None
    counts = blackbody["counts"] if fitted is None else fitted["level"]
    response = calibration.fit_response(counts, blackbody.get("noise"))
    parts = leaves([options.at, options.blackbody, options.sweep])
    files = [str(one) for one in parts if isinstance(one, str | Path) and one != PLUS]
    response.attrs["blackbody"] += f"; of {', '.join(files)}"
    said = saved(response, options)
    if fitted is not None and options.correction_output:
        said |= saved(fitted, options, options.correction_output)
    return said


def _blackbody(options: argparse.Namespace) -> xr.Dataset:
    """Counts of a blackbody at all temperatures."""
    if options.blackbody:
        return opened(options.blackbody).load()
    if options.sweep:
        from dbthermal.instruments import recording  # noqa: PLC0415 - optional

        return recording.open_sweep(*options.sweep, frames=options.frames)
    if options.frames < 1:
        raise ValueError(f"Invalid --frames {options.frames}. Must be at least 1.")
    movies = []
    for temperature, *paths in options.at:
        if isinstance(temperature, Path):
            raise ValueError(f"Invalid --at {temperature}. Must begin with a temperature: 20C.")
        one = capture(paths, options, offset=0.0)  # of what rests
        good = np.arange(one.sizes["time"])
        if "exposure_time" in one:  # frames that are padded, or damaged, have none
            good = np.flatnonzero(one["exposure_time"].notnull().all("band"))
        frames = one["counts"].isel(time=good[: options.frames]).load()
        movie = frames.drop_vars("time").rename(time="frame")
        movies.append(movie.expand_dims(temperature=[temperature]))
    number = min(movie.sizes["frame"] for movie in movies)
    counts = xr.concat([movie.isel(frame=slice(number)) for movie in movies], dim="temperature")
    counts = counts.transpose("band", "temperature", "frame", "y", "x").sortby("temperature")
    return counts.to_dataset(name="counts")


def correct(options: argparse.Namespace) -> dict[str, Any]:
    """Command `correct`."""
    given = {"correction": "correction"} if options.correction else {}
    raw, *fitted = staged(options, capture="capture|corrected", **given)
    by_camera = options.corrected_by_camera
    files = raw.attrs.get("files", {}).values()
    # A maker's Planck constants hold for all pixels alike.
    of_maker = bool(files) and all("file_planck_R1" in one for one in files)
    if by_camera == bool(options.correction) and (by_camera or not of_maker):
        found = "both a file and --corrected-by-camera" if by_camera else "neither"
        raise ValueError(
            f"Invalid correction of gain and offset: {found}. Must be the file of 'dbthermal "
            "calibrate --correction-output nuc.zarr' or, only if the cameras correct gain and "
            "offset themselves, --corrected-by-camera."
        )
    gain = fitted[0].load() if fitted else correction.corrected_by_camera(raw)
    chosen = {"shutter": not options.no_shutter, "time_constant": options.time_constant}
    return saved(correction.correct_capture(raw, gain, lazy=True, **chosen), options)


def align(options: argparse.Namespace) -> dict[str, Any]:
    """Command `align`."""
    (corrected,), transform = staged(options, capture="corrected"), None
    options.register = options.register or "homography"
    if options.register != "none":
        transform = alignment.register(corrected, model=options.register)
    chosen = {"offset": options.offset, "search": options.search, "clock": options.reference}
    aligned = alignment.align(corrected, transform=transform, lazy=True, **chosen)
    return saved(aligned, options)


def separate(options: argparse.Namespace) -> dict[str, Any]:
    """Command `separate`."""
    stages = {"capture": "corrected", "response": "response"}
    if options.correction:
        stages |= {"capture": "capture|corrected", "correction": "correction"}
        options.register = options.register or "homography"
    source, response, *fitted = staged(options, **stages)
    tell_of_compiling()
    response.load()
    known, shown = _known(options), sys.stderr.isatty()
    if options.correction:
        offset = {} if options.offset is None else {"offset": options.offset}
        scene.separate_capture(
            source,
            fitted[0].load(),
            response,
            registration=None if options.register == "none" else options.register,
            aligning=offset,
            separating={**known, "progress": shown},
            target=options.output,
            provenance=provenance(options),
        )
    elif options.method is None:
        doubts = [one for data in (source, response) for one in data.attrs.get("warnings", [])]
        result = separation.separate(source.load(), response, **known, progress=shown)
        result = warned(result, *doubts, *hardly_measured(result))
        return saved(result, options)
    else:
        emissivities = None
        if options.emissivity:
            axis = {"band": source["band"].values}
            if len(options.emissivity) != len(axis["band"]):
                rule = f"Must be one for each of the bands {axis['band'].tolist()}"
                raise ValueError(f"Invalid --emissivity {options.emissivity}. {rule}.")
            emissivities = xr.DataArray(options.emissivity, dims="band", coords=axis)
        separation.run(
            options.capture,
            options.output,
            response,
            options.method,
            emissivity=emissivities,
            provenance=provenance(options),
            progress=shown,
        )
    return described(options.output)


def tell_of_compiling() -> None:
    """Say from now on, once, that the separation is compiled, if no earlier run left it so."""
    from numba.core import event  # noqa: PLC0415 - takes long

    class CompilerListener(event.Listener):
        """Listener to the compiler."""

        announced = False

        def on_start(self, _: event.Event) -> None:
            if not self.announced:
                text = "Compiling the separation, once after an installation: about a minute.\n"
                sys.stderr.write(text)
            self.announced = True

        def on_end(self, _: event.Event) -> None:
            """Say nothing more: a listener must have it."""

    event.register("numba:compile", CompilerListener())  # type: ignore[no-untyped-call]


def _known(options: argparse.Namespace) -> dict[str, Any]:
    """Options of the completion, and the number of threads."""
    return {name: getattr(options, name) for name in ("surroundings", "prior", "workers")}


def complete(options: argparse.Namespace) -> dict[str, Any]:
    """Command `complete`."""
    stages = {"result": "separated", "capture": "corrected", "response": "response"}
    result, source, response = (one.load() for one in staged(options, **stages))
    tell_of_compiling()
    completed = separation.complete(
        result, source, response, result.get("material"), **_known(options)
    )
    return saved(completed, options)


def foreseen(
    options: argparse.Namespace, sources: list[Path], targets: list[Path]
) -> dict[str, Any]:
    """Inputs and outputs of a command, and the memory that a separation takes at most."""
    read = dict[str, Any]()
    for path in sources:
        inside = [one for one in (path, *path.rglob("*")) if one.is_file()]
        read[str(path)] = {"bytes": sum(one.stat().st_size for one in inside)}
        if (path / "zarr.json").is_file():
            read[str(path)] |= outline(opened(path))
    said = {"would_read": read, "would_write": [*map(str, targets)]}
    if options.command == "import":
        said["would_be"] = outline(capture(options.files, options, options.offset))
    if options.command == "separate":
        sizes = read[str(options.capture)].get("sizes", {})
        byte = BASE + scene.SAMPLE * math.prod(sizes.get(dim, 0) for dim in ("time", "y", "x"))
        most = 3e9 if options.correction else 2e9 if options.method else math.inf  # by rows
        said["memory_at_most_GB"] = round(min(byte, most) / 1e9, 1)
    return said


def plan(options: argparse.Namespace) -> dict[str, Any]:
    """Command `plan`."""
    table = emissivity.embedded_table()
    if options.materials:
        known = table["material"].values.tolist()
        for name in options.materials:
            if name not in known:
                raise ValueError(f"Unknown material '{name}'. Must be one of {known}.")
        table = table.sel(material=options.materials)
    numbers = {name: getattr(options, name) for name in ("seconds", "rate", "span", "amplitude")}
    noise = emissivity.filter_noise(options.noise, table["band"].values.tolist())
    expected = limits.plan(table, noise, limits.CaptureDesign(**numbers))
    names = [str(name) for name in expected["filter"].values]
    rows = zip(
        expected["material"].values,
        expected["best"].values,
        expected["object_temperature_std"].values.round(4).tolist(),
        strict=True,
    )
    return {
        str(material): {
            "best_filter": str(best),
            "object_temperature_std_K": dict(zip(names, stds, strict=True)),
        }
        for material, best, stds in rows
    }


def data(_: argparse.Namespace) -> dict[str, Any]:
    """Command `data`."""
    table = emissivity.embedded_table()["emissivity"]
    return {
        "filters_um": {
            name: [round(1e6 * band.lower, 3), round(1e6 * band.upper, 3)]
            for name, band in bands.FILTERS.items()
        },
        "emissivity": {
            str(one["material"].values): dict(
                zip(table["band"].values.tolist(), one.values.round(3).tolist(), strict=True)
            )
            for one in table
        },
        "outside_files": "listed by data_manifest.yaml of a clone, and fetched there by: make data",
    }
