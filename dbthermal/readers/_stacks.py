"""Counts that other programs wrote as TIFF or PNG, which tell little else."""

import json
import logging
import math
import re
from collections import Counter
from collections.abc import Iterator
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

from dbthermal._arrays import Array, empty, release
from dbthermal.readers import _formats, _recording
from dbthermal.readers._recording import MEMORY, Clock, Counts

_FORM: Final = (  # tifffile's attribute of a page, or a tag (1 if missing); name, value, rule
    ("bitspersample", "bits of a pixel", 16, "16: counts, not a picture"),
    ("sampleformat", "sample format", 1, "1: whole numbers from 0, counts and no temperatures"),
    ("is_reduced", "preview", False, "False: a frame, not a smaller copy of one"),
    ("samplesperpixel", "values of a pixel", 1, "1: counts, not colours"),
    ("fillorder", "order of bits", 1, "1: the highest bit first"),
    (262, "photometric interpretation", 1, "1: more counts are whiter"),
    (274, "orientation", 1, "1: rows from the top, columns from the left; save it upright"),
)
# Compressions without loss, and the codec that undoes them.
_CODECS: Final = {1: "", 5: "lzw", 8: "zlib", 32946: "zlib", 32773: "packbits", 34925: "lzma"}
_CODECS.update({50000: "zstd"})
_METADATA, _NO_DATA = 42112, 42113  # tags of GDAL
_SCALING: Final = re.compile(r"<Item\b[^<>]{0,200}\brole=.(scale|offset).[^<>]{0,200}>([^<]*)")
_LOSSLESS: Final = "LZW, deflate, PackBits, LZMA, Zstandard"
_TILE: Final = 2**19  # that tiles may have beyond 8 times their image [byte]
_TEMPERATURES: Final = re.compile(  # unit of values in a description, as of ImageJ or in JSON
    r"""(?im)\b(?:v|value[ _]?)?units?["']?\s*[:=]\s*["']?(?:[0-9./]+ ?)?([cm]?K|[a-z]*kelvins?|"""
    r"""(?:deg[a-z]*|\N{DEGREE SIGN})?[ _]*(?:[CF]|celsius|fahrenheit))\b"""
)
_NUMBER: Final = r"[0-9]+\.?[0-9]*(?:[eE][+-]?[0-9]+)?"
_CALIBRATION: Final = re.compile(rf"(?m)^(c[0-9])=(-?{_NUMBER})$")  # polynomial of ImageJ
_SCALES: Final = {"scale": (1.0,), "c1": (1.0,), "c0": (0.0, -32768.0)}  # this of signed numbers
_IMAGEJ: Final = re.compile(r"\AImageJ=.*?^images=([0-9]{1,9})$", re.DOTALL | re.MULTILINE)

# Numbers of images along axes, as ImageJ and OME write them.
_AXES: Final = re.compile(r"""(?m)(?:^(channels|slices|frames)=|\bSize([CZT])=")([0-9]{1,9})""")
# Intervals of frames, their unit, frame rates, and times, as ImageJ, OME and JSON write them.
_STATED: Final = r"""(?i)\b(?:{})["']?\s*[:=]\s*["']?({})"""
_INTERVAL: Final = re.compile(_STATED.format("finterval|frame[ _]?interval|TimeIncrement", _NUMBER))
_TIMES: Final = re.compile(_STATED.format("DeltaT", _NUMBER))
_SIMULATED: Final = re.compile(_STATED.format("origin", "simulated"))
_RATE: Final = re.compile(_STATED.format("fps|frame[ _]?rate", _NUMBER))
_TIME_UNIT: Final = re.compile(_STATED.format("tunit|TimeIncrementUnit|DeltaTUnit", r"\w+"))
_OVER_TIME: Final = re.compile("[TZIQ]?YX")  # axes as tifffile names them; slices are ImageJ's own


