"""Results on disk: datasets as zarr, headline numbers as JSON, figures as PNG, films as MP4.

Each function writes to a temporary place beside its path and renames at the end, so that a file
under a result's name is always whole. Each result carries its provenance (see
`dbthermal.store.provenance`) and nothing that differs between two runs of the same code on the same
input. No other package opens or writes zarr.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from zarr.codecs import Crc32cCodec, ZstdCodec

from dbthermal import _text as texts
from dbthermal.store._integrity import (
    AS_WRITTEN,
    MARK,
    SUMS,
    CheckedStore,
    SummedStore,
    last_sums,
    sums_file,
    valid_part,
    warn_unchecked,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Number = float | int | str | bool

_COMPRESSORS = (ZstdCodec(), Crc32cCodec())
_CHUNK_BYTES = 2**20
"""Least size of a full chunk [byte]: below about 1 MB a read costs more in files than in bytes."""

_ENCODERS: Final[dict[str, tuple[Literal["libvpx-vp9", "libx264"], dict[str, str]]]] = {
    "vp9": ("libvpx-vp9", {"crf": "31", "b": "0", "cpu-used": "4"}),
    "h264": ("libx264", {}),
}
"""FFmpeg's encoder of each codec of a film, with its options."""


def _chunks(variable: xr.Variable | xr.DataArray, height: int | None = None) -> tuple[int, ...]:
    """Chunk sizes for a variable: tiles of y and x, whole in every other dimension.

    Every stage works pixel by pixel on all frames and bands, so a chunk holds the full story of a
    nearly square tile of pixels, the smallest that has `_CHUNK_BYTES` before compression. Tiles
    divide a `height` of rows, if there is one, so that rows that follow begin with a tile.
    """
    sizes = {str(dim): max(1, size) for dim, size in variable.sizes.items()}
    if not {"y", "x"} <= sizes.keys():
        return tuple((sizes | ({"y": height} if height and "y" in sizes else {})).values())
    pixel_bytes = variable.dtype.itemsize * math.prod(sizes.values()) // (sizes["y"] * sizes["x"])
    pixels = math.ceil(_CHUNK_BYTES / pixel_bytes)
    rows = min(height or sizes["y"], math.ceil(math.sqrt(pixels)))
    if height:
        rows = next(count for count in range(rows, 0, -1) if height % count == 0)
    width = min(sizes["x"], math.ceil(pixels / rows))
    sizes |= {"y": rows if height else min(sizes["y"], math.ceil(pixels / width)), "x": width}
    return tuple(sizes.values())


def save(dataset: xr.Dataset, path: str | Path, provenance: Mapping[str, Any]) -> None:
    """Save a dataset as zarr (format 3, not consolidated), in place of an earlier one.

    Parameters
    ----------
    dataset : Dataset
        Of any stage; it is not changed.
    path : str or Path
        Folder ``*.zarr`` (ValueError if it has another suffix). Its parents are made.
    provenance : mapping
        From `dbthermal.store.provenance`; becomes ``attrs["provenance"]``.

    Examples
    --------
    >>> import xarray as xr
    >>> from tempfile import TemporaryDirectory
    >>> from dbthermal import store
    >>> counts = xr.Dataset({"counts": ("band", [20310, 20750])})  # [count]
    >>> with TemporaryDirectory() as folder:
    ...     store.save(counts, f"{folder}/wall.zarr", store.provenance({"frames": 2}))
    ...     store.open_dataset(f"{folder}/wall.zarr").counts.values.tolist()
    [20310, 20750]
    """
    save_parts([dataset], path, provenance)


