"""Counts in files of NumPy, HDF5, NetCDF, MATLAB, zarr, or in an array that is opened already.

An array of a file is left on disk until its form, its times and its size are checked.
"""

import bz2
import lzma
import math
import re
import struct
import warnings
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
import zarr

from dbthermal import _numbers, _text, schema
from dbthermal.readers import _formats, _recording, _variables
from dbthermal.readers._recording import MEMORY, Clock

# Names of times, perhaps with their unit, of an array beside another, or a dim.
_TIMES: Final = re.compile("((frame_?)?time(s|_?stamps?)?|t)(_(s|ms|us|ns))?", re.IGNORECASE)
# And further names, of an array with a value for each frame that rises: durations do not.
_LIKE_TIMES: Final = ".*(time|zeit|clock|stamp|seconds|elapsed).*"
_ANY_TIMES: Final = re.compile(f"{_TIMES.pattern}|{_LIKE_TIMES}", re.IGNORECASE)
# Names of dims by their place, and dims of an array without names, in any case of letters.
_DIMS: Final = (f"{_TIMES.pattern}|frames?|images?", "y|rows?|height", "x|col(umn)?s?|width")
_WITHOUT_NAME: Final = r"||None|(phony_)?dim_\d+"
_NEUTRAL: Final = {"scale_factor": 1, "scale": 1, "slope": 1, "add_offset": 0, "intercept": 0}
_RATES: Final = ("fps", "frame_rate", "framerate")  # names of a rate, of an array or its file
_ATTRIBUTES: Final = (
    *("units", "unit", *_NEUTRAL, "_FillValue", "missing_value", "origin", "_Unsigned"),
    *("long_name", "standard_name", "valid_min", "valid_max", "valid_range"),
)
_OBJECTS, _DEPTH = 4096, 32  # of a file of HDF5; one with more takes minutes to list
_LONGEST: Final = 2**10  # of a time [byte]; longer text, as a table in each place, is none
_CHECKSUMS: Final = ("fletcher32", "crc32", "crc32c", "adler32")
_SHUFFLE, _SUM = 2, 3  # codes of HDF5's filters: shuffle, sum of 4 bytes; below, those that pack
_PACKERS: Final = {1: "zlib", 307: "bz2", 32000: "lzf", 32001: "blosc", 32004: "lz4 of HDF5"}
_PACKERS.update({32008: "lz4 of HDF5", 32015: "zstd"})  # bitshuffle begins in the same way
_VLEN: Final = 16  # of a place of text elsewhere in a file of HDF5 [byte]
_CHUNK: Final = r"(c\.)?\d+(\.\d+)*"
_LOSSLESS: Final = "delta|(bit)?shuffle|crc32c?|adler32|fletcher32|transpose(codec)?"
_NO_VARIABLE: Final = "This is a netCDF dimension but not a netCDF variable"


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
    files = path.rglob("*") if path.is_dir() else [path]
    stored = sum(file.lstat().st_size for file in files) if is_file else np.inf
    with ExitStack() as stack:
        # The array and its times, which are checked before it is read.
        values: Any = source
        if not (is_file or isinstance(getattr(source, "dtype", None), np.dtype)):
            values = np.asarray(source)  # of a list, or of another library
        if is_file:
            values, lines = _opened(path, name, stack)
        else:
            coords = source.coords.values() if isinstance(source, xr.DataArray) else ()
            lines = dict([(c.name, c) for c in coords if _are_times(c.name, c, _TIMES)][:1])
        attributes = _checked(values, label, unit)
        _recording.check_memory(getattr(values, "shape", ()), memory, label, stored)
        rates, sentences = _rates(values, lines, path), list[str]()
        for line in lines.items():
            if (seconds := _seconds(line, values.shape[0], clock, label, path)) is None:
                number, frames = line[1].size, values.shape[0]
                form = "another text" if number == frames else f"{number} for {frames} frames"
                rule = "Must be numbers or ISO 8601, one a frame; clock= is not compared with them"
                sentences.append(f"Times '{line[0]}' of '{label}' are {form}. {rule}.")
            clock = seconds if clock is None else clock
        stamps = _recording.stamps(clock, values.shape[0], label, *sentences)
        read = _read(values, path) if is_file else _recording.film(values)
    counts = read.view(np.uint16)
    # The numbers: byte order, and values that stand for missing counts.
    _recording.check_byte_order(counts, label)
    fills = [attributes[name] for name in ("_FillValue", "missing_value") if name in attributes]
    fills = [float(fill) % 2**16 for fill in fills] if read.dtype.kind == "i" else fills
    _recording.check_present(counts, fills, label)
    low, high = attributes["valid_range"]
    if low < high and (counts.min() < low or counts.max() > high):  # else it is no range
        rule = f"Must lie within valid_range, {low:g} to {high:g}: beyond, none was measured"
        raise ValueError(f"Invalid counts of '{label}', {counts.min()} to {counts.max()}. {rule}.")
    sentences += [it for rate in rates for it in _recording.another_rate(rate, stamps, label)]
    origin, labels = schema.origin(attributes), (schema.MEASURED, "simulated", "emulated")
    if origin and not origin["origin"].strip().lower().startswith(labels):
        rule = f"Must begin with one of {[*labels]}: it is taken for measured"
        sentences.append(f"Unknown origin '{origin.pop('origin')}' of '{label}'. {rule}.")
    return _recording.clocked(counts, stamps, label, *sentences, format="array", **origin)