def tiff(
    path: _formats.Paths,
    *,
    unit: str,
    clock: Clock | None = None,
    rows: slice = slice(None),
    memory: float = MEMORY,
) -> xr.Dataset:
    """Counts of a TIFF or BigTIFF stack, or of one TIFF or PNG a frame, in 16 bits.

    Such files tell no unit, and rarely times. An interval of frames, or times, by ImageJ, OME or
    Micro-Manager, or dates finer than 1 s, must agree with the clock, or serve as the clock.

    OSError if a file cannot be opened, ImportError without the extra ``recordings``; TypeError or
    ValueError if the unit is another one; a file is damaged, or holds two bands or other axes; a
    page has no 16-bit counts, or they are missing, scaled, mirrored, rotated, inverted, compressed
    with loss or of another size; they take too much memory or have 8 bits; or the clock is wrong.
    UserWarning if dates or a description have another rate, numbers or dates leave files out,
    stacks before the last differ in length, a frame is there twice, or another axis may be time.

    Parameters
    ----------
    path : str, Path or sequence
        File of one page or many, or the files of one recording, with numbers that rise.
    unit : {"count"}
        Unit of the pixels. Temperatures, also as whole numbers (temperature-linear data), are
        refused: the camera made them with an emissivity, and mixtures add up in counts only.
    clock : float or array_like, optional
        Frame rate [Hz], or time [s] or date of each frame. At a rate, files with a frame each whose
        numbers, or dates, leave some out have gaps in time there.
    rows : slice, optional
        Rows of the image to keep; no others take memory.
    memory : float
        Largest memory that the counts may take [byte]; refused before it is taken.

    Returns
    -------
    Dataset
        `counts` (time, y, x) [count], uint16, `exposure_time` and `frame_flags` (time), as from
        `flir`; attributes ``source``, ``format``, ``byte_order``.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np, tifffile
    >>> frames = np.arange(18000, 18024, dtype=np.uint16).reshape(2, 3, 4)
    >>> with TemporaryDirectory() as folder:
    ...     tifffile.imwrite(f"{folder}/a.tif", frames, photometric="minisblack")
    ...     capture = tiff(f"{folder}/a.tif", unit="count", clock=30.0)
    >>> bool((capture.counts == frames).all()), capture.time.values.round(3).tolist()  # [s]
    (True, [0.0, 0.033])
    """
    paths = _formats.files(path, "tiff")
    name = _recording.label(paths)
    _recording.check_unit(unit, name)
    # Pages of one size, and the memory that they take.
    pages = [page for file in paths for page in _pages(file)]
    for page in (page for page in pages if page.shape != pages[0].shape):
        label = f"Invalid page of {page.shape} in '{page.path.name}'"
        raise ValueError(f"{label}. Must be {pages[0].shape}, as the first.")
    stored = sum(length for page in pages for _, length in page.spans)
    shape = _recording.check_memory((len(pages), *pages[0].shape), memory, name, stored, rows)
    seconds, sentences = _times(pages, clock, name)
    is_even = np.ndim(np.asarray(clock)) == 0 and np.allclose(np.diff(seconds), seconds[1:2])
    places, step = _recording.numbered(paths) if is_even else (None, 0.0)
    size, *lengths = Counter(page.path for page in pages).values()
    if step and abs(step / (size * seconds[1]) - 1) > 0.5:  # as of times in a file
        label = f"The dates of '{name}' are {step:.3g} s apart, by clock= {size * seconds[1]:.3g} s"
        sentences.append(f"{label}. Must be the rate of recording.")
    if places is not None and {*lengths[:-1]} <= {size}:  # the last stack may be shorter
        spans = zip(size * places, (size, *lengths), strict=True)
        seconds = seconds[1] * np.concatenate([first + np.arange(n) for first, n in spans])
    # Pixels, from the places that the pages state.
    counts = empty(shape, np.uint16)
    for number, page in enumerate(pages):
        counts[number] = np.concatenate([*_values(page)]).reshape(page.shape)[rows]
        release()
    _recording.check_byte_order(counts, name)
    _recording.check_present(counts, sorted({v for page in pages for v in page.missing}), name)
    if len({size, *lengths[:-1]}) > 1:
        rule = "Must be parts of one recording, in the order of time, of which the last is shorter"
        sentences.append(f"'{name}' have {[size, *lengths]!s:.60} frames. {rule}.")
    sentences += _recording.copies(counts, paths)
    order = " and ".join(sorted({_recording.ORDERS[page.order] for page in pages}))
    form = "PNG" if pages[0].codec == "png" else "TIFF"
    decided = {"byte_order": order, "byte_order_by": "header", "format": form}
    if any(_SIMULATED.search(page.description) for page in pages):
        decided["origin"] = "simulated"
    return _recording.clocked(counts, seconds, name, *sentences, **decided)


