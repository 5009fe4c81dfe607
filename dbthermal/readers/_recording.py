"""Parts that all readers of recordings share: files, byte order, clock, and the Dataset made."""

import lzma
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _text as texts
from dbthermal import schema
from dbthermal._arrays import Array, empty, made_on_disk, parts

Counts = npt.NDArray[np.uint16]

Paths = str | Path | Sequence[str | Path]
Clock = float | npt.ArrayLike

_EXPORT: Final = "export its counts as 16-bit TIFF with the maker's program and use readers.tiff"
_RECORD: Final = "its 8 bits are drawn, not measured: record 16-bit counts"
_REFUSED: Final = {
    **dict.fromkeys((".ravi", ".irb", ".ats", ".is2", ".is3", ".bmt", ".sfmov"), _EXPORT),
    **dict.fromkeys((".mp4", ".avi", ".mov", ".mkv", ".webm", ".wmv", ".png", ".gif"), _RECORD),
}
MEMORY: Final = 2.0**30  # largest memory that a recording may take, by default [byte]
_LARGEST: Final = 2**46  # of a file that is not read at once [byte]
_FASTEST: Final = 1e6  # frame rate of a camera [Hz]
_GAP: Final = 1.5  # a step of the clock longer than this many frame periods tells of a lost frame
# What the libraries of the formats raise for files that are damaged.
DAMAGE: Final = (
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError),
    *(RuntimeError, SyntaxError, SystemError, TypeError, ValueError, Warning, TokenError),
    *(lzma.LZMAError, struct.error, zipfile.BadZipFile, zlib.error),
)
# An image is smoother than with its bytes swapped, or its rows cut at another place, by this
# factor, or the form is not known.
_SMOOTHER: Final = 2.0


class FileFlag(schema.Flags):
    """State of a frame of a file."""

    FRAMES_LOST_BEFORE = 1, "the step of the clock is longer than 1.5 frame periods"
    TIME_STANDS = 2, "the time does not rise, or is not known"
    PADDED = 4, "no frame: the band has fewer than another, and its last one is repeated"
    NUMBERS_DIFFER = 8, "image and time are of frames of different numbers"


def files(path: Paths) -> list[Path]:
    """Regular files of a recording, in the order of time; ValueError by what to do instead."""
    listed = path if isinstance(path, list | tuple) else [path]
    paths = [texts.as_path(file) for file in listed]
    if not paths:
        raise ValueError("Empty list of files. Must name at least one.")
    numbers = [[int(digits) for digits in re.findall("[0-9]+", file.stem)] for file in paths]
    for before, after, file in zip(numbers, numbers[1:], paths[1:], strict=False):
        if len(before) == len(after) and after <= before:
            rule = "Must rise: 'frame10' comes after 'frame9', which the order of text does not"
            raise ValueError(f"Unordered files: the numbers of '{file.name}' do not rise. {rule}.")
    for file in paths:
        if file.suffix.lower() in _REFUSED:
            raise ValueError(f"Refused '{file.name}': {_REFUSED[file.suffix.lower()]}.")
        if texts.regular_file(file, _LARGEST).stat().st_size == 0:
            raise ValueError(f"Empty file '{file.name}'. Must hold at least one frame.")
    return paths


@contextmanager
def damage_named(label: str, rule: str) -> Iterator[None]:
    """Make one line of all that a library raises for a damaged file; what a reader says stays."""
    try:
        yield
    except DAMAGE as error:
        if isinstance(error, ValueError) and "Must " in str(error):
            raise
        message = " ".join(str(error).split())[:200]
        raise ValueError(f"{label}: {message}. Must be {rule}.") from error


def check_number(value: Any, name: str, *, whole: bool = False) -> None:
    """Raise TypeError or ValueError for an argument that is not one finite, or whole, number."""
    rule = f"Must be a {'whole' if whole else 'finite'} number"
    array = np.asarray(value)
    if array.ndim or array.dtype.kind not in ("iu" if whole else "iuf"):
        raise TypeError(f"Invalid {name} {texts.shown(value)}. {rule}.")
    if not np.isfinite(array):
        raise ValueError(f"Invalid {name} {value}. {rule}.")


