"""Counts in files of NumPy, HDF5, NetCDF, MATLAB, zarr, or in an array that is opened already."""

import re
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal._arrays import Array, empty, parts
from dbthermal.readers import _containers as containers
from dbthermal.readers import _formats as formats
from dbthermal.readers import _recording as recordings
from dbthermal.readers._recording import MEMORY, Clock

# Names of dims by their place, and those of an array without names, of any case.
_DIMS: Final = ("time|t|frames?|images?", "y|rows?|height", "x|col(umn)?s?|width")
_WITHOUT_NAME: Final = r"||None|(phony_)?dim_\d+"
_LONGEST: Final = 2**16  # header of NumPy's format [byte]
_ATTRIBUTES: Final = (
    *("units", "unit", "scale_factor", "add_offset", "_FillValue", "missing_value", "origin"),
    "_Unsigned",
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
        As for `tiff`; an array's own ``units``, and its times to half a frame, must agree. Without
        a clock its times are taken; those without a unit are seconds if the rate is 1 to 1000 Hz.

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

    stored, path = np.inf, Path()
    if isinstance(source, str | Path):
        (path,) = formats.files([source], "array")
        inside = path.rglob("*") if path.is_dir() else [path]
        stored = sum(file.lstat().st_size for file in inside)
    rules = _Rules(label, unit, clock, memory, stored, {}, [])
    # The array, checked before it is read.
    with ExitStack() as stack:
        values: Any = source
        if not isinstance(source, str | Path):
            rules.check(source, containers.dims_of(source))
            coords = source.coords.values() if isinstance(source, xr.DataArray) else ()
            listed = (axis for axis in coords if containers.are_times(axis.name, axis))
            rules.compare(next(listed, None))
        elif (kind := formats.format_of(path)) in {"zarr", "HDF5", "NetCDF", "MATLAB 5"}:
            values = containers.read(path, kind, name, rules.check, rules.compare, stack)
        else:
            values = _numpy_file(path, name, rules, stack)
        read = values if isinstance(source, str | Path) else recordings.film(values)
    counts = read.view(np.uint16)
    # The numbers: byte order, and values that stand for missing counts.
    judged = stored < np.inf and any(np.any(frame & 0xFF) for frame in counts)
    if judged and recordings.smoother(counts) < 0:  # as after a flipped bit of the header
        rule = "rougher than with bytes swapped. Must be in the byte order that is stated"
        raise ValueError(f"Invalid counts of '{label}': {rule}.")
    attributes = rules.attributes
    fills = [attributes[name] for name in ("_FillValue", "missing_value") if name in attributes]
    fills = [float(fill) % 2**16 for fill in fills] if read.dtype.kind == "i" else fills
    recordings.check_present(counts, fills, label)
    clock = rules.seconds[0] if clock is None else clock
    return recordings.clocked(counts, clock, label, format="array", **schema.origin(attributes))


class _Rules(NamedTuple):
    """What an array must be: of counts, of a size, of times that the clock does not contradict."""

    label: str
    unit: str
    clock: Clock | None
    memory: float
    stored: float  # size of its file [byte]
    attributes: dict[str, Any]  # of the array, as it is checked
    seconds: list[Array]  # times of its frames, as they are compared

    def check(self, values: Any, dims: Sequence[Any] = ()) -> None:
        """Raise ValueError for what is no stack of counts, before it is read."""
        for dim, names in zip(dims, _DIMS, strict=False):
            if not re.fullmatch(f"{names}{_WITHOUT_NAME}", str(dim), re.IGNORECASE):
                rule = "Must be (time, y, x): rename or transpose"
                raise ValueError(f"Invalid dims {[*dims]} of '{self.label}'. {rule}.")
        texts = {name: containers.attribute(values, name) for name in _ATTRIBUTES}
        attributes = self.attributes
        attributes.update({name: text for name, text in texts.items() if text is not None})
        for scale, neutral in {"scale_factor": 1.0, "add_offset": 0.0}.items():
            if attributes.get(scale, neutral) != neutral:
                rule = f"Must be {neutral:g}: counts as measured"
                raise ValueError(f"Invalid '{scale}' of '{self.label}'. {rule}.")
        dtype = np.dtype(getattr(values, "dtype", object))
        unsigned = str(attributes.get("_Unsigned", "")).lower() in {"true", "1"}
        if dtype.itemsize != 2 or dtype.kind not in ("iu" if unsigned else "u"):
            rule = "Must be uint16: counts, neither temperatures nor objects; convert whole numbers"
            raise ValueError(f"Invalid dtype {dtype} of '{self.label}'. {rule}.")
        shape = getattr(values, "shape", ())
        recordings.check_memory(shape, self.memory, self.label, self.stored)
        text = str(attributes.get("units", attributes.get("unit", self.unit))).strip()
        recordings.check_unit(self.unit if text in {"", "1"} else text, self.label)

    def compare(self, times: Any) -> None:
        """Take times, if any; ValueError without them and a clock, or where those contradict."""
        moments = None if times is None else containers.moments(times)
        clock = next(iter(self.seconds), None) if self.clock is None else self.clock
        if moments is not None:
            text = "s" if times.dtype.kind in "OSU" else containers.attribute(times, "units")
            seconds = recordings.check_times(moments, str(text or ""), clock, self.label)
            self.seconds.append(seconds)
        elif clock is None:
            recordings.stamps(clock, 0, self.label)  # refuses it


def _numpy_file(path: Path, name: str | None, rules: _Rules, stack: ExitStack) -> Any:
    """Array of a .npy or of a .npz, whose checksums must be right."""
    stream: IO[bytes] = stack.enter_context(path.open("rb"))
    with recordings.damage_named(f"Damaged '{path.name}'", "a whole .npz"):
        if stream.read(2) != b"PK":
            stream.seek(0)
            return _numpy_array(stream, path.name, rules)
        archive = stack.enter_context(zipfile.ZipFile(path))
        members = archive.namelist()
        if not all(member.endswith(".npy") for member in members):
            rule = "Must hold arrays of NumPy alone: unpack it"
            raise ValueError(f"Invalid files {members[:3]} in '{path.name}'. {rule}.")
        names = [member.removesuffix(".npy") for member in members]
        member = archive.infolist()[names.index(recordings.array_name(names, name, path))]
        if member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            label = f"compression {member.compress_type} of '{member.filename}' of '{path.name}'"
            raise ValueError(f"Invalid {label}. Must be none or deflate, as of NumPy.")
        return _numpy_array(stack.enter_context(archive.open(member)), path.name, rules)


def _numpy_array(stream: IO[bytes], name: str, rules: _Rules) -> npt.NDArray[Any]:
    """Array in NumPy's format, which must end where its header says."""
    with recordings.damage_named(f"Invalid '{name}'", ".npy, .npz, HDF5, NetCDF or zarr"):
        version = np.lib.format.read_magic(stream)
        read, width = {
            (1, 0): (np.lib.format.read_array_header_1_0, 2),
            (2, 0): (np.lib.format.read_array_header_2_0, 4),
        }[version]
        start = stream.read(width)
        if (length := int.from_bytes(start, "little")) > _LONGEST:
            raise ValueError(f"Header of {length} bytes. Must be at most {_LONGEST}.")
        with warnings.catch_warnings(action="error"):  # of headers mended as of Python 2
            shape, by_columns, dtype = read(BytesIO(start + stream.read(length)))
    rules.check(SimpleNamespace(shape=shape, dtype=dtype))
    rules.compare(None)
    counts, size = empty(shape[::-1] if by_columns else shape, np.uint16), 0
    for frames in parts(counts):
        size += stream.readinto(counts[frames].view("u1").data)  # type: ignore[attr-defined]
        if not dtype.isnative:
            counts[frames].byteswap(inplace=True)
    size += len(stream.read(1))
    if size != counts.nbytes:
        actual = f"{size} bytes or more of counts in '{name}'"
        raise ValueError(f"Truncated or damaged {actual}. Must be {counts.nbytes}, by its header.")
    return counts.T if by_columns else counts
