"""Results as other programs read them: curves, films, pictures, NetCDF."""

import argparse
import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import store
from dbthermal._cli.files import opened, provenance


def export(options: argparse.Namespace) -> dict[str, Any]:
    """Command `export`."""
    result, suffix = opened(options.result), options.output.suffix
    options.variable = options.variable or "object_temperature"
    if suffix not in _WRITERS:
        raise ValueError(f"Invalid output '{options.output}'. Must end in one of {[*_WRITERS]}.")
    if options.variable not in result:
        names = sorted(map(str, result.data_vars))
        raise ValueError(f"Unknown variable '{options.variable}'. Must be one of {names}.")
    with store.whole(options.output, suffix) as part:
        return {str(options.output): _WRITERS[suffix](result, part, options)}


def _curves(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Means of places at each time; deviations as if errors were the same in all of a region.

    What is common to the pixels of a region, as the error of an emissivity, does not average out:
    the mean of the deviations is an upper limit of that of the mean.
    """
    names = [name for name in (options.variable, f"{options.variable}_std") if name in result]
    if set(result[names[0]].dims) != {"time", "y", "x"}:
        raise ValueError(f"Invalid '{names[0]}' {result[names[0]].dims}. Must be (time, y, x).")
    columns: dict[str, Any] = {"time_s": result["time"].values}
    said = {}
    for label, rows, across in _places(result, options):
        region = result.isel(y=rows, x=across)
        valid = np.isfinite(region[names[0]].values).all(axis=0)
        if not valid.any():
            raise ValueError(f"Empty {label}: no pixel has values at all times. Must have one.")
        said[label] = {"pixels": int(valid.sum()), "of": int(valid.size)}
        for name in names:
            unit = result[name].attrs.get("units", "1")
            columns[f"{name}_{label}_{unit}"] = region[name].values[:, valid].mean(axis=1)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return said


def _places(result: xr.Dataset, options: argparse.Namespace) -> Iterator[tuple[str, slice, slice]]:
    """Label, rows and columns of each place; all of the image if none is named."""
    height, width = result.sizes["y"], result.sizes["x"]
    boxes = [(y, y + 1, x, x + 1) for y, x in options.pixel] + [*map(tuple, options.region)]
    for top, bottom, left, right in boxes or [(0, height, 0, width)]:
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            found = f"rows {top} to {bottom}, columns {left} to {right}"
            raise ValueError(f"Invalid {found}. Must lie in the image of {height} x {width}.")
        one = bottom - top == right - left == 1
        label = f"pixel_{top}_{left}" if one else f"region_{top}_{bottom}_{left}_{right}"
        yield label, slice(top, bottom), slice(left, right)


def _film(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    import tifffile  # noqa: PLC0415 - optional

    one = result[options.variable]
    about = {"variable": one.name, "units": one.attrs.get("units"), **provenance(options)}
    values = one.values.astype(np.float32) if one.dtype.kind == "f" else one.values
    tifffile.imwrite(path, values, photometric="minisblack", description=json.dumps(about))
    return {"shape": list(values.shape), "dtype": str(values.dtype), "units": about["units"]}


def _picture(result: xr.Dataset, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Variable at the last time, in degrees Celsius if it is a temperature."""
    from dbthermal.figures import drawing  # noqa: PLC0415 - optional

    one = result[options.variable]
    image = one.isel({dim: -1 for dim in one.dims if dim not in ("y", "x")})
    unit = one.attrs.get("units", "1")
    if unit == "K" and not str(one.name).endswith("_std"):
        image, unit = image - zero_Celsius, "\N{DEGREE SIGN}C"
    figure, axes = drawing.canvas(1, 1, (6.4, 4.8))
    label = str(one.name).replace("_", " ")
    drawing.draw_image(figure, axes[0, 0], image, label, f"{label} [{unit}]")
    figure.suptitle(drawing.provenance_note(result).removeprefix(", "))
    store.save_figure(figure, path, provenance(options))
    return {
        "shape": list(image.shape),
        "at": {str(k): str(v.values) for k, v in image.coords.items()},
    }


def _netcdf(result: xr.Dataset, path: Path, _: argparse.Namespace) -> dict[str, Any]:
    """Everything in format 3, which holds neither mappings nor truth values as attributes."""
    plain = result.drop_encoding()
    for attrs in (plain.attrs, *(one.attrs for one in plain.variables.values())):
        long = {name: one for name, one in attrs.items() if isinstance(one, dict | bool | None)}
        attrs.update({name: json.dumps(one) for name, one in long.items()})
    plain.to_netcdf(path, engine="scipy")
    return {"variables": sorted(map(str, result.data_vars))}


_WRITERS = {".csv": _curves, ".tif": _film, ".png": _picture, ".nc": _netcdf}