def check_present(counts: Counts, fills: Sequence[Any], name: str, *, masked: bool = False) -> None:
    """Raise ValueError where counts are masked, or values that stand for missing ones."""
    if masked or (fills and any(np.isin(counts[at], fills).any() for at in parts(counts))):
        raise ValueError(f"Missing counts in '{name}': masked, or {fills}. Must all be there.")


def check_memory(shape: Sequence[int], memory: float, name: str) -> None:
    """Raise ValueError if counts (time, y, x) take more memory than is allowed."""
    check_number(memory, "memory")
    if len(shape) != 3 or not all(size >= 1 for size in shape):  # of dask's, NaN: unknown
        raise ValueError(f"Invalid shape {tuple(shape)} of '{name}'. Must be (time, y, x).")
    frames, height, width = map(int, shape)
    needed = 2 * (frames + 3) * height * width  # 3 while one is decoded
    if needed > memory and not made_on_disk():
        raise ValueError(
            f"Invalid size of '{name}': {frames} frames of {height} x {width} pixels take "
            f"{needed:.3g} bytes. Must be at most memory={memory:.3g}."
        )


def film(values: Any) -> Counts:
    """Counts (time, y, x) of an array, also of one on disk: copied some frames at a time."""
    counts = empty(values.shape, np.dtype(values.dtype).newbyteorder("="))
    for frames in parts(counts):
        counts[frames] = values[frames]
    return counts


def smoother(counts: Counts, rearranged: Callable[[Counts], Counts] = np.ndarray.byteswap) -> int:
    """Form in which the first clear frame is smoother: 1 as it is, -1 the other, 0 unclear."""
    for frame in counts:
        as_is, swapped = _roughness(frame), _roughness(rearranged(frame))
        if sign := int(_SMOOTHER * as_is < swapped) - int(_SMOOTHER * swapped < as_is):
            return sign
    return 0


def _roughness(frame: Counts) -> float:
    values = frame.astype(np.int32)
    return sum(float(np.abs(np.diff(values, axis=axis)).sum()) for axis in (0, 1))


def array_name(names: Collection[str], name: str | None, path: Path) -> str:
    """Name of an array in a file, which may be left out if there is one alone."""
    if name is None and len(names) == 1:
        return next(iter(names))
    if name in [*names]:
        return str(name)
    if not names:
        rule = "Must have one; a store of dbthermal that has two bands is a capture as it is"
        raise ValueError(f"Missing array (time, y, x) in '{path.name}'. {rule}.")
    wanted = "name of one of the arrays" if name is None else f"array '{name}'"
    raise ValueError(f"Missing {wanted} in '{path.name}'. Must be one of {sorted(names)}.")


def check_unit(unit: str, name: str) -> None:
    """Raise ValueError if the numbers of a file are no counts."""
    if str(unit) not in {"count", "counts"}:
        raise ValueError(
            f"Invalid unit '{unit}' of '{name}'. Must be 'count': object and reflection add up in "
            "counts, and no longer in temperatures (temperature-linear data). Record or export raw "
            "counts."
        )


def byte_order(name: str, value: str) -> str:
    """Byte order as numpy writes it, of 'little' or 'big'."""
    if str(value) not in {"little", "big"}:
        raise ValueError(f"Invalid byte_order '{value}' for '{name}'. Must be 'little' or 'big'.")
    return "<" if value == "little" else ">"


def stamps(clock: Clock, frames: int, name: str) -> Array:
    """Times (time) [s] of frames, from a frame rate [Hz] or from their times [s]."""
    stated = schema.check_numbers(xr.DataArray(clock), f"the clock of '{name}'", "s")
    values = stated.values.astype(np.float64)
    rule = f"Must be a rate in (0, {_FASTEST:g}] Hz, or one finite time each in s"
    if values.ndim == 0:
        if not 0 < values <= _FASTEST:
            raise ValueError(f"Invalid clock {values} of '{name}'. {rule}.")
        return np.arange(frames) / float(values)
    if (
        values.shape != (frames,)
        or not np.all(np.isfinite(values))
        or (0 < np.ptp(values) * _FASTEST < frames - 1)
    ):
        label = f"clock of shape {values.shape} for {frames} frames of '{name}'"
        raise ValueError(f"Invalid {label}. {rule}.")
    return np.asarray(values - values[0])


