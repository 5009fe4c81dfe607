"""Results for other programs: curves, films, pictures, NetCDF; reports and explorers."""

import argparse
import json
import math
from collections.abc import Iterable, Sequence
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import explorer, schema, store
from dbthermal._cli.files import ANIMATED, PICTURES, opened, provenance, staged
from dbthermal.explorer._films import FILMS


def export(options: argparse.Namespace) -> dict[str, Any]:
    """Command `export`."""
    # The variable, which must be of the kind that the file shows.
    result, suffix = opened(options.result), options.output.suffix
    options.variable, *further = options.variable or ["object_temperature"]
    if suffix not in _WRITERS:
        raise ValueError(f"Invalid output '{options.output}'. Must end in one of {[*_WRITERS]}.")
    if suffix != ".nc":  # pictures, or curves over time, of which bridged frames have none
        dims, last = (("y", "x"), 2) if suffix in (".tif", *PICTURES) else (("time", "y", "x"), 4)
        missing = {*str(result.attrs.get("not_estimated", "")).split(), "bridged" * (last == 4)}
        fitting = {str(name) for name in result if result[name].dims[-last:] == dims}
        if not (names := sorted(fitting - missing)):
            rule = "Must be a result, as from: dbthermal separate; *.nc takes any store"
            raise ValueError(f"No variable with times and pixels in '{options.result}'. {rule}.")
        if further or options.variable not in names:
            kind = f"Unknown variable '{' '.join([options.variable, *further])}' for {suffix}"
            state = "" if FILMS.keys() & {*result} else f" '{options.result}' has no result."
            raise ValueError(f"{kind}.{state} Must be one of {names}.")
    # A film or picture has that of the status beside it.
    outputs = {options.output: options.variable}
    if suffix in (".tif", *PICTURES) and "status" in result and options.variable != "status":
        outputs[options.output.with_stem(f"{options.output.stem}_status")] = "status"
    for path in (it for it in outputs if it.exists() and not options.overwrite):
        raise FileExistsError(f"There is something at '{path}'. Must be new, or --overwrite.")
    summary = {}
    for path, options.variable in outputs.items():
        with store.whole(path, suffix) as draft:
            summary[str(path)] = _WRITERS[suffix](result, draft, options)
    return summary


