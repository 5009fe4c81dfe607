"""Counts in files of NumPy, HDF5, NetCDF and zarr, or in an array that is opened already."""

import re
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal._arrays import empty, parts
from dbthermal.readers import _containers as containers
from dbthermal.readers import _recording as recordings
from dbthermal.readers._recording import MEMORY, Clock

# Names of dims by their place, and those of an array without names, of any case.
_DIMS: Final = ("time|t|frames?|images?", "y|rows?|height", "x|col(umn)?s?|width")
_WITHOUT_NAME: Final = r"||None|(phony_)?dim_\d+"
_UNITS: Final = {"seconds": "s", "milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"}
_SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ATTRIBUTES: Final = (
    *("units", "unit", "scale_factor", "add_offset", "_FillValue", "missing_value", "origin"),
)


def array(
    source: str | Path | npt.NDArray[Any] | xr.DataArray,
    name: str | None = None,
    *,
    unit: str,
    clock: Clock,
    memory: float = MEMORY,
) -> xr.Dataset:
    """Counts of a NumPy, HDF5, NetCDF or zarr file, or of an array that is opened already.

    The format is that of the first bytes. Pickled objects are never loaded, and nothing is taken
    from another file. HDF5 and zarr may be without checksums; damage of their values is then not
    seen, as in any copy. An array that another library has opened may be lazy.

    Parameters
    ----------
    source : str, Path, array or DataArray
        Regular file, folder of zarr, or an array with `shape` and `dtype`: (time, y, x), uint16.
        Dims with names must have one of their place: time, t, frame, image; y, row, height; x,
        column, col, width.
    name : str, optional
        Name of the array in a file of several, such as ``"entry/frames"``.
    unit, clock, memory
        As for `tiff`; an array's own ``units``, and its times to half a frame, must agree.

    Returns
    -------
    Dataset
        As from `tiff`.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    ImportError
        If h5py, the extra ``recordings``, is not installed for HDF5, which NetCDF 4 is too.
    TypeError, ValueError
        If a file is of another format, or damaged; the array is not one of three dimensions and
        uint16, has other dims, is scaled, lacks values, has times that the clock contradicts, or is
        not in the file; as `tiff` for unit, clock, memory and 8 bits.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.arange(18000, 18024, dtype=np.uint16).reshape(2, 3, 4)
    >>> array(frames, unit="count", clock=30.0).sizes["time"]
    2
    """
    # Unit and memory, before a file is opened.
    label = Path(source).name if isinstance(source, str | Path) else "array"
    recordings.check_unit(unit, label)
    recordings.check_number(memory, "memory")

    attributes = dict[str, Any]()

    def check(values: Any, dims: Sequence[Any], times: Any = None) -> None:
        for dim, names in zip(dims, _DIMS, strict=False):
            if not re.fullmatch(f"{names}{_WITHOUT_NAME}", str(dim), re.IGNORECASE):
                rule = "Must be (time, y, x): rename or transpose"
                raise ValueError(f"Invalid dims {[*dims]} of '{label}'. {rule}.")
        attrs = getattr(values, "attrs", {})
        attributes.update({name: attrs[name] for name in _ATTRIBUTES if name in attrs})
        for scale in {"scale_factor", "add_offset"} & attributes.keys():
            raise ValueError(f"Invalid '{scale}' of '{label}'. Must be counts as measured.")
        dtype = getattr(values, "dtype", np.dtype(object))
        _check(getattr(values, "shape", ()), dtype, memory, label)
        text = attributes.get("units", attributes.get("unit", unit))
        recordings.check_unit(text.decode() if isinstance(text, bytes) else str(text), label)
        if times is not None:
            _check_times(times, clock, label)

    # The array, checked before it is read.
    with ExitStack() as stack:
        values: Any = source
        if not isinstance(source, str | Path):
            coords = source.coords.values() if isinstance(source, xr.DataArray) else ()
            times = [axis for axis in coords if containers.are_times(axis.name, axis)]
            check(source, containers.dims_of(source), *times[:1])
        elif containers.kind_of(Path(source)):
            values = containers.read(Path(source), name, check, memory, stack)
        else:
            (path,) = recordings.files([source])
            values = _numpy_file(path, name, memory, stack)
        counts: Any = values if isinstance(source, str | Path) else recordings.film(values)
    # The numbers: byte order, and values that stand for missing counts.
    judged = isinstance(source, str | Path) and any(np.any(frame & 0xFF) for frame in counts)
    if judged and recordings.smoother(counts) < 0:  # as after a flipped bit of the header
        rule = "rougher than with bytes swapped. Must be in the byte order that is stated"
        raise ValueError(f"Invalid counts of '{label}': {rule}.")
    fills = [attributes[name] for name in ("_FillValue", "missing_value") if name in attributes]
    recordings.check_present(counts, fills, label, masked=np.ma.is_masked(values))
    return recordings.clocked(counts, clock, label, format="array", **schema.origin(attributes))


