"""Format of a file by its first bytes, and the files that make a recording."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from dbthermal import _text as texts

Paths = str | Path | Sequence[str | Path]

_MAGIC: Final = (  # first bytes of a format: place, bytes, and its name
    *((0, mark, "FLIR") for mark in (b"FFF\0", b"AFF\0")),
    *((0, mark, "TIFF") for mark in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    *((0, mark, "NetCDF") for mark in (b"CDF\1", b"CDF\2", b"CDF\5")),
    *((0, mark, "film") for mark in (b"\x1aE\xdf\xa3", b"GIF8")),
    *((8, b"AVI ", "film"), (4, b"ftyp", "film"), (8, b"WEBP", "picture"), (0, b"BM", "picture")),
    *((0, b"\xff\xd8\xff", "JPEG"), (0, b"\x89PNG\r\n\x1a\n", "PNG")),
    *((0, b"\x93NUMPY", "NumPy"), (0, b"PK\3\4", "zip"), (0, b"MATLAB 5.0", "MATLAB 5")),
    *((0, b"\x0e\x03\x13\x01", "HDF4"), (0, b"SIMPLE  =", "FITS"), (4, b"jP  ", "JPEG 2000")),
    *((0, b"P5\n", "PGM"), (0, b"P5 ", "PGM"), (0, b"\x1f\x8b\x08", "gzip"), (0, b"7z\xbc", "7z")),
    *((0, b"BZh", "bzip2"), (0, b"\xfd7zXZ", "xz"), (0, b"(\xb5/\xfd", "zstd")),
    *((0, b"\x80\4\x95", "pickle"), (0, b"\x80\5\x95", "pickle"), (0, b"Rar!", "rar")),
)
PNG: Final = b"\x89PNG\r\n\x1a\n"
_HDF5: Final = b"\x89HDF\r\n\x1a\n"  # at 0, 512, 1024, ...: what precedes is the user's
_READER: Final = {
    **dict.fromkeys(("FLIR", "JPEG"), "flir"),
    **dict.fromkeys(("TIFF", "PNG"), "tiff"),
    **dict.fromkeys(("NumPy", "zip", "HDF5", "NetCDF", "zarr", "MATLAB 5"), "array"),
}
SEQUENCES: Final = (".sfmov", ".hcc")
_EXPORT: Final = "export its counts as 16-bit TIFF with the maker's program and use readers.tiff"
_DRAWN: Final = (
    "most have 8 bits that are drawn, not measured: record 16-bit counts; one of 16-bit counts is "
    "read by readers.raw (--shape) after: ffmpeg -i FILE -pix_fmt gray16le -f rawvideo counts.raw"
)
_FOREIGN: Final = {  # what to do with a format that no reader opens, by suffix or first bytes
    **dict.fromkeys((".ravi", ".irb", ".ats", ".is2", ".is3", ".bmt", ".ptw"), _EXPORT),
    **dict.fromkeys(("film", "picture"), _DRAWN),
    "HDF4": "convert it by h4toh5 and use readers.array",
    **dict.fromkeys(("FITS", "pickle"), "save its array with NumPy and use readers.array"),
    **dict.fromkeys(("gzip", "bzip2", "xz", "zstd", "7z", "rar"), "unpack it"),
    **dict.fromkeys(("PGM", "JPEG 2000"), "save it as PNG of 16 bits and use readers.tiff"),
    **dict.fromkeys((".xlsx", ".xlsm", ".xls", ".ods"), "a table: export 16-bit counts as TIFF"),
    "text": "a table, a page of a server, a pointer of Git LFS? Export 16-bit counts as TIFF",
}
_LARGEST: Final = 2**46  # of a file that is not read at once [byte]
_TEXT: Final = 512  # bytes at the beginning of a file, without a control character
_UTF16: Final = (b"\xff\xfe", b"\xfe\xff")  # marks at the beginning of a text


def format_of(path: Path) -> str:
    """Format of a file by its first bytes, "" if unknown; of a folder zarr; ValueError if empty."""
    if path.is_dir():
        if not any((path / name).is_file() for name in ("zarr.json", ".zgroup", ".zarray")):
            rule = f"Must be files: {path}/*.tif"
            raise ValueError(f"Invalid folder '{path}', no whole zarr. {rule}.")
        return "zarr"
    if (size := texts.regular_file(path, _LARGEST).stat().st_size) == 0:
        raise ValueError(f"Empty file '{path.name}'. Must hold at least one frame.")
    with path.open("rb") as stream:
        start, place = stream.read(16), 0
        while place < size:
            stream.seek(place)
            if stream.read(8) == _HDF5:
                return "HDF5"
            place = 2 * place or 512
    return next((name for at, mark, name in _MAGIC if start[at:].startswith(mark)), "")


def refuse_text(path: Path) -> None:
    """Raise ValueError for a file that begins as a text; bare numbers hardly ever do."""
    if format_of(path) or path.suffix.lower() in SEQUENCES:
        return
    with path.open("rb") as stream:
        start = stream.read(_TEXT)
    start = start.replace(b"\0", b"" if start.startswith(_UTF16) else b"\0")
    if not re.search(rb"[^\t\r\n -~\x80-\xff]", start):
        raise ValueError(f"Refused '{path.name}', a text: {_FOREIGN['text']}.")


def reader_of(path: Path) -> str:
    """Reader of a file by its first bytes, empty if unknown; ValueError for a foreign format."""
    form, suffix = format_of(path) if path.exists() else "", path.suffix.lower()
    if suffix in _FOREIGN and form in {"", "film", "picture", "zip"}:
        raise ValueError(f"Refused '{path.name}': {_FOREIGN[suffix]}.")
    if form in _FOREIGN:
        raise ValueError(f"Refused '{path.name}', a {form}: {_FOREIGN[form]}.")
    return _READER.get(form, "sequence" if suffix in SEQUENCES and not form else "")


def files(path: Paths, reader: str) -> list[Path]:
    """Regular files of a recording, in the order of time; ValueError by what to do instead."""
    listed = path if isinstance(path, list | tuple) else [path]
    if not (paths := [texts.as_path(file) for file in listed]):
        raise ValueError("Empty list of files. Must name at least one.")
    numbers = [[int(digits) for digits in re.findall("[0-9]+", file.stem)] for file in paths]
    for before, after, file in zip(numbers, numbers[1:], paths[1:], strict=False):
        if len(before) == len(after) and after <= before:
            state = "do not rise" if after != before else "are those of the file before, or none"
            label = f"Unordered files: the numbers of '{file.name}' {state}"
            rule = "Must be of one camera, and rise: not frame1, frame10, frame2"
            raise ValueError(f"{label}. {rule}: $(ls -v frame*.png).")
    for file in paths:
        actual = "" if reader == "raw" and not file.is_dir() else reader_of(file)
        if actual not in {"", reader}:
            label = f"Invalid '{file.name}' for readers.{reader}, by its first bytes"
            raise ValueError(f"{label}. Must be read by readers.{actual}.")
        if not actual:  # an error if it is missing or empty
            format_of(file)
    return paths