def _curves(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Mean, extremes, deviation, number of pixels and status of each place, or image, over time."""
    # A single pixel counts with its flags, in a region the measured pixels, which have none.
    view, columns = explorer.View(result), dict[str, xr.DataArray]()
    height, width = view.shape
    boxes = [(y, y + 1, x, x + 1) for y, x in options.pixel] + [*map(tuple, options.region)]
    pane = view.panes[options.variable]
    for top, bottom, left, right in boxes or [(0, height, 0, width)]:
        ((label, region),) = _regions(result, [(top, bottom, left, right)]).items()
        single = bottom - top == right - left == 1
        curve = view.curve(options.variable, region, pixels="all" if single else "measured")
        place = f"pixel {top} {left}" if single else f"{label.replace(',', '')} measured"
        for name, values in curve.drop_vars([*_EXTREMES, "pixels"] if single else []).items():
            unit, zero = values.attrs.get("units", "1"), 0.0
            if name in {"mean", *_EXTREMES} and pane.absolute:
                unit, zero = "degC", zero_Celsius
            columns[f"{place} {name} [{unit}]"] = (values.astype(float) - zero).round(_DECIMALS)
        bits = schema.Status(int(view.status[top, left]) if single else 0)
        flags = " ".join(bit.label for bit in bits) or "no_flag"
        flags = flags if "status" in view.panes else "unknown"
        columns[f"{place} status"] = xr.full_like(curve["mean"], flags, dtype=object)
    # Times to a thousandth of a frame.
    table, period = xr.Dataset(columns), float(np.median(np.diff(view.time, prepend=-1.0)))
    time = np.round(view.time, 3 - math.floor(math.log10(period))) + 0.0  # no -0.0
    table.assign_coords(time=time).to_dataframe().to_csv(path, index_label="time [s]")
    return {"columns": ["time [s]", *columns]}


def _regions(result: xr.Dataset, boxes: Iterable[Sequence[int]]) -> dict[str, explorer.Region]:
    """Rectangles y0 y1 x0 x1 by their names; they must lie in the image."""
    regions, height, width = {}, result.sizes["y"], result.sizes["x"]
    for top, bottom, left, right in boxes:
        label = f"rows {top} to {bottom - 1}, columns {left} to {right - 1}"
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            rule = f"Must lie in the image of {height} x {width}, and end after it begins"
            raise ValueError(f"Invalid region {top} {bottom} {left} {right}. {rule}.")
        regions[label] = explorer.Region("rectangle", ((top, left), (bottom, right)))
    return regions


def _film(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Write all frames of a variable as a TIFF stack, with its provenance as JSON."""
    import tifffile  # noqa: PLC0415 - optional

    array = result[options.variable]
    about = {"variable": array.name, "units": array.attrs.get("units"), **provenance(options)}
    about |= schema.origin(result.attrs)
    about |= {str(dim): array[dim].values.tolist() for dim in array.dims[:-2] if dim != "time"}
    values = array.values.astype(np.float32) if array.dtype.kind == "f" else array.values
    tifffile.imwrite(path, values, photometric="minisblack", description=json.dumps(about))
    return {"shape": list(values.shape), "dtype": str(values.dtype), "units": about["units"]}


def _animation(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Animate a variable, in degrees Celsius if it is a temperature."""
    from dbthermal.explorer._export import Shown, save_film  # noqa: PLC0415 - optional

    save_film(explorer.View(result), path, Shown([options.variable], 0, {}, celsius=True))
    return {"bytes": path.stat().st_size}


def _picture(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Draw all bands or causes of a variable at the last time, a temperature in degrees Celsius."""
    from dbthermal import figures  # noqa: PLC0415 - optional

    if options.variable == "status":
        store.save_figure(figures.status(result), path, provenance(options))
        return {"shape": list(result["status"].shape)}
    array = result[options.variable]
    unit, label, titles = array.attrs.get("units", "1"), array.name.replace("_", " "), list[str]()
    if array.name in FILMS:
        array, unit = array - zero_Celsius, "\N{DEGREE SIGN}C"
    moment = f", {array['time'][-1]:g} s" if "time" in array.dims else ""
    array = array.isel(time=-1, missing_dims="ignore")
    # A picture of each band, cause or axis.
    dims, shape = array.dims[:-2], array.shape[:-2]
    columns = next(number for number in (3, 2, 1) if math.prod(shape) % number == 0)
    rows = math.prod(shape) // columns
    figure, axes = figures.drawing.canvas(rows, columns, (2.2 + 4.2 * columns, 1.6 + 3.2 * rows))
    for axis, place in zip(axes.ravel().tolist(), np.ndindex(*shape), strict=True):
        at = [f", {dim} {array[dim].values[n]}" for dim, n in zip(dims, place, strict=True)]
        titles.append("".join([label, moment, *at]))
        figures.drawing.draw_image(figure, axis, array[place], titles[-1], f"{label} [{unit}]")
    figure.suptitle(figures.drawing.provenance_note(result))
    store.save_figure(figure, path, provenance(options))
    return {"shape": [*array.shape[-2:]], "images": titles}


def _netcdf(result: xr.Dataset, path: Path, _: argparse.Namespace) -> dict[str, Any]:
    """Write everything in format 3, with what its attributes cannot hold as JSON."""
    short = [name for name in result if result[name].dtype == np.uint16]  # which it has not
    plain = result.drop_encoding().assign({name: result[name].astype("i4") for name in short})
    for attrs in (plain.attrs, *(variable.attrs for variable in plain.variables.values())):
        for name, value in attrs.items():
            if not isinstance(value, str) and np.asarray(value).dtype.kind not in "fiu":
                attrs[name] = json.dumps(value)
    plain.to_netcdf(path, engine="scipy")
    return {"variables": sorted(map(str, result.data_vars))}


def _shown(options: argparse.Namespace, stages: str) -> list[xr.Dataset]:
    """Result of a stage, with its capture and the cameras' response if they are named."""
    if len(options.shown) > 2:
        label = f"{len(options.shown)} stores beside '{options.result}'"
        raise ValueError(f"Invalid {label}. Must be its capture, and the cameras' response.")
    sources = dict(zip(("capture", "response"), options.shown, strict=False))
    kinds = {name: {"capture": "corrected|capture"}.get(name, name) for name in sources}
    return staged(argparse.Namespace(result=options.result, **sources), result=stages, **kinds)


def report(options: argparse.Namespace) -> dict[str, Any]:
    """Command `report`."""
    from dbthermal import reporting  # noqa: PLC0415 - optional

    result, *shown = _shown(options, "separated")
    named = {name: vars(options)[name] for name in ("title", "logo") if vars(options)[name]}
    today = f"reported on {datetime.now().astimezone():%Y-%m-%d}"
    named["author"], regions = ", ".join(filter(None, [options.author, today])), options.region
    reporting.report(result, options.output, *shown, regions=_regions(result, regions), **named)
    return {str(options.output): {"bytes": options.output.stat().st_size}}


def explore(options: argparse.Namespace) -> dict[str, Any]:
    """Command `explore`: a notebook of one cell, which JupyterLab opens."""
    explorer.View(*_shown(options, "separated|corrected|capture"))  # refuses what cannot be shown
    paths = ", ".join(repr(str(path.resolve())) for path in [options.result, *options.shown])
    cell: dict[str, Any] = {"id": "explore", "cell_type": "code", "metadata": {}, "outputs": []}
    cell |= {"execution_count": None, "source": f"import dbthermal\n\ndbthermal.explore({paths})"}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = {"cells": [cell], "metadata": {"kernelspec": kernel}, "nbformat": 4}
    with store.whole(options.output, ".ipynb") as draft:
        draft.write_text(json.dumps(notebook | {"nbformat_minor": 5}), encoding="utf-8")
    lacks = any(find_spec(library) is None for library in ("anywidget", "jupyterlab"))
    install = ", in a clone: python -m pip install '.[explorer]' jupyterlab; then" if lacks else ""
    return {str(options.output): f"opened by{install}: jupyter lab {quote(str(options.output))}"}


_EXTREMES = ("minimum", "maximum")  # of the pixels of a region
_DECIMALS = 4  # of the values in a table: a tenth of a millikelvin
_WRITERS = {".csv": _curves, ".tif": _film, ".nc": _netcdf}
_WRITERS |= dict.fromkeys(PICTURES, _picture) | dict.fromkeys(ANIMATED, _animation)