def _check(shape: tuple[int, ...], dtype: np.dtype[Any], memory: float, name: str) -> None:
    """Raise ValueError for what is no stack of counts, before it is read."""
    if dtype.kind != "u" or dtype.itemsize != 2:
        rule = "Must be uint16: counts, neither temperatures nor objects"
        raise ValueError(f"Invalid dtype {dtype} of '{name}'. {rule}.")
    recordings.check_memory(shape, memory, name)


def _check_times(times: Any, clock: Clock, name: str) -> None:
    """Raise ValueError for an array's own times that do not rise, or that the clock contradicts."""
    values, unit = np.asarray(times[...]), times.attrs.get("units", "s")
    unit = (unit.decode() if isinstance(unit, bytes) else str(unit)).partition(" since ")[0]
    if values.dtype.kind in "mM":
        values, unit = (values - values[0]) / np.timedelta64(1, "s"), "s"
    if values.dtype.kind not in "iuf":
        return
    if (unit := _UNITS.get(unit, unit)) not in _SECONDS:
        raise ValueError(f"Invalid units '{unit}' of the times of '{name}'. Must be s, ms, us, ns.")
    seconds = (values.astype(np.float64) - values[0]) * _SECONDS[unit]
    stated = recordings.stamps(clock, len(seconds), name)
    agrees = np.abs(seconds - stated) <= 0.5 * stated[-1] / max(len(stated) - 1, 1)
    agrees &= np.diff(seconds, prepend=-1.0) > 0
    if not agrees.all():
        first = int(np.argmin(agrees))
        mismatch = f"frame {first} at {seconds[first]:g} s, by clock= at {stated[first]:g}"
        rule = "Must agree to half a frame, and rise: give clock= the times, or leave those out"
        raise ValueError(f"Invalid times of '{name}': {mismatch}. {rule}.")


def _numpy_file(path: Path, name: str | None, memory: float, stack: ExitStack) -> Any:
    """Array of a .npy or of a .npz, whose checksums must be right."""
    stream: IO[bytes] = stack.enter_context(path.open("rb"))
    with recordings.damage_named(f"Damaged '{path.name}'", "a whole .npz"):
        if stream.read(2) == b"PK":
            archive = stack.enter_context(zipfile.ZipFile(path))
            names = [member.removesuffix(".npy") for member in archive.namelist()]
            place = names.index(recordings.array_name(names, name, path))
            stream = stack.enter_context(archive.open(archive.namelist()[place]))
        else:
            stream.seek(0)
        return _numpy_array(stream, path.name, memory)


def _numpy_array(stream: IO[bytes], name: str, memory: float) -> npt.NDArray[Any]:
    """Array in NumPy's format, which must end where its header says."""
    with recordings.damage_named(f"Invalid '{name}'", ".npy, .npz, HDF5, NetCDF or zarr"):
        version = np.lib.format.read_magic(stream)
        headers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        with warnings.catch_warnings(action="error"):  # of headers mended as of Python 2
            shape, by_columns, dtype = headers[version](stream)
    _check(shape, dtype, memory, name)
    counts, size = empty(shape[::-1] if by_columns else shape, np.uint16), 0
    for frames in parts(counts):
        size += stream.readinto(counts[frames].view("u1").data)  # type: ignore[attr-defined]
        if not dtype.isnative:
            counts[frames].byteswap(inplace=True)
    size += len(stream.read(1))
    if size != counts.nbytes:
        read = f"{size} bytes or more of counts in '{name}'"
        raise ValueError(f"Truncated or damaged {read}. Must be {counts.nbytes}, by its header.")
    return counts.T if by_columns else counts