def save_rows(parts: Iterable[xr.Dataset], path: str | Path, provenance: Mapping[str, Any]) -> None:
    """Save a dataset as `save` does, of parts that follow one another along y, each as it comes.

    Parameters
    ----------
    parts : iterable of Dataset
        Rows from the first to the last, made when they are asked for: no more than one is held.
        What has no y, and the attributes, are those of the first.
    path : str or Path
        Folder ``*.zarr``; see `save`.
    provenance : mapping
        See `save`.

    Examples
    --------
    >>> import xarray as xr
    >>> from tempfile import TemporaryDirectory
    >>> from dbthermal import store
    >>> rows = (xr.Dataset({"status": (("y", "x"), [[row, 0]])}) for row in range(3))
    >>> with TemporaryDirectory() as folder:
    ...     store.save_rows(rows, f"{folder}/wall.zarr", store.provenance({}))
    ...     store.open_dataset(f"{folder}/wall.zarr").status.values.tolist()
    [[0, 0], [1, 0], [2, 0]]
    """
    rest = iter(parts)
    first = next(rest)
    save_parts(chain([first], rest), path, provenance, first.sizes.get("y"))


def save_parts(
    parts: Iterable[xr.Dataset],
    path: str | Path,
    provenance: Mapping[str, Any],
    height: int | None = None,
) -> None:
    """Save parts that follow one another along y, each of a height that chunks then divide."""
    options: dict[str, Any] = {"mode": "a", "append_dim": "y"}
    with whole(path, ".zarr") as folder:
        folder.mkdir()
        for number, part in enumerate(parts):
            # Of all kinds of text zarr's format 3 specifies the one of variable length alone.
            plain = _with_text_as(part.drop_encoding(), "U", np.dtypes.StringDType())
            encoding = {
                name: {"chunks": _chunks(variable, height), "compressors": _COMPRESSORS}
                for name, variable in plain.variables.items()
            }
            if number == 0:
                plain.attrs = {**MARK, **part.attrs, "provenance": json.loads(_json(provenance))}
            else:
                rest = [name for name, one in plain.variables.items() if "y" not in one.dims]
                plain = plain.drop_vars(rest).drop_attrs(deep=False)
            plain.to_zarr(
                SummedStore(folder),
                zarr_format=3,
                consolidated=False,
                write_empty_chunks=True,
                **(options if number else {"mode": "w-", "encoding": encoding}),
            )
        (folder / SUMS).write_bytes(sums_file(last_sums(folder)))


def open_dataset(path: str | Path) -> xr.Dataset:
    """Open a saved dataset or a recording; values are read when they are used.

    A recording that was cut short, or is being written, opens as far as all bands are valid; its
    attributes have ``complete`` = False and, in ``frames_written``, the end of each band.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr``.

    Returns
    -------
    Dataset
        Identical to the one saved, with ``attrs["provenance"]`` added. Text is of NumPy's
        fixed-length kind.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        With file, array and store, if a file of it is not as it was written, or missing, or
        foreign; also when values are read, if a chunk is not. Of a recording that was cut short
        only what is valid counts.

    Warns
    -----
    UserWarning
        If the store has no checksums, as of dbthermal 0.1.0, so that damage cannot be seen.

    Examples
    --------
    >>> import xarray as xr
    >>> from tempfile import TemporaryDirectory
    >>> from dbthermal import store
    >>> wall = xr.Dataset({"object_temperature": ("time", [295.2, 295.3], {"units": "K"})})
    >>> with TemporaryDirectory() as folder:
    ...     store.save(wall, f"{folder}/wall.zarr", store.provenance({"frames": 2}))
    ...     saved = store.open_dataset(f"{folder}/wall.zarr").load()
    >>> saved.equals(wall), saved.attrs["provenance"]["parameters"]
    (True, {'frames': 2})
    """
    if not Path(path).is_dir():
        raise FileNotFoundError(
            f"No dataset '{path}'. Must be a zarr folder: has its notebook been run?"
        )
    checked = CheckedStore(path)
    dataset = _open(checked) if checked.closed else _open_valid_part(checked)
    for name in MARK:
        dataset.attrs.pop(name, None)
    return _with_text_as(dataset, "T", np.dtype(str))


def _open(checked: CheckedStore, leave: Iterable[str] = ()) -> xr.Dataset:
    dataset: xr.Dataset = xr.open_zarr(
        checked, chunks=None, consolidated=False, zarr_format=3, drop_variables=list(leave)
    )
    return dataset


