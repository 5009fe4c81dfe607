"""Counts that other programs wrote: TIFF stacks and bare numbers, which tell little else."""

import json
import logging
import math
import re
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

from dbthermal._arrays import empty, parts
from dbthermal.readers import _recording as recordings
from dbthermal.readers._recording import MEMORY, Clock, Paths

# What a page must say: the attribute of tifffile's page, or the tag, which is 1 where it is
# missing; its name in messages, and the value.
_FORM: Final = (
    ("compression", "compression", 1, "none: save it uncompressed"),
    ("bitspersample", "bits of a pixel", 16, "16: counts, not a picture"),
    ("sampleformat", "sample format", 1, "1: whole numbers from 0, counts and no temperatures"),
    ("samplesperpixel", "values of a pixel", 1, "1: counts, not colours"),
    ("fillorder", "order of bits", 1, "1: the highest bit first"),
    ("is_tiled", "tiled pages", False, "False: save it in strips"),
    (262, "photometric interpretation", 1, "1: more counts are whiter"),
    (274, "orientation", 1, "1: rows from the top, columns from the left; save it upright"),
)
_METADATA, _NO_DATA = 42112, 42113  # tags of GDAL
_SCALING: Final = re.compile(r"<Item\b[^<>]{0,200}\brole=.(scale|offset).[^<>]{0,200}>([^<]*)")
_FIRST: Final = 8  # frames that tell rows from columns
_ORDERS: Final = {"<": "little", ">": "big"}
# A unit of the values in a description: as ImageJ, and as JSON, write it.
_TEMPERATURES: Final = re.compile(
    r"""(?im)\b(?:v|value[ _]?)?units?["']?\s*[:=]\s*["']?(?:[0-9./]+ ?)?"""
    r"""([cm]?K|C|(?:centi|milli)?kelvins?|(?:deg\w*|\N{DEGREE SIGN})?[ _]*(?:C|celsius))\b"""
)
_IMAGEJ: Final = re.compile(r"\AImageJ=.*?^images=([0-9]{1,9})$", re.DOTALL | re.MULTILINE)

# Numbers of images along axes, as ImageJ and OME write them.
_AXES: Final = re.compile(
    r"""(?:^(channels|slices|frames)=|\bSize([CZT])=")([0-9]{1,9})""", re.MULTILINE
)
_OVER_TIME: Final = re.compile("[TZIQ]?YX")  # axes as tifffile names them; slices are ImageJ's own


