"""Frames of numbers behind headers: bare ones, FLIR .sfmov with its rate in .inc, Telops .hcc."""

import re
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import fft

from dbthermal import _numbers
from dbthermal._arrays import Array
from dbthermal.readers import _formats, _recording
from dbthermal.readers._recording import MEMORY, SMOOTHER, Clock, Counts

_FIRST: Final = 8  # frames that tell rows from columns
_LONGER: Final = 64  # factor of roughness between the parts of a longer number
# Distances of rows over those of halves: FLIR's samples 1.03, doubled 1.1 to 2; noise 1.2.
_HALVES, _FEWEST = 1.3, 192
_LONGEST: Final = 2**16  # header of an .sfmov, or its .inc [byte]
# Header of a Telops frame: length [byte], rate [mHz], time [s] and its fraction [100 ns], and more.
_HEADER: Final[np.dtype[Any]] = np.dtype(
    {
        "names": ["signature", "length", "mode", "columns", "rows", "rate", "seconds", "fraction"],
        "formats": ["S2", "<u2", "u1", "<u2", "<u2", "<u4", "<u4", "<u4"],
        "offsets": [0, 4, 28, 32, 34, 44, 100, 104],
    }
)
_COUNTS: Final = (0, 1, 5)  # modes of raw counts, and of counts corrected for gain and offset