def _checked(values: Any, label: str, unit: str) -> dict[str, Any]:
    """Attributes of an array, not yet read, whose dims, scale, type and unit are of counts."""
    for dim, names in zip(_dims_of(values), _DIMS, strict=False):
        if not re.fullmatch(f"{names}{_WITHOUT_NAME}", str(dim), re.IGNORECASE):
            rule = "Must be (time, y, x): rename or transpose"
            raise ValueError(f"Invalid dims {_dims_of(values)} of '{label}'. {rule}.")
    texts = {name: _attribute(values, name) for name in _ATTRIBUTES}
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
    if named := re.search("temperature|celsius|kelvin|fahrenheit", titles, re.IGNORECASE):
        rule = "Must be counts: if it is, rename the array or its long_name"
        raise ValueError(f"Invalid array of '{label}', named '{named.group()}'. {rule}.")
    ends = [attributes.get("valid_min", 0), attributes.get("valid_max", 2**16 - 1)]
    limits = np.ravel(attributes.get("valid_range", ends))
    name = f"valid_range, or valid_min and valid_max, of '{label}'"
    attributes["valid_range"] = _numbers.real_numbers(name, limits, shape=(2,)) % 2**16  # signed
    text = str(attributes.get("units", attributes.get("unit", unit))).strip()
    _recording.check_unit(unit if text in {"", "1"} else text, label)
    return attributes


def _seconds(line: Any, frames: int, clock: Clock | None, label: str, path: Path) -> Clock | None:
    """Seconds by named times, which the clock must not contradict; None of a text, or too few."""
    name, times = line
    if times.size != frames or (moments := _moments(times, path)) is None:
        return None
    unit = "s" if times.dtype.kind in "OSUM" else _attribute(times, "units")
    unit = unit or (re.search("_(s|ms|us|ns)$", str(name).lower()) or ("", ""))[1]  # by its name
    return _recording.check_times(moments, str(unit), clock, label)


def _rates(values: Any, lines: dict[str, Any], path: Path) -> list[Any]:
    """Frame rates by attributes of an array and its file, or by numbers, taken out of its times."""
    rates = [_moments(lines.pop(key), path) for key in [*lines] if key.lower() in _RATES]
    for holder in (values, getattr(values, "parent", None), getattr(values, "file", None)):
        with suppress(ValueError):  # of a list
            rates += [_attribute(holder, key) for key in _RATES]
    return rates


def _dims_of(values: Any) -> list[Any]:
    """Dims of an array of zarr (2 or 3), h5py, netCDF4 or xarray; empty without names."""
    if isinstance(values, zarr.Array):
        stored: Any = values.attrs.get("_ARRAY_DIMENSIONS", ())
        return [*(getattr(values.metadata, "dimension_names", None) or stored)]
    dims = getattr(values, "dims", getattr(values, "dimensions", ()))
    if not hasattr(values, "is_virtual"):
        return [*dims]
    return [dim.label or (dim[0].name.rpartition("/")[2] if len(dim) else "") for dim in dims]


def _are_times(name: object, values: Any, names: re.Pattern[str] = _ANY_TIMES) -> bool:
    """Tell whether an array is a coordinate of times, by its name."""
    is_line = 0 < values.ndim < 3 and values.size == max(values.shape)  # MATLAB has no vectors
    is_line = is_line and values.dtype.itemsize <= _LONGEST
    return is_line and bool(names.fullmatch(str(name).rpartition("/")[2]))


