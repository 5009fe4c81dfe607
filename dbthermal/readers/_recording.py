"""Parts that all readers of recordings share: byte order, clock, and the Dataset made."""

import lzma
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, _text, schema
from dbthermal._arrays import Array, empty, made_on_disk, stretches
from dbthermal.readers._formats import PNG

Counts = npt.NDArray[np.uint16]
Flags = npt.NDArray[np.uint16]
Clock = float | npt.ArrayLike

MEMORY: Final = 2.0**30  # largest memory that a recording may take, by default [byte]
_FASTEST: Final = 1e6  # frame rate of a camera [Hz]
_STEPS: Final = (1e-3, 1.0)  # between frames whose times have no unit and are seconds [s]
_GAP: Final = 1.5  # a step of the clock longer than this many frame periods tells of a lost frame
DAMAGE: Final = (  # what the libraries of the formats raise for files that are damaged
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError),
    *(RuntimeError, SyntaxError, SystemError, TypeError, ValueError, Warning, TokenError),
    *(lzma.LZMAError, struct.error, zipfile.BadZipFile, zlib.error),
)
SMOOTHER: Final = 2.0  # times smoother than with bytes swapped or rows cut elsewhere, or unclear
_ALONG: Final = 64  # samples along each axis that tell which of them is time
_APART: Final = 1.3  # axes whose roughness differs by this factor are of another kind
_PACKED: Final = 64  # most bytes of counts in a byte of a file; .csq at hand 11, packed TIFF 3
SMALL: Final = 2**26  # size beyond which a recording is compared with its file [byte]
_PIECES: Final = 2**14  # of less than 1 kB in a file
_NEAR: Final = 256  # of neighbours, as signed numbers; of DJI's temperatures [0.1 K] median 3
_LISTED: Final = 16  # names of arrays in a message
ORDERS: Final = {"<": "little", ">": "big"}  # of bytes, as numpy and people write them
_MOMENT: Final = 40  # longest text of a date [character]
_LATEST: Final = 1e11  # time since 1970 [s], in the year 5138; milliseconds since 1970 are more
_JITTER: Final = 0.25  # of the times in names of files [frame]
_DATE: Final = re.compile(
    r"(20\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)\D?(\d\d)(?:\D?(\d+))?$|(1\d{9})(\.\d+|\d{3}|\d{6}|\d{9})$"
)
_COUNTS: Final = re.compile(  # names of a digital number
    r"(raw|adc|camera|digital)?[ _]?(counts?|numbers?|levels?|values?)|dn|dl|adu|lsb", re.IGNORECASE
)
_SECONDS: Final = {  # names of units of time, and their seconds
    r"s(ec(ond)?s?)?": 1.0,
    r"m(illi)?s(ec(ond)?s?)?": 1e-3,
    r"(u|\N{MICRO SIGN}|\N{GREEK SMALL LETTER MU}|micro)s(ec(ond)?s?)?": 1e-6,
    r"n(ano)?s(ec(ond)?s?)?": 1e-9,
    r"100 ?ns|ticks?": 1e-7,  # of clocks of Windows
    r"min(ute)?s?": 60.0,
    r"h(ou)?rs?|h": 3600.0,
    r"days?|d": 86400.0,
}


class FileFlag(schema.Flags):
    """State of a frame of a file."""

    FRAMES_LOST_BEFORE = 1, "the step of the clock is longer than 1.5 frame periods"
    TIME_STANDS = 2, "the time does not rise, or is not known"
    PADDED = 4, "no frame: the band has fewer than another, and its last one is repeated"
    NUMBERS_DIFFER = 8, "image and time are of frames of different numbers"