def _times(pages: "list[_Page]", clock: Clock | None, name: str) -> tuple[Array, list[str]]:
    """Seconds by the clock, or else by pages or a description, which must agree; sentences."""
    text, frames = pages[0].description, len(pages)
    span = np.ptp(moments := np.array([page.moment for page in pages]))
    unit = (_TIME_UNIT.findall(text) or ["s"])[0]
    interval, rate = (float((form.findall(text) or [0])[0]) for form in (_INTERVAL, _RATE))
    times = np.array(_TIMES.findall(text), dtype=np.float64)
    times = times if times.size == frames else np.multiply(interval, np.arange(frames))
    if span > 0.0 and moments.size == frames and np.any(moments % 1.0):  # finer than seconds
        times, unit = moments, "s"
    if times.any():
        stated = _recording.check_times(times, unit, clock, name)
        return _recording.stamps(stated if clock is None else clock, frames, name), []
    seconds = _recording.stamps(clock, frames, name)
    sentences = _recording.another_rate(rate, seconds, name)
    if span > 0.0 and abs(span - seconds[-1]) > 1.0:
        label = f"The dates of '{name}' span {span:g} s, by clock= {seconds[-1]:.3g} s"
        sentences.append(f"{label}. Must be the rate of recording.")
    return seconds, sentences


class _Page(NamedTuple):
    """Image in a file: shape (y, x), byte order, and spans (place, length) [byte]."""

    path: Path
    shape: tuple[int, int]
    order: str
    spans: list[tuple[int, int]]
    missing: list[float]
    codec: str = ""
    rows: int = 0  # of a span, where they are compressed
    tile: int = 0  # columns of a tile, of which a row of images is made; 0 of strips
    differences: bool = False  # from column to column
    description: str = ""
    moment: float = np.nan  # by Micro-Manager or a date [s]