def _attribute(values: Any, name: str) -> Any:
    """Attribute of an array, None if missing; ValueError for a list, which may take any memory."""
    attrs = getattr(values, "attrs", None)
    if attrs is None:  # of a variable of netCDF4, or a quantity with its unit
        attrs = {name: getattr(values, name)} if hasattr(values, name) else {}
    if (name := next((key for key in attrs if str(key).lower() == name.lower()), "")) == "":
        return None
    most = 2 if name.lower() == "valid_range" else 1
    if hasattr(attrs, "get_id") and math.prod(attrs.get_id(name).shape) > most:
        rule = "Must be two values" if most == 2 else "Must be one value"
        raise ValueError(f"Invalid attribute '{name}', a list. {rule}.")
    value = attrs[name]
    value = value.reshape(-1)[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode() if isinstance(value, bytes) else value


def _moments(times: Any, path: Path) -> npt.NDArray[Any] | None:
    """Times as numbers or dates, dates in text as seconds; None for other text."""
    _check_whole(times, path)
    if times.dtype.kind in "iufmM" and isinstance(times.dtype, np.dtype):  # of pandas, with a zone
        return np.asarray(times[...]).reshape(-1)
    with suppress(ValueError):  # of other text; in memory one by one, for it may be long
        if times.dtype.kind in "OSUM" and times.ndim == 1:
            return _recording.dates(times[number] for number in range(times.size))
    return None


def _times_of(arrays: dict[str, Any], name: str, path: Path) -> dict[str, Any]:
    """Times of an array of a file: of its first dim, or by their names, of many films beside it."""
    group, dims = name.rpartition("/")[0], _dims_of(arrays[name])[:1]
    frames, *image = arrays[name].shape
    lines = {key.rpartition("/")[::2]: array for key, array in arrays.items() if array.ndim < 3}
    if dims and (group, dims[0]) in lines:
        return {dims[0]: lines[group, dims[0]]}
    # Times in its group, and below the outermost group that has no other film.
    films = [key for key, array in arrays.items() if array.ndim == 3 and key != name]
    groups = ["", *(name[: n + 1] for n, letter in enumerate(name) if letter == "/")]
    parent = next((it for it in groups if not any(key.startswith(it) for key in films)), name)
    near = {n: it for (place, n), it in lines.items() if f"{place}/".startswith(parent)}
    near |= {key: array for (place, key), array in lines.items() if place == group}
    fitting = {n: it for n, it in near.items() if it.size == frames and _may_be_times(n, it)}
    named = {n: it for n, it in near.items() if _TIMES.fullmatch(n) and it.size > 1}
    for key in (key for key, times in named.items() if times.size in {*image} - {frames}):
        label = f"'{name}' of '{path.name}', {frames} frames of {image}"
        rule = "Must be (time, y, x), in MATLAB (y, x, time): transpose it, or rename the times"
        raise ValueError(f"Invalid axes of {label}: '{key}' has {named[key].size}. {rule}.")
    return ({key: fitting[key] for key in fitting if key in named} or fitting) | named


def _may_be_times(name: str, values: Any) -> bool:
    """Tell whether an array is of times: by its usual name, of texts or dates, or as it rises."""
    if _TIMES.fullmatch(name) or values.dtype.kind not in "iuf":
        return values.dtype.kind not in "bV"
    numbers = np.ravel(values[...])
    return bool(np.all(numbers[1:] > numbers[:-1]))


def _opened(path: Path, name: str | None, stack: ExitStack) -> tuple[Any, dict[str, Any]]:
    """Array of three dimensions of a file, by its name if there are several; its times by name."""
    if not (kind := _formats.format_of(path)):
        rule = "Must be .npy, .npz, HDF5, NetCDF, zarr, or MATLAB from version 5, as of save -v7"
        raise ValueError(f"Invalid '{path.name}': of no format, by its first bytes. {rule}.")
    # Until the file is closed, an error of its library names the file as damaged.
    stack.enter_context(_recording.damage_named(f"Damaged '{path.name}'", f"a whole {kind}"))
    stack.enter_context(warnings.catch_warnings(action="error", category=RuntimeWarning))
    warnings.simplefilter("error", UserWarning)  # as of one dimension twice
    arrays = _OPENED[kind](path, stack)
    shapes = [f"{key} {tuple(array.shape)}" for key, array in arrays.items()]
    names = {key: key.rpartition("/")[2] for key, array in arrays.items() if array.size == 1}
    rates = {name: arrays[key] for key, name in names.items() if name.lower() in _RATES}
    arrays = {n: array for n, array in arrays.items() if array.ndim == 3 or _are_times(n, array)}
    name = _recording.array_name([n for n in arrays if arrays[n].ndim == 3], name, path, shapes)
    return arrays[name], _times_of(arrays, name, path) | rates


def _read(values: Any, path: Path) -> npt.NDArray[Any]:
    """Numbers of an array of a file, once it is checked to be whole."""
    if isinstance(values, _variables.Stream):
        return values.counts()
    _check_whole(values, path)
    counts = _recording.film(values)
    if path.is_dir():
        return counts
    with path.open("rb") as stream:
        by_columns = stream.read(6) == b"MATLAB"  # whose arrays are (y, x, time)
    return np.swapaxes(counts, 1, 2) if by_columns else counts


def _hdf5(path: Path, stack: ExitStack) -> dict[str, Any]:
    h5py = _recording.optional("h5py", "recordings")
    file = stack.enter_context(h5py.File(path, "r"))
    arrays, headers = dict[str, Any](), [8]

    def visit(name: str, array: Any) -> None:
        headers.append(h5py.h5o.get_info(array.id).addr + file.userblock_size)
        if len(headers) > _OBJECTS or name.count("/") > _DEPTH:
            label = f"{len(headers)} objects, {name.count('/')} deep, in '{path.name}'"
            raise ValueError(f"Invalid tree of {label}. Must be {_OBJECTS}, {_DEPTH} at most.")
        if isinstance(array, h5py.Dataset) and _NO_VARIABLE not in str(_attribute(array, "NAME")):
            arrays[name] = array

    # All arrays of the file itself: no other file, no overlap.
    file.visititems(visit)  # follows no link to another file
    for name, array in arrays.items():
        if array.is_virtual or array.external:
            raise ValueError(f"Invalid '{name}' in other files. Must be in '{path.name}' itself.")
        start = array.id.get_offset() if array.chunks is None else None
        if start is not None and any(start <= place < start + array.nbytes for place in headers):
            raise ValueError(f"Overlapping parts of '{path.name}'. Must lie apart.")
    return arrays


def _filters(array: Any, path: Path) -> list[int]:
    """Codes of the filters of an HDF5 array: shuffles, then at most one filter that packs."""
    h5py, form = _recording.optional("h5py", "recordings"), array.id.get_create_plist()
    filters = [form.get_filter(n) for n in range(form.get_nfilters())]
    codes = [code for code, *_ in filters]
    packers = [code for code in codes if code not in {_SHUFFLE, _SUM}]
    if len(packers) > 1 or not {*packers} <= _PACKERS.keys():
        rule = f"Must be shuffle, then one of {[*_PACKERS]}, as of h5repack -f GZIP=1"
        raise ValueError(f"Invalid filters {codes} of '{array.name}' of '{path.name}'. {rule}.")
    if not all(map(h5py.h5z.filter_avail, codes)):
        with suppress(ImportError):
            import_module("hdf5plugin")
    for code, _, _, label in filters:
        if not h5py.h5z.filter_avail(code):
            text = f"filter {code}, {label.decode(errors='replace')}, that compresses"
            rule = "Must be installed, many with: python -m pip install hdf5plugin"
            raise ValueError(f"Missing {text} '{array.name}' of '{path.name}'. {rule}.")
    return codes


def _check_whole(array: Any, path: Path) -> None:
    """Refuse an array that is not all there, or whose chunks unpack to more than itself."""
    if isinstance(array, zarr.Array):
        _check_chunks(array, path)
    elif hasattr(array, "is_virtual"):  # of HDF5; an array of NetCDF 3 is whole by its header
        _check_pieces(array, path)


def _check_pieces(array: Any, path: Path) -> None:
    """Refuse an array of HDF5 that is not all there, or whose chunks unpack to more than itself."""
    name = array.name.strip("/")
    stored = array.id.get_storage_size()
    if array.chunks is None:
        if array.dtype.kind != "O" and stored != array.nbytes:
            rule = f"Must be all of the {stored} bytes stored"
            raise ValueError(f"Invalid shape {array.shape} of '{name}' of '{path.name}'. {rule}.")
        return
    codes = _filters(array, path)
    # Chunks, all there, and none larger than it says.
    width = _VLEN if array.dtype.kind == "O" else array.dtype.itemsize
    size = math.prod(array.chunks) * width
    wanted = math.prod(-(-n // piece) for n, piece in zip(array.shape, array.chunks, strict=True))
    _recording.check_pieces(wanted, array.nbytes, f"chunks of '{name}'")
    chunks = list[tuple[tuple[int, ...], int, int]]()
    array.id.chunk_iter(lambda c: chunks.append((c.chunk_offset, c.filter_mask, c.size)))
    packer = next((n for n, code in enumerate(codes) if code in _PACKERS), len(codes))
    if len(chunks) != wanted or not {mask for _, mask, _ in chunks} <= {0, 1 << packer}:
        raise ValueError(f"Missing chunks or filters of '{name}'. Must be {wanted}, all alike.")
    if size > max(_recording.SMALL, array.nbytes):
        raise ValueError(f"Invalid chunk of {size} bytes of '{name}'. Must be its size at most.")
    # HDF5 checks no chunk's size; a chunk that packing does not shorten is stored as it is.
    before, after = (4 * steps.count(_SUM) for steps in (codes[:packer], codes[packer:]))
    for place, mask, length in chunks:
        is_whole = length == size + before + after
        if packer < len(codes) and not mask:
            _, packed = array.id.read_direct_chunk(place)
            is_whole = _UNPACKED[_PACKERS[codes[packer]]](packed[: length - after], size + before)
        if not is_whole:
            raise ValueError(f"Invalid chunk of '{name}' at {place}. Must unpack to {size}.")


def _foreign_store(path: Path, _: ExitStack) -> dict[str, Any]:
    deque(_text.tree_files(path), maxlen=0)  # refuses links, pipes and devices
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of other files beside
        # Each array by its own metadata: consolidated metadata are a copy, which may be old.
        root = zarr.open(str(path), mode="r", use_consolidated=False)
        members: dict[str, Any] = {path.stem: root}
        if isinstance(root, zarr.Group):
            members = dict(root.members(max_depth=None))
    arrays = {n: array for n, array in members.items() if isinstance(array, zarr.Array)}
    for name, array in ((n, a) for n, a in arrays.items() if a.ndim == 3 or _are_times(n, a)):
        for code in array.filters:
            kind = getattr(code, "codec_id", type(code).__name__)
            if not re.fullmatch(_LOSSLESS, kind, re.IGNORECASE):
                rule = "Must be one that changes no counts: save them without it"
                raise ValueError(f"Invalid filter '{kind}' of '{name}' of '{path.name}'. {rule}.")
        _recording.check_pieces(array.nchunks, array.nbytes, f"chunks of '{name}'")
        if (kind := type(array.serializer).__name__) not in {"BytesCodec", "NoneType"}:
            raise ValueError(f"Invalid serializer '{kind}' of '{name}'. Must be bytes alone.")
        missing = 0 if array.shards else array.nchunks - array.nchunks_initialized
        if array.ndim == 3 and missing:
            label = f"Missing {missing} chunks of '{name}' of '{path.name}'"
            raise ValueError(f"{label}. Must be whole.")
    return arrays


def _check_chunks(values: zarr.Array[Any], path: Path) -> None:
    """Refuse chunks of a false size, and a shape that leaves a part of them out, as if damaged."""
    pieces = values.shards or values.chunks
    grid = [-(-size // piece) for size, piece in zip(values.shape, pieces, strict=True)]
    whole = tuple(number * piece for number, piece in zip(grid, pieces, strict=True))
    # Files of chunks, which must be of their stated size.
    keys = [file for file in (path / values.path).rglob("*") if re.fullmatch(_CHUNK, file.name)]
    _check_unpacked(values, keys := [key for key in keys if key.is_file()], path)
    # A missing chunk of a shard reads as the fill value: with another fill value it differs.
    if values.shards:
        fill = values.dtype.type(values.fill_value == 0)
        metadata: Any = replace(values.metadata, fill_value=fill)
        refilled = zarr.Array(zarr.AsyncArray(metadata, values.store_path))
        for start in range(0, values.shape[0], values.shards[0]):
            frames = slice(start, start + values.shards[0])
            if not np.array_equal(values[frames], refilled[frames]):
                label = f"Missing chunks in the shards of '{values.path or path.stem}'"
                raise ValueError(f"{label} of '{path.name}'. Must be whole.")
    # The padding of the last chunks must be of one value.
    metadata = values.metadata.update_shape(whole)
    padded = zarr.Array(zarr.AsyncArray(metadata, values.store_path))
    more = len(keys) > math.prod(grid)
    for axis, size in enumerate(values.shape):
        beyond = np.asarray(padded[(slice(None),) * axis + (slice(size, None),)])
        more = more or bool(beyond.size and np.ptp(beyond))
    if more:
        rule = "Must be all that its chunks hold: there is more"
        raise ValueError(f"Invalid shape {values.shape} of '{path.name}'. {rule}.")


def _check_unpacked(values: zarr.Array[Any], keys: list[Path], path: Path) -> None:
    """Refuse files of chunks that unpack to another size than that of a chunk."""
    pieces = values.shards or values.chunks
    # A filter that checks adds its sum to a chunk before it is packed.
    sums = [getattr(code, "codec_id", "") in _CHECKSUMS for code in values.filters]
    size = values.dtype.itemsize * math.prod(values.chunks) + 4 * sum(sums)
    if math.prod(pieces) * values.dtype.itemsize > max(_recording.SMALL, values.nbytes):
        raise ValueError(f"Invalid chunk {pieces} of '{path.name}'. Must be its size at most.")
    codecs = [getattr(codec, "codec_id", type(codec).__name__) for codec in values.compressors]
    kinds = [kind.lower().removesuffix("codec") for kind in codecs]
    if len(kinds) > 1 or not {*kinds} <= _UNPACKED.keys():
        rule = f"Must be one of {[*_UNPACKED]}"
        raise ValueError(f"Invalid compressors {kinds} of '{path.name}'. {rule}.")
    for key in keys if kinds else ():
        number = math.prod(pieces) // math.prod(values.chunks)
        for packed in _pieces(key.read_bytes(), number if values.shards else 0):
            if not _UNPACKED[kinds[0]](packed, size):
                label = f"chunk '{key.name}' of '{path.name}'"
                raise ValueError(f"Damaged {label}. Must be whole, and unpack to {size} bytes.")


def _pieces(content: bytes, number: int) -> list[bytes]:
    """Chunks of the file of a chunk, or of a shard by the index at its end."""
    index = np.frombuffer(content[-16 * number - 4 : -4], "<u8").reshape(-1, 2).tolist()
    listed = [content[start : start + length] for start, length in index if start < len(content)]
    return listed if number else [content]


def _zstd(packed: bytes, size: int) -> bool:
    """Tell whether the header of Zstandard states a size."""
    about = packed[4] if len(packed) > 4 else 0
    width = (about >> 5 & 1, 2, 4, 8)[about >> 6]
    start = 5 + (not about & 32) + (0, 1, 2, 4)[about & 3]
    stated = int.from_bytes(packed[start : start + width], "little")
    return width > 0 and stated + 256 * (width == 2) == size


def _unpacks(make: Callable[[], Any]) -> Callable[[bytes, int], bool]:
    """Test whether a piece, with no other behind it, unpacks to a size; never farther."""
    return lambda packed, size: (
        len((stream := make()).decompress(packed, size + 1)) == size
        and stream.eof
        and not stream.unused_data
    )


# Test by compressor whether a piece unpacks to a size, beyond which it would take any memory.
_UNPACKED: Final[dict[str, Callable[[bytes, int], bool]]] = {
    "blosc": lambda packed, size: (
        struct.unpack("<4xI4xI", packed[:16].ljust(16, b"\0")) == (size, len(packed))
    ),
    "lz4": lambda packed, size: int.from_bytes(packed[:4], "little") == size,
    "lz4 of HDF5": lambda packed, size: int.from_bytes(packed[:8]) == size,
    "lzf": lambda packed, size: (
        len(import_module("imagecodecs").lzf_decode(packed, header=False, out=size)) == size
    ),
    "zstd": _zstd,
    "gzip": _unpacks(lambda: zlib.decompressobj(31)),
    "zlib": _unpacks(zlib.decompressobj),
    "bz2": _unpacks(bz2.BZ2Decompressor),
    "lzma": _unpacks(lzma.LZMADecompressor),
}
_OPENED: Final[dict[str, Callable[[Path, ExitStack], dict[str, Any]]]] = {  # openers by format
    "zarr": _foreign_store,
    "HDF5": _hdf5,
    "NetCDF": lambda path, _: _variables.netcdf_arrays(path),
    "MATLAB 5": lambda path, _: _variables.matlab_arrays(path),
    "NumPy": lambda path, stack: (
        {path.stem: _variables.numpy_array(path, stack.enter_context(path.open("rb")))}
    ),
    "zip": _variables.numpy_arrays,
}