def numbered(paths: Sequence[Path]) -> tuple[Array | None, float]:
    """Places in time [file], None without a gap; usual step of dates [s], 0 without; by names."""
    numbers = [[int(digits) for digits in re.findall("[0-9]+", path.stem)] for path in paths]
    if len({*map(len, numbers)}) > 1 or len(paths) < 3:
        return None, 0.0
    table = np.array(numbers, dtype=np.float64)
    moments = np.array([moment(path.stem) for path in paths])
    is_dated, counting = np.isfinite(moments).all(), np.flatnonzero(np.ptp(table, axis=0))
    if not is_dated and counting.size != 1:  # parts of a recording
        return None, 0.0
    # Multiples of the usual step are missing frames; dates are right to a fraction of a frame.
    steps = np.diff(moments if is_dated else table[:, counting[0]])
    usual = float(np.percentile(steps, 50, method="lower") or 1.0)
    places = np.rint(apart := steps / usual)
    exact = not is_dated and np.array_equal(apart, places)
    # Dates jump where a clock was set; a number behind a date that rises is a counter, no fraction.
    counter = table[0, -1] < 1e9 and np.diff(table[:, -1]).min() > 0 and np.any(moments % 1)
    may_jump = is_dated and not counter
    near = (np.abs(apart - places) < _JITTER) & (places > 0) | (may_jump & (places > len(paths)))
    regular = bool(near.all()) and (may_jump or places.sum() < 2 * len(paths))
    gaps = places.max() > _GAP and (exact or regular)
    is_clock = is_dated and regular and steps.sum() > 1.0  # no counter behind a date
    return np.cumsum(np.append(0.0, places)) if gaps else None, is_clock * usual


