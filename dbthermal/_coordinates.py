"""Coordinates of two arrays must be the same, or an error names them.

Bands go by name, in any order; along all other dims both arrays have the same size and the same
coordinate, if both have one. An array without a coordinate goes by position.
"""

from collections.abc import Sequence
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema

Laid = TypeVar("Laid", xr.DataArray, xr.Dataset)

_STEP: Final = 1e-4  # share of the smallest step that a rounded coordinate may be off
_ROUNDING: Final = 4.0  # units in the last place of the largest value, likewise


def laid_on(
    array: Laid,
    reference: xr.DataArray | xr.Dataset,
    label: str,
    of: str,
    dims: Sequence[str] = ("band", "time", "temperature", "material", "y", "x"),
) -> Laid:
    """Array with the bands, order and coordinates of a reference; a ValueError names the two."""
    schema.require(array, (xr.DataArray, xr.Dataset), label)
    # Bands by name, then every common dim.
    shared = [dim for dim in dims if dim in array.dims and dim in reference.dims]
    if "band" in shared and "band" in array.coords and "band" in reference.coords:
        names = [str(name) for name in reference["band"].values]
        array = array.isel(band=schema.band_positions(array, names, label))
    for dim in shared:
        if array.sizes[dim] != reference.sizes[dim]:
            rule = f"Must be that of {of}, {reference.sizes[dim]}"
            raise ValueError(f"Invalid size {array.sizes[dim]} of '{dim}' of {label}. {rule}.")
        if dim in array.coords and dim in reference.coords:
            _require_same(array[dim].values, reference[dim].values, f"'{dim}' of {label}", of)
    places = {dim: reference[dim].variable for dim in shared if dim in reference.coords}
    return array.assign_coords(places)


def _require_same(
    values: npt.NDArray[Any], reference: npt.NDArray[Any], label: str, of: str
) -> None:
    """ValueError where two coordinates differ: numbers beyond rounding, all else as text."""
    if {values.dtype.kind, reference.dtype.kind} <= set("iuf"):
        actual, wanted = values.astype(np.float64), reference.astype(np.float64)
        floats = [np.finfo(it.dtype).eps for it in (values, reference) if it.dtype.kind == "f"]
        tolerance = _ROUNDING * max(floats, default=0.0) * np.abs(wanted).max(initial=0.0)
        if wanted.size > 1:
            tolerance += _STEP * np.abs(np.diff(wanted)).min()
        equal = np.abs(actual - wanted) <= tolerance
    else:
        equal = values.astype(str) == reference.astype(str)
    if not equal.all():
        first = int(np.argmin(equal))
        label = f"Invalid {label}: {values[first]} at position {first}, where that of {of} is"
        raise ValueError(f"{label} {reference[first]}. Must be the same.")
