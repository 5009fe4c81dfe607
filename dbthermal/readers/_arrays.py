"""Counts in files of NumPy, HDF5, NetCDF and zarr, or in an array that is opened already."""

import warnings
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal.readers import _containers as containers
from dbthermal.readers import _recording as recordings
from dbthermal.readers._decoding import MEMORY
from dbthermal.readers._recording import Clock

_PLACES: Final = {"time": 0, "y": 1, "x": 2, "band": None}  # of dims that have these names
_ATTRIBUTES: Final = ("units", "unit", "scale_factor", "add_offset", "_FillValue", "missing_value")


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
    name : str, optional
        Name of the array in a file of several, such as ``"entry/frames"``.
    unit, clock, memory
        As for `tiff`; an array's own ``units`` must agree.

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
    ValueError
        If a file is of another format, or damaged; the array is not one of three dimensions and
        uint16, has other dims, is scaled, lacks values, or is not in the file; as `tiff` for unit,
        clock, memory and 8 bits.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.arange(18000, 18024, dtype=np.uint16).reshape(2, 3, 4)
    >>> array(frames, unit="count", clock=30.0).sizes["time"]
    2
    """
    label = Path(source).name if isinstance(source, str | Path) else "array"
    recordings.check_unit(unit, label)

    own = dict[str, Any]()

    def check(values: Any, dims: Sequence[Any]) -> None:
        if any(_PLACES.get(dim, place) != place for place, dim in enumerate(dims)):
            raise ValueError(f"Invalid dims {[*dims]} of '{label}'. Must be (time, y, x).")
        attrs = getattr(values, "attrs", {})
        own.update({name: attrs[name] for name in _ATTRIBUTES if name in attrs})
        for scale in {"scale_factor", "add_offset"} & own.keys():
            raise ValueError(f"Invalid '{scale}' of '{label}'. Must be counts as measured.")
        dtype = getattr(values, "dtype", np.dtype(object))
        _check(np.shape(values), dtype, memory, label)
        said = own.get("units", own.get("unit", unit))
        recordings.check_unit(said.decode() if isinstance(said, bytes) else str(said), label)

    with ExitStack() as stack:
        values = source
        if not isinstance(source, str | Path):
            check(source, source.dims if isinstance(source, xr.DataArray) else ())
        elif containers.kind_of(Path(source)):
            values = containers.read(Path(source), name, check, memory, stack)
        else:
            (path,) = recordings.files([source])
            values = _numpy_file(path, name, memory, stack)
        counts = np.asarray(values).astype(np.uint16)
    fills = [own[name] for name in ("_FillValue", "missing_value") if name in own]
    if np.ma.is_masked(values) or (fills and np.isin(counts, fills).any()):
        raise ValueError(f"Missing counts in '{label}': masked, or {fills}. Must all be there.")
    return recordings.clocked(counts, clock, label, format="array")


def _check(shape: tuple[int, ...], dtype: np.dtype[Any], memory: float, name: str) -> None:
    """Raise ValueError for what is no stack of counts, before it is read."""
    if dtype.kind != "u" or dtype.itemsize != 2:
        rule = "Must be uint16: counts, neither temperatures nor objects"
        raise ValueError(f"Invalid dtype {dtype} of '{name}'. {rule}.")
    recordings.check_memory(shape, memory, name)


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
    size = 2 * int(np.prod(shape, dtype=object))
    if len(content := stream.read(size + 1)) != size:
        found = f"{len(content)} bytes or more of counts in '{name}'"
        raise ValueError(f"Truncated or damaged {found}. Must be {size}, as its header says.")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_columns else "C")