def _values(page: _Page) -> Iterator[Counts]:
    """Yield the counts of the spans of a page; what is compressed must be of the right length."""
    if page.codec == "png":
        yield _recording.png(page.path.read_bytes(), f"'{page.path.name}'").ravel()
        return
    width, row = page.tile or page.shape[1], list[Counts]()  # of tiles that lie side by side
    across = -(-page.shape[1] // width)
    for number, (start, length) in enumerate(page.spans):
        if not page.codec and not page.tile:
            yield np.fromfile(page.path, f"{page.order}u2", length // 2, offset=start)
            continue
        content = np.fromfile(page.path, np.uint8, length, offset=start).tobytes()
        rest = page.shape[0] - number // across * page.rows
        rows = page.rows if page.tile else min(page.rows, rest)
        size = 2 * rows * width
        if page.codec:
            codecs = _recording.optional("imagecodecs", "recordings")
            decode = getattr(codecs, f"{page.codec}_decode")
            with _recording.damage_named(f"Damaged TIFF '{page.path.name}'", f"whole {page.codec}"):
                content = decode(content, out=size + 1)  # and no more
        if len(content) != size:
            label = f"{len(content)} bytes of a strip or tile of '{page.path.name}'"
            raise ValueError(f"Damaged TIFF: {label}. Must be {size}, as its page states.")
        values = np.frombuffer(content, f"{page.order}u2").reshape(rows, -1)
        row.append(np.cumsum(values, axis=1, dtype=np.uint16) if page.differences else values)
        if len(row) == across:
            yield np.hstack(row)[:rest, : page.shape[1]].ravel()
            row.clear()


def _pages(path: Path) -> list[_Page]:
    """Pages of a file, which must be as many as its description states."""
    if _formats.format_of(path) == "PNG":
        with path.open("rb") as stream:
            rows, columns, _ = _recording.png_size(stream.read(32), f"'{path.name}'")
        return [_Page(path, (rows, columns), ">", [(0, path.stat().st_size)], [], "png")]
    tifffile = _recording.optional("tifffile", "recordings")
    size, pages, total = path.stat().st_size, list[_Page](), 0
    # Complaints that tifffile logs, without an error.
    complaints, log = SimpleQueue[logging.LogRecord](), logging.getLogger("tifffile")
    handler = QueueHandler(complaints)
    handler.setLevel(logging.ERROR)
    log.addHandler(handler)
    try:
        with tifffile.TiffFile(path) as file:
            for number, page in enumerate(file.pages):
                _recording.check_pieces(number + 1, size, f"pages of '{path.name}'")
                pages.append(_page(page, path, file.byteorder, number))
                total += sum(length for _, length in pages[-1].spans)
                total += sum(tag.valuebytecount for tag in page.tags)
                if total > size:  # as of a chain of pages that returns to itself
                    raise ValueError(f"{total} bytes of pixels, tags. Must fit into its {size}.")
            # A description by its writer, and one that tifffile adds to it.
            texts = [str(file.pages[0].description), str(file.pages[0].description1)]
            description, stated = "\n".join(texts), max(map(_stated, texts))
            if stated_unit := _TEMPERATURES.search(description):
                _recording.check_unit(stated_unit.group(1), path.name)
            pages[0] = pages[0]._replace(description=description)
            if not complaints.empty():  # which tifffile logs, and goes on
                raise ValueError(complaints.get().getMessage())
            _check_apart(file, pages)
    except _recording.DAMAGE as error:
        refused = "Must " in str(error)
        state, rule = ("Invalid", "") if refused else ("Damaged", ". Must be a whole TIFF/BigTIFF.")
        raise ValueError(f"{state} TIFF '{path.name}': {error}{rule}") from error
    finally:
        log.removeHandler(handler)
    # Number of the pages, as the description states it.
    packed = pages[0].codec or pages[0].tile
    if len(pages) == 1 and stated > 1 and not packed:  # as ImageJ beyond 4 GB, without gaps
        (start, length), *further = pages[0].spans
        if further or start + stated * length > size:
            label = f"Truncated TIFF '{path.name}': {stated} images of {length} bytes at {start}"
            raise ValueError(f"{label}. Must end within its {size}.")
        _recording.check_pieces(stated, size, f"images of '{path.name}'")
        return [pages[0]._replace(spans=[(start + n * length, length)]) for n in range(stated)]
    if stated not in {0, 1, len(pages)}:  # 1 of a file to which frames were appended
        state = "Truncated" if len(pages) < stated else "Invalid"
        rule = f"Must be the {stated} that its description states, of one band"
        raise ValueError(f"{state} TIFF '{path.name}': {len(pages)} pages. {rule}.")
    return pages


def _check_apart(file: Any, pages: list[_Page]) -> None:
    """Raise ValueError where pixels overlap other pixels, or the tags that describe them."""
    spans = [(start, start + length, True) for page in pages for start, length in page.spans]
    form = file.tiff
    for page in file.pages:
        entries = form.tagnosize + form.tagsize * len(page.tags) + form.offsetsize
        spans.append((page.offset, page.offset + entries, False))
        spans += [(t.valueoffset, t.valueoffset + t.valuebytecount, False) for t in page.tags]
    used, pixels = 8, 8  # bytes before which something lies, and pixels lie
    for start, stop, of_pixels in sorted(spans):
        if start < (used if of_pixels else pixels):
            raise ValueError(f"Overlapping parts at byte {start}. Must lie apart.")
        used, pixels = max(used, stop), max(pixels, stop) if of_pixels else pixels


def _page(page: Any, path: Path, order: str, number: int) -> _Page:
    """Page of tifffile, as one image of uncompressed counts."""
    if page.dtype is not None and page.dtype.kind == "f":
        length = min(page.databytecounts[0], path.stat().st_size) // page.dtype.itemsize
        length = length if page.compression == 1 else 0
        form = page.dtype.newbyteorder(order)
        values = np.fromfile(path, form, length, offset=page.dataoffsets[0])
        values = values[np.isfinite(values)]
        span = f" from {values.min():g} to {values.max():g}" if values.size else ""
        rule = "Must be 16-bit counts, not temperatures: record or export those"
        raise ValueError(f"Invalid values of page {number}, {page.dtype}{span}. {rule}.")
    # Form of the page.
    for key, label, value, rule in _FORM:
        actual = page.tags.valueof(key, 1) if isinstance(key, int) else getattr(page, key)
        if actual != value:
            raise ValueError(f"Invalid {label} {actual} of page {number}. Must be {rule}.")
    codec, predictor = _CODECS.get(int(page.compression)), int(page.predictor)
    if codec is None or predictor > 2:
        label = f"compression {page.compression} with predictor {predictor} of page {number}"
        raise ValueError(f"Invalid {label}. Must be none, or one without loss: {_LOSSLESS}.")
    # Places of its pixels, joined where they follow one another.
    shape = (int(page.imagelength), int(page.imagewidth))
    _recording.check_pieces(len(page.dataoffsets), 2 * math.prod(shape), f"strips of page {number}")
    spans = list[tuple[int, int]]()
    for start, length in zip(page.dataoffsets, page.databytecounts, strict=True):
        odd = length % 2 and not codec
        if start < 8 or length < 1 or odd or start + length > path.stat().st_size:
            label = f"{length} bytes at {start} of page {number}"
            raise ValueError(f"Truncated: {label}. Must be within {path.stat().st_size}.")
        joined = spans and sum(spans[-1]) == start and not codec and not page.is_tiled
        begun, before = spans.pop() if joined else (start, 0)
        spans.append((int(begun), int(before + length)))
    # Strips or tiles, as many as cover it.
    total, rows = sum(length for _, length in spans), min(int(page.rowsperstrip), shape[0])
    tile, rows = (int(page.tilewidth), int(page.tilelength)) if page.is_tiled else (0, rows)
    if not math.prod(shape) or not (rows if codec or tile else total == 2 * math.prod(shape)):
        raise ValueError(f"Truncated: {total} bytes of page {number}. Must be 2 x {shape}.")
    pieces = -(-shape[0] // rows) * -(-shape[1] // (tile or shape[1]))
    if (codec or tile) and len(spans) != pieces:
        label = f"{len(spans)} strips or tiles of page {number}"
        raise ValueError(f"Truncated: {label}. Must be {pieces} of {rows} rows.")
    if tile and 2 * pieces * rows * tile > (most := max(_TILE, 16 * math.prod(shape))):
        label = f"{pieces} tiles of {rows} x {tile} of page {number}"
        raise ValueError(f"Invalid {label}. Must be at most {most} bytes, of {shape}.")
    form = (codec, rows, tile, predictor == 2)
    about, date = (page.tags.valueof(tag) for tag in ("MicroManagerMetadata", "DateTime"))
    elapsed = about.get("ElapsedTime-ms") if isinstance(about, dict) else None
    moment = _recording.moment(str(date)) if elapsed is None else 1e-3 * float(elapsed)
    return _Page(path, shape, order, spans, _no_data(page, number), *form, moment=moment)


def _no_data(page: Any, number: int) -> list[float]:
    """Values of missing counts, by GDAL's tags; GDAL or ImageJ must not have scaled the page."""
    scaling = _SCALING.findall(str(page.tags.valueof(_METADATA, "")))
    for role, text in scaling + _CALIBRATION.findall(page.description):
        if float(text) not in (neutral := _SCALES.get(role, (0.0,))):
            label = f"{role} {text} of page {number}, by GDAL or ImageJ"
            raise ValueError(f"Invalid {label}. Must be {neutral[0]:g}: counts as measured.")
    return [float(text) for text in str(page.tags.valueof(_NO_DATA, "")).strip("\0").split()]


def _stated(description: str) -> int:
    """Number of images that ImageJ or tifffile wrote into a description, 0 if none is there."""
    stated = _AXES.findall(description)
    axes = [int(size) for *_, size in stated]
    names = "".join((a or b)[0].upper() for a, b, size in stated if int(size) > 1) + "YX"
    names = names.replace("S", "Z").replace("F", "T")  # of ImageJ's slices and frames
    if shaped := description.startswith('{"shape": ['):
        shape = (about := json.loads(description))["shape"]
        axes = shape[:-2] if all(isinstance(size, int) for size in shape) else [0]
        dims = str(about.get("axes", "YX"))
        named = zip(dims[:-2], shape, strict=False)
        names = "".join(name for name, size in named if size != 1) + dims[-2:]
    if sum(size > 1 for size in axes) > 1 or not _OVER_TIME.fullmatch(names):
        rule = "Must be TYX, time, rows, columns: save bands as files, by ImageJ's Split Channels"
        raise ValueError(f"Invalid axes {names} of {axes} images. {rule}.")
    if match := _IMAGEJ.match(description):
        return int(match.group(1))
    return math.prod(axes) if shaped else 0