def _open_valid_part(checked: CheckedStore) -> xr.Dataset:
    """Open the variables of a recording one by one, for their room differs while it grows."""
    ends, parts = valid_part(checked.attrs), []
    names = {array.parent.name for array in checked.root.glob("*/zarr.json")}
    for name in sorted(names):
        part = _open(checked, leave=names - {name})
        parts.append(part.isel({d: slice(end) for d, end in ends.items() if d in part.dims}))
    # The attributes as checked, for they may have gone on since.
    return xr.merge(parts, combine_attrs="override").assign_attrs(checked.attrs)


def save_numbers(
    numbers: Mapping[str, Number | np.generic], path: str | Path, provenance: Mapping[str, Any]
) -> None:
    """Save headline numbers as strict JSON, with sorted names.

    Parameters
    ----------
    numbers : mapping
        Name, unit included (``"object_rmse_K"``), to a finite number, a string or a boolean;
        TypeError or ValueError for any other value.
    path : str or Path
        File ``*.json``. Its parents are made.
    provenance : mapping
        From `dbthermal.store.provenance`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from dbthermal import store
    >>> with TemporaryDirectory() as folder:
    ...     path = f"{folder}/wall.json"
    ...     store.save_numbers({"object_rmse_K": 0.21}, path, store.provenance({"frames": 2}))
    ...     store.read_numbers(path)
    {'object_rmse_K': 0.21}
    """
    content: dict[str, Any] = {
        "numbers": {name: _number(name, value) for name, value in numbers.items()},
        "provenance": dict(provenance),
    }
    content["sha256"] = _digest(content)
    with whole(path, ".json") as part:
        part.write_text(_json(content, indent=2) + "\n", encoding="utf-8")


def read_numbers(path: str | Path) -> dict[str, Number]:
    """Read a file of `save_numbers`: name to value.

    A file without a checksum, of dbthermal 0.1.0, is read with a warning.

    Parameters
    ----------
    path : str or Path
        File ``*.json``.

    Raises
    ------
    ValueError
        With file and line, if it is not such a file, a name is listed twice, a number is not
        finite, or it differs from what was written.
    """
    content = texts.parse_json(texts.read_text(path), str(path))
    if not isinstance(content, dict) or not isinstance(content.get("numbers"), dict):
        raise ValueError(f"No 'numbers' in '{path}'. Must be a file that save_numbers wrote.")
    if content.keys() <= {"numbers", "provenance"}:
        warn_unchecked(path, stacklevel=2)
    elif content.pop("sha256", None) != _digest(content):
        raise ValueError(f"Damaged file '{path}'. {AS_WRITTEN}")
    for name, value in content["numbers"].items():
        if not isinstance(value, bool | int | float | str):
            raise ValueError(
                f"Invalid {texts.shown(name)} = {texts.shown(value)} in '{path}'. Must be a "
                "number, a string or a boolean."
            )
    return dict(content["numbers"])


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(_json(content).encode()).hexdigest()


def save_text(text: str, path: str | Path, provenance: Mapping[str, Any]) -> None:
    """Save a text in Markdown, with its provenance in a comment at its end.

    Parameters
    ----------
    text : str
        The text.
    path : str or Path
        File ``*.md``.
    provenance : mapping
        As from `provenance`.
    """
    comment = f"\n<!-- {_json(provenance)} -->\n"
    with whole(path, ".md") as part:
        part.write_text(text + comment, encoding="utf-8")


def save_figure(
    figure: "Figure", path: str | Path, provenance: Mapping[str, Any], *, dpi: int = 150
) -> None:
    """Save a figure as PNG, the same bytes for the same figure.

    Parameters
    ----------
    figure : Figure
        Of matplotlib; it stays open.
    path : str or Path
        File ``*.png``. Its parents are made.
    provenance : mapping
        From `dbthermal.store.provenance`; becomes the text chunk ``Comment``, as JSON.
    dpi : int
        Resolution [pixel/inch].

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from matplotlib.figure import Figure
    >>> from PIL import Image
    >>> from dbthermal import store
    >>> with TemporaryDirectory() as folder:
    ...     store.save_figure(Figure(figsize=(2, 1)), f"{folder}/wall.png", {"commit": "unknown"})
    ...     Image.open(f"{folder}/wall.png").text["Comment"]
    '{"commit": "unknown"}'
    """
    metadata = {"Software": "dbthermal", "Comment": _json(provenance)}
    with whole(path, ".png") as part:
        figure.savefig(part, dpi=dpi, metadata=metadata)