def recording(
    counts: Counts,
    seconds: Array,
    name: str,
    attrs: Mapping[str, Any],
    flags: npt.NDArray[np.uint16] | None = None,
) -> xr.Dataset:
    """Dataset of one band: `counts` (time, y, x), its clock and flags; see `readers.flir`."""
    # Counts, of which both bytes are used.
    empty = (not any(np.any(frame & byte) for frame in counts) for byte in (0x00FF, 0xFF00))
    if any(empty):
        raise ValueError(
            f"Invalid counts of '{name}': one of their two bytes is always 0, as in pictures of 8 "
            "bits or with automatic gain. Must be 16-bit counts of the detector: record those."
        )
    # Times, which must rise where they are known.
    (stamped,) = np.nonzero(np.isfinite(seconds))
    steps = np.diff(seconds[stamped])
    if np.any(steps < 0):
        place = stamped[1:][steps < 0][0]
        label = f"frame {place} is {-steps[steps < 0][0]:.3f} s before the one that precedes it"
        rule = "Must rise; else give the times as clock="
        raise ValueError(f"Unordered times in '{name}': {label}. {rule}.")
    stamped = np.delete(stamped, 1 + np.flatnonzero(steps == 0))
    stands = ~np.isin(np.arange(seconds.size), stamped)
    exposed = np.where(stands, np.nan, seconds)
    if stamped.size < min(2, seconds.size):
        raise ValueError(
            f"Unknown times in '{name}': {stamped.size} of {seconds.size} frames have one. Must be "
            "given: clock= is the frame rate [Hz], or the time of each frame [s]."
        )
    # Flags of frames without a time, and behind a gap.
    flags = np.zeros(seconds.size, dtype=np.uint16) if flags is None else flags
    flags[stands] |= FileFlag.TIME_STANDS.value
    period = np.median(np.diff(exposed[stamped]) / np.diff(stamped)) if stamped.size > 1 else 1.0
    late = np.diff(exposed[stamped]) > _GAP * period * np.diff(stamped)
    flags[stamped[1:][late]] |= FileFlag.FRAMES_LOST_BEFORE.value
    # The dataset, with a clock without holes.
    variables = {
        "counts": (("time", "y", "x"), counts, schema.STAGES["capture"]["counts"].attrs),
        "exposure_time": ("time", exposed - exposed[stamped[0]], schema.EXPOSURE_TIME.attrs),
        "frame_flags": ("time", flags, FileFlag.cf_attrs(schema.FRAME_FLAGS)),
    }
    slots = np.arange(exposed.size)  # unknown times on the line between their neighbours
    outside = slots - np.clip(slots, stamped[0], stamped[-1])
    time = np.interp(slots, stamped, exposed[stamped]) + period * outside
    coordinate = ("time", time - time[0], schema.COORDINATES["time"].attrs)
    return xr.Dataset(variables, {"time": coordinate}, {"origin": schema.MEASURED, **attrs})


def clocked(counts: Counts, clock: Clock, name: str, **attrs: str) -> xr.Dataset:
    """Dataset of one band of a file that tells no times, from a rate [Hz] or times [s]."""
    seconds = stamps(clock, len(counts), name)
    return recording(counts, seconds, name, {"source": name, **attrs})


def label(paths: Sequence[Path]) -> str:
    """Name of some files in a message."""
    return paths[0].name if len(paths) == 1 else f"{paths[0].name} to {paths[-1].name}"


def optional(module: str, extra: str) -> Any:
    """Library of an extra; ImportError in one line if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(texts.missing_library(module, extra)) from error
