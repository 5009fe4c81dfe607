"""Counts in files of NumPy, HDF5, NetCDF, MATLAB, zarr, or in an array that is opened already."""

import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal.readers import _containers, _formats, _recording
from dbthermal.readers._recording import MEMORY, Clock

# Names of dims by their place, and dims of an array without names, in any case of letters.
_DIMS: Final = ("time|t|frames?|images?", "y|rows?|height", "x|col(umn)?s?|width")
_WITHOUT_NAME: Final = r"||None|(phony_)?dim_\d+"
_NEUTRAL: Final = {"scale_factor": 1, "scale": 1, "slope": 1, "add_offset": 0, "intercept": 0}
_ATTRIBUTES: Final = (
    *("units", "unit", *_NEUTRAL, "_FillValue", "missing_value", "origin", "_Unsigned"),
    *("long_name", "standard_name"),
)


def array(
    source: str | Path | npt.NDArray[Any] | xr.DataArray,
    name: str | None = None,
    *,
    unit: str,
    clock: Clock | None = None,
    memory: float = MEMORY,
) -> xr.Dataset:
    """Counts of a NumPy, HDF5, NetCDF, MATLAB or zarr file, or of an array that is opened already.

    Pickled objects are never loaded, and nothing is taken from another file. Damage of HDF5 and
    zarr without checksums is not seen. An array that another library has opened may be lazy.

    The Dataset is as from `tiff`, and so are the errors for unit, clock, memory and 8 bits.
    FileNotFoundError if there is no file, ImportError without the extra ``recordings`` for HDF5 and
    NetCDF 4; TypeError or ValueError if a file is damaged or of another format; the array is not of
    (time, y, x) and uint16, is scaled, lacks values, or has times that the clock contradicts.

    Parameters
    ----------
    source : str, Path, array or DataArray
        Regular file, folder of zarr, or an array or list of arrays: (time, y, x), uint16.
        Dims with names must have one of their place: time, t, frame, image; y, row, height; x,
        column, col, width.
    name : str, optional
        Name of the array in a file of several, such as ``"entry/frames"``.
    unit, clock, memory
        As for `tiff`; an array's own ``units``, and its times to half a frame, must agree. Without
        a clock its times are taken; those without a unit are seconds if the rate is 1 to 1000 Hz.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.arange(18000, 18024, dtype=np.uint16).reshape(2, 3, 4)
    >>> array(frames, unit="count", clock=30.0).sizes["time"]
    2
    """
    # Unit and memory, before a file is opened.
    is_file = isinstance(source, str | Path)
    label = Path(source).name if isinstance(source, str | Path) else "array"
    _recording.check_unit(unit, label)
    _numbers.real_number("memory", memory, _numbers.POSITIVE)
    (path,) = _formats.files([source], "array") if isinstance(source, str | Path) else (Path(),)
    inside = path.rglob("*") if path.is_dir() else [path]
    stored = sum(file.lstat().st_size for file in inside) if is_file else np.inf
    with ExitStack() as stack:
        # The array and its times, which are checked before it is read.
        values: Any = source
        if not (is_file or isinstance(getattr(source, "dtype", None), np.dtype)):
            values = np.asarray(source)  # of a list, or of another library
        if is_file:
            values, lines = _containers.opened(path, name, stack)
        else:
            coords = source.coords.values() if isinstance(source, xr.DataArray) else ()
            lines = dict([(c.name, c) for c in coords if _containers.are_times(c.name, c)][:1])
        attributes = _checked(values, label, unit)
        _recording.check_memory(getattr(values, "shape", ()), memory, label, stored)
        for line in lines.items():
            seconds = _seconds(line, values.shape[0], clock, label, path)
            clock = seconds if clock is None else clock
        if clock is None:
            _recording.stamps(clock, 0, label)  # refuses it
        read = _containers.read(values, path) if is_file else _recording.film(values)
    counts = read.view(np.uint16)
    # The numbers: byte order, and values that stand for missing counts.
    judged = is_file and any(np.any(frame & 0xFF) for frame in counts)
    if judged and _recording.smoother(counts) < 0:  # as after a flipped bit of the header
        rule = "rougher than with bytes swapped. Must be in the byte order that is stated"
        raise ValueError(f"Invalid counts of '{label}': {rule}.")
    fills = [attributes[name] for name in ("_FillValue", "missing_value") if name in attributes]
    fills = [float(fill) % 2**16 for fill in fills] if read.dtype.kind == "i" else fills
    _recording.check_present(counts, fills, label)
    assert clock is not None
    return _recording.clocked(counts, clock, label, format="array", **schema.origin(attributes))


def _checked(values: Any, label: str, unit: str) -> dict[str, Any]:
    """Attributes of an array, not yet read, whose dims, scale, type and unit are of counts."""
    for dim, names in zip(_containers.dims_of(values), _DIMS, strict=False):
        if not re.fullmatch(f"{names}{_WITHOUT_NAME}", str(dim), re.IGNORECASE):
            rule = "Must be (time, y, x): rename or transpose"
            raise ValueError(f"Invalid dims {_containers.dims_of(values)} of '{label}'. {rule}.")
    texts = {name: _containers.attribute(values, name) for name in _ATTRIBUTES}
    attributes = {name: text for name, text in texts.items() if text is not None}
    for scale, neutral in _NEUTRAL.items():
        if np.any((value := attributes.get(scale, neutral)) != neutral):
            rule = f"Must be {neutral}: counts as measured"
            raise ValueError(f"Invalid '{scale}' of '{label}', {value}. {rule}.")
    dtype = np.dtype(getattr(values, "dtype", object))
    unsigned = str(attributes.get("_Unsigned", "")).lower() in {"true", "1"}
    if dtype.itemsize != 2 or dtype.kind not in ("iu" if unsigned else "u"):
        rule = "Must be uint16 (in NetCDF 3 short, _Unsigned='true'): counts; convert whole numbers"
        raise ValueError(f"Invalid dtype {dtype} of '{label}'. {rule}.")
    name = "" if hasattr(values, "stream") else str(getattr(values, "name", ""))  # not of a file
    titles = f"{name.rpartition('/')[2]} {texts['long_name']} {texts['standard_name']}"
    if named := re.search("temperature|celsius|kelvin", titles, re.IGNORECASE):
        rule = "Must be counts: if it is, rename the array or its long_name"
        raise ValueError(f"Invalid array of '{label}', named '{named.group()}'. {rule}.")
    text = str(attributes.get("units", attributes.get("unit", unit))).strip()
    _recording.check_unit(unit if text in {"", "1"} else text, label)
    return attributes


def _seconds(line: Any, frames: int, clock: Clock | None, label: str, path: Path) -> Clock | None:
    """Seconds by named times, which the clock must not contradict; the clock for a text."""
    name, times = line
    if times.size != frames:
        rule = f"Must be {frames}, one for each frame"
        raise ValueError(f"Invalid number {times.size} of times of '{label}'. {rule}.")
    _containers.check_whole(times, path)
    if (moments := _containers.moments(times)) is None:
        return clock
    unit = "s" if times.dtype.kind in "OSU" else _containers.attribute(times, "units")
    unit = unit or (re.search("_(s|ms|us|ns)$", str(name).lower()) or ("", ""))[1]  # by its name
    return _recording.check_times(moments, str(unit), clock, label)