def save_video(
    frames: Iterable[npt.NDArray[np.uint8]],
    path: str | Path,
    provenance: Mapping[str, Any],
    *,
    rate: float,
    codec: Literal["vp9", "h264"] = "vp9",
) -> None:
    """Save a film in MP4, as browsers play it.

    Parameters
    ----------
    frames : iterable of ndarray of uint8, shape (rows, columns, 3)
        Colours; at least one frame, all of one size, both sizes even, else ValueError.
    path : str or Path
        File ``*.mp4``. Its parents are made.
    provenance : mapping
        From `dbthermal.store.provenance`; becomes the file's comment, as JSON.
    rate : float
        Frame rate [Hz].
    codec : {"vp9", "h264"}
        Compression. VP9's encoder, libvpx, has a permissive licence and a grant of patents. That of
        H.264, x264, is under the GPL, and patents may ask for a licence where films are passed on
        (see docs/licences.md). ValueError for any other.
    """
    import av  # noqa: PLC0415 - optional, and nothing else here needs it

    if codec not in _ENCODERS:
        raise ValueError(f"Invalid codec {codec!r}. Must be one of {sorted(_ENCODERS)}.")
    encoder, options = _ENCODERS[codec]
    with whole(path, ".mp4") as part, av.open(part, "w") as film:
        film.metadata["comment"] = _json(provenance)
        fraction = Fraction(rate).limit_denominator(1000)
        stream = film.add_stream(encoder, rate=fraction, options=options)
        stream.pix_fmt, stream.width = "yuv420p", 0
        for frame in frames:
            height, width = frame.shape[:2]
            if stream.width == 0:
                stream.height, stream.width = height, width
            if (stream.height, stream.width) != (height, width) or height % 2 or width % 2:
                raise ValueError(
                    f"Invalid frame of {height} x {width} pixels. Must be of even size, "
                    f"as all others: {stream.height} x {stream.width}."
                )
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if stream.width == 0:
            raise ValueError("Invalid film without frames. Must have at least one.")
        film.mux(stream.encode())


@contextmanager
def whole(path: str | Path, suffix: str) -> Iterator[Path]:
    """Yield a place beside `path` to write to, which becomes `path` unless an error is raised.

    Parameters
    ----------
    path : str or Path
        File or folder that is to be whole, or as it was. Its parents are made.
    suffix : str
        End of its name; ValueError for another one.
    """
    path = Path(path)
    if path.suffix != suffix:
        raise ValueError(f"Invalid path '{path}'. Must end in '{suffix}'.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
        part = Path(folder) / path.name
        yield part
        if path.is_dir():  # a folder cannot be renamed onto another
            path.rename(Path(folder) / "replaced")
        part.replace(path)


def _json(content: Mapping[str, Any], indent: int | None = None) -> str:
    return json.dumps(content, allow_nan=False, ensure_ascii=True, indent=indent, sort_keys=True)


def _number(name: str, value: object) -> Number:
    """Headline value as a plain Python one."""
    plain = value.item() if isinstance(value, np.generic) else value
    if not isinstance(plain, (bool, int, float, str)):
        raise TypeError(f"Invalid {name!r} = {value!r}. Must be a number, a string or a boolean.")
    if isinstance(plain, float) and not math.isfinite(plain):
        raise ValueError(f"Invalid {name!r} = {value!r}. Must be finite.")
    return plain


def _with_text_as(dataset: xr.Dataset, kind: str, dtype: np.dtype[Any]) -> xr.Dataset:
    """Convert text of one of NumPy's kinds to another one."""
    texts = {
        name: (variable.dims, variable.to_numpy().astype(object).astype(dtype), variable.attrs)
        for name, variable in dataset.variables.items()
        if variable.dtype.kind == kind
    }
    return dataset.assign(texts)