def raw(
    path: str | Path,
    shape: tuple[int, int],
    *,
    byte_order: str,
    unit: str,
    clock: Clock,
    header: int = 0,
    frame_header: int = 0,
    memory: float = MEMORY,
) -> xr.Dataset:
    """Counts of a file of bare 16-bit numbers, frame after frame.

    Nothing in such a file tells its form. Result and errors are as from `tiff`; what is stated must
    fit the size of the file without remainder. An image is refused that is smoother, or as rough,
    with its bytes swapped, smoother with rows of another length, or of longer numbers.

    Parameters
    ----------
    path, shape : str or Path, (int, int)
        Regular file; rows and columns of a frame [pixel].
    byte_order, unit, clock, memory : {"little", "big"}, and as for `tiff`
        Order of the bytes of a number.
    header, frame_header : int
        Size of what precedes the first frame, and each frame [byte].

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> frames = np.arange(18000, 18024, dtype=">u2").reshape(2, 3, 4)
    >>> with TemporaryDirectory() as folder:
    ...     frames.tofile(f"{folder}/a.raw")
    ...     capture = raw(f"{folder}/a.raw", (3, 4), byte_order="big", unit="count", clock=30.0)
    >>> bool((capture.counts == frames).all())
    True
    """
    (file,) = _formats.files([path], "raw")
    name = file.name
    _recording.check_unit(unit, name)
    # Form, as stated.
    order = _recording.byte_order(name, byte_order)
    for label, value in {"header": header, "frame_header": frame_header}.items():
        _numbers.whole_number(f"{label} of '{name}'", value, (0, sys.maxsize))
    sizes = np.asarray(shape)
    frame = 2.0 * np.prod(sizes, dtype=float) if sizes.dtype.kind in "iu" else np.nan  # [byte]
    if sizes.shape != (2,) or not frame < 2**31 or sizes.min() < 1:
        rule = "Must be rows and columns, two whole numbers, of less than 2 GB"
        raise ValueError(f"Invalid shape {shape} of '{name}'. {rule}.")
    # Counts, whose images must be smooth in that form.
    form = np.dtype([("header", f"V{frame_header}"), ("counts", f"{order}u2", shape)])
    counts = _recording.film(_frames(file, form, header, memory)["counts"])
    if (sign := _recording.smoother(counts)) < 0:
        rule = "Must be the other byte order, or another shape or header"
        raise ValueError(f"Invalid counts of '{name}': rougher than with bytes swapped. {rule}.")
    if _are_longer(counts) or (sign == 0 and np.ptp(counts[0])):
        rule = "Must be smoother than with bytes swapped, not of 8 or 32 bits or packed"
        raise ValueError(f"Invalid counts of '{name}': no images of 16-bit numbers. {rule}.")
    # What changes is smoother than the pattern of the pixels, and tells the width of the rows.
    further = counts[:: -(-len(counts) // _FIRST)].astype(np.int32)
    images = [counts[:_FIRST].mean(axis=0), *counts[:_FIRST], *(further[1:] - further[0])]
    # Even and odd rows may have another level, which is no longer row.
    level = [frame - frame.mean(axis=1, keepdims=True) for frame in images]
    size, widths, likely = shape[0] * shape[1], range(shape[1] // 2 + 1, 2 * shape[1]), list[int]()
    for width in (width for width in (shape[0], *widths, 2 * shape[1]) if size % width == 0):
        alike = level if width == 2 * shape[1] else images
        if _recording.smoother(alike, lambda frame: frame.reshape(-1, width)) < 0:  # noqa: B023
            likely.append(width)
    if shape[1] % 2 == 0 and any(map(_halves_are_rows, images)):
        likely.append(shape[1] // 2)
    if likely:
        films = [np.reshape(images, (len(images), -1, width)) for width in likely]
        film = min(films, key=lambda it: sum(np.abs(np.diff(it, axis=n)).mean() for n in (1, 2)))
        label = f"Invalid shape {shape} of '{name}': rougher than {film.shape[1:]}"
        raise ValueError(f"{label}. Must be rows, then columns.")
    decided = {"byte_order": byte_order, "byte_order_by": "caller"}
    return _recording.clocked(counts, clock, name, *_other_size(counts), format="raw", **decided)


def _other_size(counts: Counts) -> list[str]:
    """Sentence on images that are parts of a frame, or several: they repeat at another distance."""
    height, rows = counts.shape[1], np.concatenate(counts[: 2 * _FIRST]).astype(np.int32)

    def change(distance: int) -> float:
        """Median change from a row to the row at a distance below."""
        return float(np.median(np.abs(rows[distance:] - rows[:-distance])) + 0.5)

    tried = [height // n for n in (4, 3, 2) if height % n == 0] + [n * height for n in range(1, 5)]
    for n in (n for n in tried if 2 < n < len(rows) // 2):
        aside = 2 * -(-n // 16)  # even, as even and odd rows may differ
        unlike = [n - aside, n + aside, *[height] * (n > height)]
        if change(n) < min(map(change, unlike)) / SMOOTHER:
            said = f"Rows of images repeat after {n}, not {height}. Must be the height of a frame."
            return [said] * (n != height)
    # Any other size, by the autocorrelation of the pixels' pattern: a gradient repeats everywhere.
    size, signs = counts[0].size, np.sign(np.diff(counts[:_FIRST].ravel().astype(np.int32)))
    power = np.abs(fft.rfft(signs.astype(np.float32), fft.next_fast_len(2 * signs.size))) ** 2
    alike = fft.irfft(power)[: signs.size // 2] / np.arange(signs.size, (signs.size + 1) // 2, -1)
    likely = alike[size // 4 : -1] > 1.0 / SMOOTHER
    period = size // 4 + int(np.argmax(likely))
    if len(counts) < _FIRST or not likely.any():
        return []
    unlike = np.abs(alike[[period - 1, period + 1, size]]).max()
    said = f"Numbers repeat after {period}, not {size}. Must be rows times columns of a frame."
    return [said] * bool(alike[period] > SMOOTHER * unlike)


def _halves_are_rows(image: npt.NDArray[np.int32]) -> bool:
    """Tell whether both halves of a row are rows: nearer to each other than to the next but one."""
    if image.size < _FEWEST or len(image) == 1:
        return False
    halves = image.reshape(2 * len(image), -1)
    near = np.abs(np.diff(halves, axis=0)).mean(axis=1)  # in a row, to the row below, in a row
    next_but_one = np.abs(halves[2:] - halves[:-2]).mean()
    return bool(next_but_one > _HALVES * max(near[::2].mean(), near[1::2].mean()))


def _are_longer(counts: Counts) -> bool:
    """Tell whether numbers are parts of longer numbers: neighbours or some fourths are rougher."""
    values = counts[0].ravel().astype(np.int32)
    if values.size < _FIRST * 4:
        return False
    steps = [np.median(np.abs(np.diff(it))) for it in (values, *(values[n::4] for n in range(4)))]
    return bool(max(steps) > _LONGER * (min(steps[1:]) + 1))


def sequence(path: str | Path, *, clock: Clock | None = None, memory: float = MEMORY) -> xr.Dataset:
    """Counts of a recording in an .sfmov of FLIR or an .hcc of Telops.

    Result and errors are as from `array`; ValueError, too, for temperatures or radiances.

    Parameters
    ----------
    path, clock, memory : str or Path, and as for `array`
        File; the .inc of an .sfmov lies beside it.
    """
    _numbers.real_number("memory", memory, _numbers.POSITIVE)
    (path,) = _formats.files([path], "sequence")
    with _recording.damage_named(f"Damaged '{path.name}'", "a whole .sfmov or .hcc"):
        counts, times = (_sfmov if path.suffix.lower() == ".sfmov" else _hcc)(path, memory)
    _recording.check_byte_order(counts, path.name)
    if times is not None:
        clock = _recording.check_times(times, "s", clock, path.name)
    return _recording.clocked(counts, clock, path.name, format=path.suffix.lower()[1:])


def _frames(path: Path, form: np.dtype[Any], start: int, memory: float) -> npt.NDArray[Any]:
    """Frames, each with its header and counts, behind a start; the file must hold whole ones."""
    size = path.stat().st_size
    number, remainder = divmod(max(0, size - start), form.itemsize)
    if number < 1 or remainder:
        label = f"{size} bytes of '{path.name}': {number} frames and {remainder} bytes"
        rule = f"Must be whole frames of {form.itemsize} bytes behind {start}, as stated"
        raise ValueError(f"Truncated or damaged: {label}. {rule}.")
    _recording.check_memory((number, *form["counts"].shape), memory, path.name, size)
    return np.memmap(path, form, "r", start)


def _sfmov(path: Path, memory: float) -> tuple[Counts, Array | None]:
    """Counts behind the lines of a header, and their times, if an .inc tells the rate."""
    with path.open("rb") as stream:
        content = stream.read(_LONGEST)
    header, mark, _ = content.partition(b"\nDATA")
    lines, names = _lines(header), ("NumDPs", "yPixls", "xPixls")
    if not mark or not all(lines.get(name, "").isdecimal() for name in names):
        rule = f"Must have {', '.join(names)} and DATA within {_LONGEST} bytes"
        raise ValueError(f"Invalid header of '{path.name}'. {rule}.")
    if re.search("fl|32|64|8", kind := lines.get("DaType", ""), re.IGNORECASE):
        rule = "Must be of 16-bit counts: record or export those"
        raise ValueError(f"Invalid DaType '{kind}' of '{path.name}'. {rule}.")
    frames, rows, columns = (int(lines[name]) for name in names)
    size, behind = path.stat().st_size, len(header) + len(mark)
    _recording.check_memory((frames, rows, columns), memory, path.name, size)
    # The frames end with the file; blanks, if any, and the end of the line lie before them.
    start = size - 2 * frames * rows * columns
    if not re.fullmatch(rb"[ \0]*\r?\n?", content[behind : max(start, 0)]) or start < behind:
        label = f"{size - behind} bytes behind DATA of '{path.name}'"
        rule = f"Must be {frames} frames of {rows} x {columns}, or be read by readers.raw"
        raise ValueError(f"Truncated or damaged: {label}. {rule} with header= [byte].")
    counts = np.memmap(path, "<u2", "r", start, (frames, rows, columns))
    notes = path.with_suffix(".inc")
    is_short = notes.is_file() and notes.stat().st_size <= _LONGEST
    rate = float(_lines(notes.read_bytes()).get("FRate_0", 0.0)) if is_short else 0.0
    return _recording.film(counts), np.arange(frames) / rate if rate > 0.0 else None


def _lines(header: bytes) -> dict[str, str]:
    """Values by name of the lines of a text."""
    pairs = [line.split(maxsplit=1) for line in header.decode("latin-1").splitlines()]
    return {pair[0]: pair[1].strip() for pair in pairs if len(pair) == 2}


def _hcc(path: Path, memory: float) -> tuple[Counts, Array | None]:
    """Counts of frames that have a header each, and their times, else by the frame rate."""
    first = np.fromfile(path, _HEADER, 1)
    if not first.size or first["signature"][0] != b"TC" or first["length"][0] <= _HEADER.itemsize:
        raise ValueError(f"Invalid header of '{path.name}'. Must begin with TC, as of Telops.")
    # All frames by their headers, which must be alike.
    length, rows, columns = (int(first[name][0]) for name in ("length", "rows", "columns"))
    between = ("more", f"V{length - _HEADER.itemsize}")
    form: Any = [("header", _HEADER), between, ("counts", "<u2", (rows, columns))]
    frames = _frames(path, np.dtype(form), 0, memory)
    headers = frames["header"]
    for name in ("signature", "length", "rows", "columns", "mode"):
        for number in np.flatnonzero(headers[name] != headers[name][0]):
            label = f"Damaged '{path.name}': {name} of frame {number}"
            raise ValueError(f"{label}. Must be as of the first frame.")
    if (mode := int(first["mode"][0])) not in _COUNTS:
        label = f"calibration mode {mode} of '{path.name}', temperatures or radiances"
        raise ValueError(f"Invalid {label}. Must be of counts, raw or corrected (NUC).")
    times = headers["seconds"] - float(first["seconds"][0]) + 1e-7 * headers["fraction"]
    if not np.ptp(times) and (rate := 1e-3 * float(first["rate"][0])) > 0.0:
        times = np.arange(len(frames)) / rate
    return _recording.film(frames["counts"]), times if np.ptp(times) else None