def tiff(path: Paths, *, unit: str, clock: Clock, memory: float = MEMORY) -> xr.Dataset:
    """Counts of a TIFF or BigTIFF stack, or of one file a frame, in 16 bits.

    TIFF tells neither the unit nor the time of its frames, so both must be stated.

    Parameters
    ----------
    path : str, Path or sequence
        Regular file of one page or many, or the files of one recording in the order of time; the
        numbers in their names must rise.
    unit : {"count"}
        Unit of the pixels. Temperatures, also as whole numbers (temperature-linear data), are
        refused: the camera made them with an emissivity, and mixtures add up in counts only.
    clock : float or array_like
        Frame rate [Hz] or time of each frame [s].
    memory : float
        Largest memory that the counts may take [byte]; refused before it is taken.

    Returns
    -------
    Dataset
        `counts` (time, y, x) [count], uint16, `exposure_time` and `frame_flags` (time), as from
        `flir`; attributes ``source``, ``format``, ``byte_order``.

    Raises
    ------
    OSError, ImportError
        If a file cannot be opened, or tifffile, the extra ``recordings``, is not installed.
    ValueError
        If the unit is another one; a file is no TIFF, damaged, has fewer pages than it states, two
        bands in one, or axes that are not time, rows, columns; a page is compressed, in tiles, in
        colours or not of 16 bits, or differs in size; it is mirrored, rotated, scaled (GDAL), or
        white where it is 0; counts are those of no data, take too much memory or have 8 bits; or
        the clock does not fit.
    TypeError
        If clock, memory or a header are no numbers.

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
    paths = recordings.files(path)
    name = recordings.label(paths)
    recordings.check_unit(unit, name)
    # Pages of one size, and the memory that they take.
    pages = [page for file in paths for page in _pages(file)]
    for page in pages:
        if page.shape != pages[0].shape:
            label = f"Invalid page of {page.shape} in '{page.path.name}'"
            raise ValueError(f"{label}. Must be {pages[0].shape}, as the first.")
    shape = (sum(page.images for page in pages), *pages[0].shape)
    recordings.check_memory(shape, memory, name)
    # Their pixels, from the places that the pages state.
    counts, at = empty(shape, np.uint16), 0
    values = counts.reshape(-1)
    for page in pages:
        for offset, length in page.spans:
            span = values[at : at + length // 2]
            for part in parts(span):
                place = offset + 2 * part.start
                span[part] = np.fromfile(
                    page.path, f"{page.order}u2", span[part].size, offset=place
                )
            at += length // 2
    recordings.check_present(counts, sorted({v for page in pages for v in page.missing}), name)
    order = " and ".join(sorted({_ORDERS[page.order] for page in pages}))
    decided = {"byte_order": order, "byte_order_by": "header"}
    return recordings.clocked(counts, clock, name, format="TIFF", **decided)


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
    fit the size of the file without remainder, and an image that is smoother with its bytes
    swapped, or rows and columns exchanged, is refused.

    Parameters
    ----------
    path : str or Path
        Regular file.
    shape : (int, int)
        Rows and columns of a frame [pixel].
    byte_order : {"little", "big"}
        Order of the bytes of a number.
    unit, clock, memory
        As for `tiff`.
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
    (file,) = recordings.files([path])
    name = file.name
    recordings.check_unit(unit, name)
    # Form, as stated.
    order = recordings.byte_order(name, byte_order)
    for label, value in {"header": header, "frame_header": frame_header}.items():
        recordings.check_number(value, f"{label} of '{name}'", whole=True)
        if value < 0:
            raise ValueError(f"Invalid {label} {value} of '{name}'. Must be 0 or more.")
    sizes = np.asarray(shape)
    if sizes.shape != (2,) or sizes.dtype.kind not in "iu" or sizes.min() < 1:
        rule = "Must be rows and columns, two whole numbers"
        raise ValueError(f"Invalid shape {shape} of '{name}'. {rule}.")
    # Size of the file, which the form must fill.
    frame = frame_header + 2 * shape[0] * shape[1]
    frames, remainder = divmod(file.stat().st_size - header, frame)
    if frames < 1 or remainder:
        label = f"{file.stat().st_size} bytes of '{name}': {frames} frames and {remainder} bytes"
        rule = f"Must be {header} + a whole number of {frame}, as shape and headers state"
        raise ValueError(f"Invalid size {label}. {rule}.")
    recordings.check_memory((frames, *shape), memory, name)
    # Counts, whose images must be smooth in that form.
    form = np.dtype([("header", f"V{frame_header}"), ("counts", f"{order}u2", shape)])
    counts = recordings.film(np.memmap(file, form, "r", offset=header)["counts"])
    if recordings.smoother(counts) < 0:
        rule = "Must be the other byte order, or another shape or header"
        raise ValueError(f"Invalid counts of '{name}': rougher than with bytes swapped. {rule}.")
    if recordings.smoother(counts[:_FIRST], lambda frame: frame.reshape(shape[::-1])) < 0:
        rule = "Must be rows, then columns"
        raise ValueError(f"Invalid shape {shape} of '{name}': rougher than {shape[::-1]}. {rule}.")
    decided = {"byte_order": byte_order, "byte_order_by": "caller"}
    return recordings.clocked(counts, clock, name, format="raw", **decided)


class _Page(NamedTuple):
    """Images in a file: shape (y, x), number, byte order, and spans (place, length) [byte]."""

    path: Path
    shape: tuple[int, int]
    images: int
    order: str
    spans: list[tuple[int, int]]
    missing: list[float]


def _pages(path: Path) -> list[_Page]:
    """Pages of a file, which must be as many as its description states."""
    tifffile = recordings.optional("tifffile", "recordings")
    size, pages, total = path.stat().st_size, list[_Page](), 0
    # Complaints that tifffile logs, without an error.
    complaints, log = SimpleQueue[logging.LogRecord](), logging.getLogger("tifffile")
    handler = QueueHandler(complaints)
    handler.setLevel(logging.ERROR)
    log.addHandler(handler)
    try:
        with tifffile.TiffFile(path) as file:
            for number, page in enumerate(file.pages):
                pages.append(_page(page, path, file.byteorder, number))
                total += sum(length for _, length in pages[-1].spans)
                if total > size:  # as of a chain of pages that returns to itself
                    raise ValueError(f"{total} bytes of pixels. Must fit into its {size}.")
            description = str(file.pages[0].description)
            if stated_unit := _TEMPERATURES.search(description):
                recordings.check_unit(stated_unit.group(1), path.name)
            stated = _stated(description)
            if not complaints.empty():  # which tifffile logs, and goes on
                raise ValueError(complaints.get().getMessage())
            _check_apart(file, pages)
    except recordings.DAMAGE as error:
        refused = "Must " in str(error)
        state, rule = ("Invalid", "") if refused else ("Damaged", ". Must be whole, or BigTIFF.")
        raise ValueError(f"{state} TIFF '{path.name}': {error}{rule}") from error
    finally:
        log.removeHandler(handler)
    # Number of the pages, as the description states it.
    if len(pages) == 1 and stated > 1:  # one page for a stack without gaps: ImageJ beyond 4 GB
        (start, length), *further = pages[0].spans
        if further or start + stated * length > size:
            label = f"Truncated TIFF '{path.name}': {stated} images of {length} bytes at {start}"
            raise ValueError(f"{label}. Must end within its {size}.")
        return [pages[0]._replace(images=stated, spans=[(start, stated * length)])]
    if stated not in {0, len(pages)}:
        label = f"Truncated TIFF '{path.name}': {len(pages)} pages"
        raise ValueError(f"{label}. Must be the {stated} that its description states.")
    return pages


def _check_apart(file: Any, pages: list[_Page]) -> None:
    """Raise ValueError where pixels lie over others, or over what describes them."""
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
    if page.compression == 1 and page.dtype is not None and page.dtype.kind == "f":
        length = min(page.databytecounts[0], path.stat().st_size) // page.dtype.itemsize
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
    # Places of its pixels, joined where they follow one another.
    shape = (int(page.imagelength), int(page.imagewidth))
    spans = list[tuple[int, int]]()
    for start, length in zip(page.dataoffsets, page.databytecounts, strict=True):
        if start < 8 or length < 1 or length % 2 or start + length > path.stat().st_size:
            label = f"{length} bytes at {start} of page {number}"
            raise ValueError(f"Truncated: {label}. Must be within {path.stat().st_size}.")
        begun, before = spans.pop() if spans and sum(spans[-1]) == start else (start, 0)
        spans.append((int(begun), int(before + length)))
    total = sum(length for _, length in spans)
    if not shape[0] * shape[1] or total != 2 * shape[0] * shape[1]:
        raise ValueError(f"Truncated: {total} bytes of page {number}. Must be 2 x {shape}.")
    return _Page(path, shape, 1, order, spans, _no_data(page, number))


def _no_data(page: Any, number: int) -> list[float]:
    """Values of missing counts, by GDAL's tags of a page, which must say that it is not scaled."""
    for role, text in _SCALING.findall(str(page.tags.valueof(_METADATA, ""))):
        if float(text) != (neutral := float(role == "scale")):
            label = f"GDAL {role} {text} of page {number}"
            raise ValueError(f"Invalid {label}. Must be {neutral:g}: counts as measured.")
    return [float(text) for text in str(page.tags.valueof(_NO_DATA, "")).strip("\0").split()]


def _stated(description: str) -> int:
    """Number of images that ImageJ or tifffile wrote into a description, 0 if none is there."""
    stated = _AXES.findall(description)
    axes = [int(size) for *_, size in stated]
    names = "".join((a or b)[0].upper() for a, b, size in stated if int(size) > 1) + "YX"
    names = names.replace("S", "Z").replace("F", "T")  # of ImageJ's slices and frames
    if shaped := description.startswith('{"shape": ['):
        about = json.loads(description)
        shape = about["shape"]
        axes = shape[:-2] if all(isinstance(size, int) for size in shape) else [0]
        dims = str(about.get("axes", "YX"))
        named = zip(dims[:-2], shape, strict=False)
        names = "".join(name for name, size in named if size != 1) + dims[-2:]
    if sum(size > 1 for size in axes) > 1:
        raise ValueError(f"Invalid axes of {axes} images. Must be one, time: a band is a file.")
    if not _OVER_TIME.fullmatch(names):
        rule = "Must be TYX, time, rows and columns: a band is a file"
        raise ValueError(f"Invalid axes {names} of the images. {rule}.")
    if match := _IMAGEJ.match(description):
        return int(match.group(1))
    return math.prod(axes) if shaped else 0