def moment(text: str) -> float:
    """Time at which a text ends, of a date or in seconds since 1970 [s]; NaN for other texts."""
    if (match := _DATE.search(text)) is None:
        return np.nan
    *whole, fraction, unix, behind = match.groups("")
    with suppress(ValueError):
        second = datetime.strptime("".join(whole), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
        return second.timestamp() + float(f"0.{fraction}")
    return float(f"{unix}.{behind.removeprefix('.')}") if unix else np.nan


def dates(texts: Iterable[Any]) -> Array:
    """Seconds since 1970 of dates by ISO 8601, in UTC without a zone; ValueError of other texts."""
    seconds = list[float]()
    for text in (str(np.asarray(it).astype("U")) for it in texts):
        date = datetime.fromisoformat(text if len(text) <= _MOMENT else "")
        seconds.append(date.replace(tzinfo=date.tzinfo or UTC).timestamp())
    return np.array(seconds)


@contextmanager
def damage_named(label: str, rule: str) -> Iterator[None]:
    """Raise a library's error for a damaged file as one line; errors that name the file stay."""
    try:
        yield
    except (BlockingIOError, PermissionError) as error:  # of the system: it may be whole
        rule = "Must be readable, and closed by other programs: wait for its writer, or copy it"
        raise type(error)(f"Unreadable {label.partition(' ')[2]}: {error}. {rule}.") from error
    except DAMAGE as error:
        refused = isinstance(error, TypeError | ValueError) and "Must " in str(error)
        if refused and label.partition("'")[2] in str(error):
            raise
        message = f"{label}: {' '.join(str(error).split())[:200]}. Must be {rule}."
        refusal = f"Refused {label.partition(' ')[2]}: {error}"
        raise ValueError(refusal if refused else message) from error


def check_present(counts: Counts, fills: Sequence[Any], name: str) -> None:
    """Raise ValueError where counts are values that stand for missing ones."""
    if fills and any(np.isin(counts[at], fills).any() for at in stretches(counts)):
        raise ValueError(f"Missing counts in '{name}': {[*map(float, fills)]}. Must all be there.")


def check_memory(
    shape: Sequence[int], memory: float, name: str, stored: float, rows: slice = slice(None)
) -> tuple[int, int, int]:
    """Shape of counts (time, y, x) of some rows; ValueError beyond the memory, or for a bomb."""
    _numbers.real_number("memory", memory, _numbers.POSITIVE)
    if len(shape) != 3 or not all(size >= 1 for size in shape):  # of dask's, NaN: unknown
        raise ValueError(f"Invalid shape {tuple(shape)} of '{name}'. Must be (time, y, x), not 0.")
    frames, height, width = map(int, shape)
    schema.require(rows, slice, f"rows of '{name}'")
    if not (selected := len(range(height)[rows])):
        raise ValueError(f"Invalid rows {rows} of '{name}'. Must be some of its {height}.")
    needed = 2 * (frames * selected + 3 * height) * width  # 3 while one is decoded
    label = f"{frames} frames of {selected} x {width} pixels take {needed:.3g} bytes"
    if needed > memory and not made_on_disk():
        raise ValueError(f"Invalid size of '{name}': {label}. Must be at most memory={memory:.3g}.")
    if 2 * (frames + 3) * height * width > max(SMALL, _PACKED * stored):
        rule = f"Must be at most {_PACKED} times the {stored:.3g} bytes of the file"
        raise ValueError(f"Invalid size of '{name}': {label}. {rule}.")
    return frames, selected, width


def check_pieces(number: int, size: int, label: str) -> None:
    """Raise ValueError for pieces of less than 1 kB, each of which costs time, in large number."""
    if number > (most := max(_PIECES, size // 2**10)):
        raise ValueError(f"Invalid number {number} of {label}. Must be at most {most}.")


def film(values: Any) -> Counts:
    """Counts (time, y, x) of an array, which must be as it declares, copied frames at a time."""
    counts = empty(values.shape, np.dtype(values.dtype).newbyteorder("="))
    for frames in stretches(counts):
        block, place = values[frames], counts[frames]
        block = block.compute() if hasattr(block, "compute") else block  # NumPy alone loses a mask
        block = block.data if isinstance(block, xr.DataArray) else block
        if np.ma.is_masked(block):
            raise ValueError("Missing counts in 'array': masked. Must all be there.")
        actual = np.asarray(block)
        if (actual.dtype, actual.shape) != (values.dtype, place.shape):
            label = f"{actual.dtype} {actual.shape} of frames from {frames.start} on"
            raise ValueError(f"Invalid {label}. Must be {values.dtype} {place.shape}, as declared.")
        place[...] = actual
    return counts


def smoother(images: Iterable[Any], rearranged: Callable[[Any], Any] = np.ndarray.byteswap) -> int:
    """Smoother form of the first clear image: 1 as it is, -1 rearranged, 0 if all are unclear."""
    for frame in images:
        forms = (frame.astype(np.int32), rearranged(frame).astype(np.int32))
        as_is, swapped = (sum(np.abs(np.diff(it, axis=n)).sum() for n in (0, 1)) for it in forms)
        if sign := int(SMOOTHER * as_is < swapped) - int(SMOOTHER * swapped < as_is):
            return sign
    return 0


def check_byte_order(counts: Counts, name: str) -> None:
    """Raise ValueError for counts, not of 8 bits, that are smoother with their bytes swapped."""
    if smoother(counts) < 0 and not _of_8_bits(counts):
        rule = "Must be in the byte order that is stated; FLIR's pictures are read by readers.flir"
        raise ValueError(f"Invalid counts of '{name}': rougher than with bytes swapped. {rule}.")


def array_name(names: Collection[str], name: str | None, path: Path, shapes: Sequence[str]) -> str:
    """Name of an array in a file, which may be left out if the file has a single array."""
    if name is None and len(names) == 1:
        return next(iter(names))
    for candidate in () if name is None else (str(name), str(name).strip("/")):
        if candidate in names:
            return candidate
    if not names:
        rule = "Must have one: stack images, squeeze axes, save bands, fields; a store is a capture"
        label = f"'{path.name}', which has {', '.join(shapes[:3]) or 'none outside structs, cells'}"
        raise ValueError(f"Missing array (time, y, x) in {label}. {rule}.")
    wanted = "name of one of the arrays (--variable)" if name is None else f"array '{name}'"
    listed = sorted(names)[:_LISTED] + ["..."] * (len(names) > _LISTED)
    raise ValueError(f"Missing {wanted} in '{path.name}'. Must be one of {listed}.")


def check_unit(unit: str, name: str) -> None:
    """Raise ValueError if the numbers of a file are no counts."""
    if not _COUNTS.fullmatch(str(unit).strip()):
        rule = "Must be 'count': object and reflection add up in counts, and no longer in "
        rule += "temperatures (temperature-linear data). Record or export raw counts"
        raise ValueError(f"Invalid unit '{unit}' of '{name}'. {rule}.")


def check_times(values: npt.NDArray[Any], unit: str, clock: Clock | None, name: str) -> Array:
    """Seconds since the first frame, by a file; ValueError if the clock, where stated, differs."""
    # Seconds since the first frame; of numbers without a unit in any that is in use.
    word = unit.partition(" since ")[0].strip()
    scales = [scale for text, scale in _SECONDS.items() if re.fullmatch(text, word, re.IGNORECASE)]
    if values.dtype.kind in "mM":
        word, values, scales = "s", (values - values[0]) / np.timedelta64(1, "s"), [1.0]
    elif not word:
        scales = [1.0] if clock is None else [*_SECONDS.values()]  # in days, of tables
        step = abs(float(values[-1]) - float(values[0])) / max(len(values) - 1, 1)
        if clock is None and not _STEPS[0] < step < _STEPS[1]:  # at 1: numbers of frames?
            label = f"Missing unit of the times of '{name}', which rise by {step:g} a frame"
            raise ValueError(f"{label}. Must be s, ms, us, ns; or state the rate, clock= [Hz].")
    if not scales:
        raise ValueError(f"Invalid units '{unit}' of the times of '{name}'. Must be s, ms, us, ns.")
    apart = values.astype(np.float64) - float(values[0])
    stated = scales[0] * apart if clock is None else stamps(clock, len(values), name)
    seconds = min((apart * scale for scale in scales), key=lambda s: np.abs(s - stated).max())
    agrees = np.abs(seconds - stated) <= 0.5 * stated[-1] / max(len(stated) - 1, 1)
    rises = np.diff(seconds, prepend=-1.0) > 0
    if not np.all(valid := rises if clock is None else rises & agrees):
        first = int(np.argmin(valid))
        moment = f"{apart[first]:g} {word or '(no unit)'}"
        mismatch = f"frame {first} at {moment}, by clock= at {stated[first]:g} s"
        rule = "Must agree to half a frame, and rise: leave clock= out, or numbers of frames"
        if not rises[first]:
            mismatch = f"frame {first} at {seconds[first]:g} s, after {seconds[first - 1]:g} s"
            rule = "Must rise: correct them, or save the counts without them and state clock= [Hz]"
        raise ValueError(f"Invalid times of '{name}': {mismatch}. {rule}.")
    return np.asarray(seconds)


def another_rate(rate: Any, seconds: Array, name: str) -> list[str]:
    """Sentence on a frame rate [Hz] that a file states, if the stated clock has another one."""
    with suppress(TypeError, ValueError):
        stated = float(np.asarray(rate).item())
        if abs((len(seconds) - 1) - seconds[-1] * stated) > 0.5 and 0 < stated < _FASTEST:
            rule = "Must be the rate of recording; that in the file may be of playing it"
            return [f"'{name}' states {stated:g} frames a second, and clock= another rate. {rule}."]
    return []


def byte_order(name: str, value: str) -> str:
    """Byte order as numpy writes it, of 'little' or 'big'."""
    if str(value) not in ORDERS.values():
        raise ValueError(f"Invalid byte_order '{value}' for '{name}'. Must be 'little' or 'big'.")
    return "<" if value == "little" else ">"


def stamps(clock: Clock | None, frames: int, name: str, *sentences: str) -> Array:
    """Times (time) [s] of frames, from a frame rate [Hz] or from their times [s] or dates."""
    if clock is None:
        rule = "Must be the frame rate [Hz], or the time of each frame [s], in a file as ISO 8601"
        label = f"Missing clock= for '{name}', which tells no times"
        raise ValueError(" ".join([f"{label}. {rule} or numbers.", *sentences]))
    stated = xr.DataArray(clock)
    with suppress(ValueError):  # of no dates, as of durations
        stated = xr.DataArray(dates(np.ravel(clock))) if stated.dtype.kind in "OUM" else stated
    schema.check_numbers(stated, f"the clock of '{name}'", "s")
    values = stated.values.astype(np.float64)
    rule = f"Must be a rate in (0, {_FASTEST:g}] Hz, or one finite time each in seconds"
    if values.ndim == 0:
        if not 0 < values <= _FASTEST:
            raise ValueError(f"Invalid clock {values} of '{name}'. {rule}.")
        return np.arange(frames) / float(values)
    fits = values.shape == (frames,) and np.abs(values).max() < _LATEST  # and no NaN
    if not fits or 0 < np.ptp(values) * _FASTEST < frames - 1:
        label = f"clock of shape {values.shape} for {frames} frames of '{name}'"
        raise ValueError(f"Invalid {label}, up to {values.max(initial=0.0):g}. {rule}.")
    return np.asarray(values - values[0])


def recording(
    counts: Counts, seconds: Array, name: str, attrs: Mapping[str, Any], flags: Flags | None = None
) -> xr.Dataset:
    """Dataset of one band: `counts` (time, y, x), its clock and flags; see `readers.flir`."""
    if _of_8_bits(counts):
        form = "they have 8 bits, alone or spread over two bytes, as in pictures or automatic gain"
        label = f"Invalid counts of '{name}': {form if counts.any() else 'all are 0'}"
        raise ValueError(f"{label}. Must be 16-bit counts of the detector: record those.")
    # Times, which must rise where they are known.
    (stamped,) = np.nonzero(np.isfinite(seconds))
    steps = np.diff(seconds[stamped])
    if np.any(steps < 0):
        place = stamped[1:][steps < 0][0]
        label = f"frame {place} is {-steps[steps < 0][0]:.3f} s before the one that precedes it"
        rule = "Must rise: correct them, or state the rate, clock= [Hz]"
        raise ValueError(f"Unordered times in '{name}': {label}. {rule}.")
    stamped = np.delete(stamped, 1 + np.flatnonzero(steps == 0))
    stands = ~np.isin(np.arange(seconds.size), stamped)
    exposed = np.where(stands, np.nan, seconds)
    if stamped.size < min(2, seconds.size):
        label = f"Unknown times in '{name}': {stamped.size} of {seconds.size} frames have one"
        rule = "Must be given: clock= is the frame rate [Hz], or the time of each frame [s]"
        raise ValueError(f"{label}. {rule}.")
    # Flags of frames without a time, and behind a gap.
    flags = np.zeros(seconds.size, dtype=np.uint16) if flags is None else flags
    flags[stands] |= FileFlag.TIME_STANDS.value
    periods = np.diff(exposed[stamped]) / np.diff(stamped) if stamped.size > 1 else 1.0
    period = np.percentile(periods, 50, method="lower")  # of two, the one without a gap
    late = np.diff(exposed[stamped]) > _GAP * period * np.diff(stamped)
    flags[stamped[1:][late]] |= FileFlag.FRAMES_LOST_BEFORE.value
    # The dataset, with a clock without holes.
    values = {"counts": counts, "exposure_time": exposed - exposed[stamped[0]]}
    variables = schema.variables("recording", values)
    variables["frame_flags"] = "time", flags, FileFlag.cf_attrs(schema.FRAME_FLAGS)
    slots = np.arange(exposed.size)  # unknown times on the line between their neighbours
    outside = slots - np.clip(slots, stamped[0], stamped[-1])
    time = np.interp(slots, stamped, exposed[stamped]) + period * outside
    coordinate = ("time", time - time[0], schema.COORDINATES["time"].attrs)
    return xr.Dataset(variables, {"time": coordinate}, {"origin": schema.MEASURED, **attrs})


def _of_8_bits(counts: Counts) -> bool:
    """Tell whether all counts are of 256 numbers below 256, or 256 or more apart."""
    used = np.zeros(2**16, dtype=bool)
    for frame in counts:
        used[frame] = True
        if np.count_nonzero(used) > 2**8:
            return False
    levels = np.flatnonzero(used)
    return bool(levels[-1] < 2**8 or np.gcd.reduce(np.diff(levels), initial=0) >= 2**8)


def _check_unsigned(counts: Counts, name: str) -> None:
    """Raise ValueError for signed numbers, as of temperatures, which pass from 0 to 65535."""
    for image in counts[:: -(-len(counts) // 8)]:
        steps = [np.diff(image.astype(np.int32), axis=axis).ravel() for axis in (0, 1)]
        wraps = 2**16 - np.abs(np.concatenate(steps))
        wraps = wraps[wraps < 2**15]  # signed; of dead beside saturated pixels few, or large
        if wraps.size > np.sqrt(image.size) and np.median(wraps) < _NEAR:
            rule = "Must be whole numbers from 0: counts, and no temperatures, nor a drawn text"
            raise ValueError(f"Invalid counts of '{name}': as of signed numbers. {rule}.")


def clocked(counts: Counts, clock: Any, name: str, *sentences: str, **attrs: str) -> xr.Dataset:
    """Dataset of one band of a file, from a rate [Hz] or times [s]."""
    seconds = stamps(clock, len(counts), name)
    _check_unsigned(counts, name)
    made = recording(counts, seconds, name, {"source": name, **attrs})
    is_cut = sentences and attrs["format"] == "raw"  # at another size: frames are in no order
    doubts = [] if is_cut else _doubts_on_order(counts, name)
    if (late := np.flatnonzero(made["frame_flags"].values & FileFlag.FRAMES_LOST_BEFORE)).size:
        steps = np.diff(seconds)
        missing = np.rint(steps[late - 1] / np.percentile(steps, 50, method="lower") - 1.0).sum()
        label = f"The times or numbers of '{name}' leave out frames, {missing:.0f} in all"
        rule = "Must be all that were recorded: there are gaps in time in their place"
        doubts.append(f"{label}, the first before frame {late[0]}. {rule}.")
    return schema.warned(made, *sentences, *doubts)


def _doubts_on_order(counts: Counts, name: str) -> list[str]:
    """Sentence on counts (time, y, x) whose time may be along another axis, or of bands in turn."""
    sides = [slice(max(0, (n - _ALONG) // 2), (n + _ALONG) // 2) for n in counts.shape]
    middle = counts[tuple(sides)]
    if min(middle.shape) < 8:
        return []
    still = middle.astype(np.int32)
    steps = [np.median(np.abs(still[n:] - still[:-n]).mean(axis=(1, 2))) for n in range(1, 5)]
    if SMOOTHER * min(steps) < steps[0]:
        label = f"Frames of '{name}' are like those {np.argmin(steps) + 1} later, not like the next"
        return [f"{label}. Must be of one band: save those of a filter wheel as a file for each."]
    # Roughness of an axis: mean second difference without its largest quarter, plus rounding.
    rough = list[float]()
    for axis in range(3):
        means = middle.mean(axis=tuple({0, 1, 2} - {axis}), keepdims=True)
        steps, turns = (np.abs(np.diff(means, order, axis=axis)).mean() for order in (1, 2))
        values = middle - (means if turns > steps else 0.0)  # without a pattern of columns
        bends = np.sort(np.abs(np.diff(values, 2, axis=axis)), axis=None)
        rough.append(float(np.log(bends[: 3 * bends.size // 4].mean() + 0.3)))
    for axis, like in ((1, 2), (2, 1)):  # rows are about as rough as columns, time is not
        alike, unlike = abs(rough[0] - rough[like]), np.abs(np.subtract(rough, rough[axis]))
        if max(SMOOTHER * alike, np.log(_APART)) < np.delete(unlike, axis).min():
            rule = "Must be (time, y, x): transpose it if it is not"
            return [f"Axis {axis} of '{name}' may be time, by how its neighbours differ. {rule}."]
    return []


def copies(counts: Counts, paths: Sequence[Path]) -> list[str]:
    """Sentence on files of a frame each, whose counts are those of the file before."""
    files = range(1, len(paths) if len(counts) == len(paths) else 0)
    if not (twins := [n for n in files if np.array_equal(*counts[n - 1 : n + 1])]):
        return []
    label = f"'{paths[twins[0] - 1].name}' and '{paths[twins[0]].name}', {len(twins)} in all"
    return [f"Same counts in {label}. Must be different frames: is one a copy?"]


def png_size(content: bytes, place: str) -> tuple[int, int, int]:
    """Height, width and bits that a PNG states, which must be gray, of 16 bits."""
    columns, rows, bits, colours = struct.unpack_from(">IIBB", content.ljust(26), 16)
    if bits != 16 or colours or not rows * columns:
        label = f"{rows} x {columns} pixels of {bits} bits, colours {colours}, of PNG in {place}"
        raise ValueError(f"Invalid {label}. Must be of 16 bits and gray: counts, not a picture.")
    return rows, columns, bits


def png(content: bytes, place: str) -> Counts:
    """Counts (y, x) of a PNG of 16 bits, from its pixels' chunks alone, whose CRC must be right."""
    at, pieces = len(PNG), [PNG]
    while at < len(content) and pieces[-1][4:8] != b"IEND":
        length, kind = struct.unpack_from(">I4s", content.ljust(at + 8, b"\0"), at)
        chunk = content[at : at + 12 + length]
        if len(chunk) != 12 + length or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:]):
            raise ValueError(f"Damaged PNG in {place}: chunk {kind!r}. Must fit its checksum.")
        pieces += [chunk] if kind in {b"IHDR", b"IDAT", b"IEND"} else []
        at += 12 + length
    with damage_named(f"Damaged PNG in {place}", "a PNG that decodes"):
        counts = optional("imagecodecs", "recordings").png_decode(b"".join(pieces))
    return decoded(counts, png_size(content, place)[:2], place)


def decoded(counts: npt.NDArray[Any], shape: tuple[int, int], place: str) -> Counts:
    """Counts that a codec gave, which must be of the shape and type that the file states."""
    if counts.shape != shape or counts.dtype != np.uint16:
        label = f"{counts.dtype} of {counts.shape} of {place}"
        raise ValueError(f"Damaged {label}. Must be uint16 of {shape}, as stated.")
    return counts


def label(paths: Sequence[Path]) -> str:
    """Name of some files in a message."""
    return paths[0].name if len(paths) == 1 else f"{paths[0].name} to {paths[-1].name}"


def optional(module: str, extra: str) -> Any:
    """Library of an extra; ImportError in one line if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(_text.missing_library(module, extra)) from error
