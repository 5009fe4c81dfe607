"""Films, maps and regions of a view, read frame by frame from memory, a store, or a computation."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius
from scipy.special import chdtri

from dbthermal import _arrays, _numbers, _text, schema, store
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask, empty, on_disk, quotient, release

Values = npt.NDArray[np.float32]
Progress = Callable[[str, float], object]
Kind = Literal["rectangle", "ellipse", "polygon"]

FILMS: Final = {
    "object_temperature": "object temperature",
    "background_temperature": "reflected temperature",
}
_LEAST_PAIRS: Final = 12  # pairs of neighbours that give the share of independent errors
_LARGEST_SHARE: Final = 2.0  # of independent errors in the variance; beyond, the material differs
_FEW: Final = 4  # parts of the image, of which one is copied by itself
_LEAST: Final = {"rectangle": (2, 2), "ellipse": (2, 2), "polygon": (3, 1000)}


@dataclass(frozen=True, eq=False)
class Pane:
    """Picture of one quantity."""

    name: str  # in `View.panes`
    label: str  # title
    units: str  # of the values
    array: xr.DataArray  # values (time, y, x) or (y, x), in memory or lazy
    absolute: bool = False  # temperature, also shown in degrees Celsius; not a difference
    std: str = ""  # pane of its standard deviation; empty without one
    curve: responses.Curve | None = None  # response, for counts shown as apparent temperatures

    @property
    def kind(self) -> Literal["film", "map", "status"]:
        """Film (time, y, x), map (y, x), or the map of the status."""
        if self.name == "status":
            return "status"
        return "film" if self.array.ndim == 3 else "map"

    def unit(self, *, celsius: bool) -> tuple[str, float]:
        """Unit of the shown values, and the offset that is subtracted."""
        if self.absolute and _numbers.truth_value("celsius", celsius):
            return "\N{DEGREE SIGN}C", zero_Celsius
        return self.units, 0.0

    @cached_property
    def _source(self) -> npt.NDArray[Any]:
        """Values that are indexed: those in memory, or the copy of `stage`."""
        return self.array.values if self.array.ndim == 3 else self.array.values[None]

    def stage(self, progress: Progress | None = None) -> None:
        """Copy a film that is not in memory into a temporary file, chunk by chunk."""
        array = self.array
        if "_source" in vars(self) or array.ndim < 3 or array.variable._in_memory:
            return
        with on_disk(Path(gettempdir())):
            copy = empty(array.shape, array.dtype)
        height = array.encoding.get("preferred_chunks", {}).get("y", 1)
        for block in _arrays.blocks(array.shape, max(1, height * array.size // array.shape[1])):
            copy[:, block] = array.isel(y=block).values
            if progress is not None:
                progress(f"reading {self.label}", block.stop / array.shape[1])
            release()
        vars(self)["_source"] = copy

    def cut(self, box: tuple[slice, ...], progress: Progress | None) -> "Pane":
        """Pane of some rows and columns: if they are few, no more of a film is copied."""
        pane = replace(self, array=self.array.isel(y=box[0], x=box[1]))
        if "_source" in vars(self) or _FEW * pane.array.size > self.array.size:
            self.stage(progress)
            vars(pane)["_source"] = self._source[:, *box]
        return pane

    def read(
        self, frames: slice, rows: slice = slice(None), columns: slice = slice(None)
    ) -> Values:
        """Values (time, y, x), float32; of a map one frame."""
        self.stage()
        values = self._source[frames if self.array.ndim == 3 else slice(None), rows, columns]
        if self.curve is not None:
            return np.asarray(self.curve.inverse(values), dtype=np.float32)
        return np.asarray(values, dtype=np.float32)


def opened(data: xr.Dataset | str | Path, label: str) -> xr.Dataset:
    """Dataset, opened if it is the path of a store."""
    schema.require(data, (xr.Dataset, str, Path), label)
    return data if isinstance(data, xr.Dataset) else store.open_dataset(data)


def result_panes(data: xr.Dataset) -> Iterator[Pane]:
    """Yield the panes of a result, in the order in which they are shown."""
    if "object_temperature" not in data:
        label = f"Missing variable 'object_temperature'. Has {sorted(map(str, data))}"
        raise ValueError(f"{label}. Must be a result of separation, or a capture with 'counts'.")
    film = data["object_temperature"]
    variables = {**schema.STAGES["separated"], **schema.OPTIONAL["separated"]}
    for name in (name for name in variables if name in data):
        schema.check_variable(data[name], variables[name], f"'{name}' of the result")
        schema.laid_on(data[name], film, f"'{name}'", "the object temperature")
    schema.check_kelvin(data)
    # What is estimated, then its deviations: a film each, or a map a band.
    missing = str(data.attrs.get("not_estimated", "")).split()
    stds = [f"{name}_std" for name in (*FILMS, "emissivity") if name not in missing]
    for name in (name for name in [*FILMS, "emissivity", *stds] if name in data):
        base = name.removesuffix("_std")
        if name in missing or base not in data:
            continue
        words = FILMS.get(base, base) + (", deviation" if name != base else "")
        has_std = name == base and f"{name}_std" in data and f"{name}_std" not in missing
        std = f"{name}_std" if has_std else ""
        if base in FILMS:
            yield Pane(name, words, "K", data[name], absolute=name == base, std=std)
            continue
        for place, band in enumerate(map(str, data[name]["band"].values)):
            title, image = f"{band} \N{MICRO SIGN}m {words}", data[name].isel(band=place)
            yield Pane(f"{name} {band}", title, "1", image, std=std and f"{std} {band}")
    if "status" in data:
        yield Pane("status", "status", "1", data["status"])


def input_panes(
    capture: xr.Dataset, response: xr.Dataset | None, reference: xr.Dataset | xr.DataArray | None
) -> Iterator[Pane]:
    """Yield the bands of a capture, as apparent temperatures if there is a response."""
    if "counts" in capture and "band" not in capture["counts"].dims:  # of one camera
        schema.check(capture, "recording", ("counts",), "the capture")
        yield Pane("input", "input", "count", capture["counts"])
        return
    counts = schema.check(capture, "capture")["counts"]
    if reference is not None and reference is not capture:
        counts = schema.laid_on(counts, reference, "the capture", "the result")
    for place, band in enumerate(map(str, counts["band"].values)):
        film, label = counts.isel(band=place), f"{band} \N{MICRO SIGN}m input"
        curve = None if response is None else responses.curve(response, band)
        form: Any = {"absolute": curve is not None, "curve": curve}
        yield Pane(f"input {band}", label, "count" if curve is None else "K", film, **form)


def marks(capture: xr.Dataset, time: Array) -> dict[str, float]:
    """Times [s] of shutter events of a capture, and of the first of flagged frames, by name."""
    marked: dict[str, Mask] = {}
    if "segment" in capture:
        marked["shutter event"] = np.asarray(np.diff(capture["segment"].values, prepend=0) > 0)
    if "frame_flags" in capture:
        flags = capture["frame_flags"]
        for name in str(flags.attrs.get("flag_meanings", "")).split():
            dims = [dim for dim in flags.dims if dim != "time"]
            marked[name.replace("_", " ")] = schema.has_flag(flags, name).any(dims).values
    events = {}
    for name, where in marked.items():
        begins = np.flatnonzero(where & ~np.roll(np.append(where, False), 1)[:-1])
        events.update({f"{name} {i}": float(time[at]) for i, at in enumerate(begins, 1)})
    return events


@dataclass(frozen=True)
class Region:
    """Part of the image: the pixels whose centres lie inside an outline.

    Attributes
    ----------
    kind : {"rectangle", "ellipse", "polygon"}
        Form of the outline.
    points : tuple of (float, float)
        (row, column) of two opposite corners, of an ellipse those of the rectangle around it, or of
        the corners of a polygon in order [pixel]. Pixel (i, j) covers i to i + 1 and j to j + 1.
        ValueError if they are too few, or not finite.

    Examples
    --------
    >>> Region("rectangle", ((1, 2), (3, 5))).mask((4, 6)).sum()
    np.int64(6)
    """

    kind: Kind
    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        _text.check_listed("Unknown kind of region", self.kind, _LEAST)
        points = _numbers.real_numbers(f"points of a {self.kind}", self.points, _numbers.FINITE)
        if points.shape[1:] != (2,):
            label = f"Invalid points {self.points!r} of a {self.kind}"
            raise ValueError(f"{label}. Must be pairs (row, column).")
        least, limit = _LEAST[self.kind]
        if not least <= len(points) <= max(least, limit):
            count = least if self.kind != "polygon" else f"{least} to {limit}"
            raise ValueError(f"Invalid {len(points)} points of a {self.kind}. Must be {count}.")
        object.__setattr__(self, "points", tuple(map(tuple, points.tolist())))

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Mask (y, x) of the pixels of an image of so many rows and columns."""
        rows, columns = np.ogrid[0.5 : shape[0], 0.5 : shape[1]]
        outline = np.array(self.points)
        if self.kind == "polygon":  # a ray along the row crosses it an odd number of times
            odd = np.zeros(shape, dtype=bool)
            for (row, column), (end, far) in zip(outline, np.roll(outline, -1, 0), strict=True):
                spanned = ((row <= rows) != (end <= rows))[:, 0]
                if spanned.any():
                    along = (rows[spanned] - row) / (end - row)
                    odd[spanned] ^= columns < column + along * (far - column)
            return odd
        (top, first), (bottom, last) = outline.min(axis=0), outline.max(axis=0)
        if self.kind == "rectangle":
            within = (top <= rows) & (rows < bottom) & (first <= columns) & (columns < last)
        elif top == bottom or first == last:
            within = np.zeros(shape, dtype=bool)
        else:  # distances from the middle, in half axes
            down = (2.0 * rows - top - bottom) / (bottom - top)
            within = down**2 + ((2.0 * columns - first - last) / (last - first)) ** 2 <= 1.0
        return np.asarray(within)


def common_gain(emissivity: Array, covariance: Array) -> Array:
    r"""Common deviation of object and background (2, y, x) by emissivities, for 1 K contrast [1].

    Errors :math:`\delta e` of the emissivities (band, y, x) with a covariance (band, band, y, x)
    keep the image formation :math:`e_b x + (1 - e_b) y` if

    .. math:: e_b\,\delta x + (1 - e_b)\,\delta y = -(x - y)\,\delta e_b

    which has, by least squares, the solution :math:`\delta x = -(x - y)\,g\,\delta e` of variance
    v. Neighbours i, j differ by independent errors alone, whose share :math:`\rho` follows from the
    median over the region,

    .. math:: \operatorname{med} (g e_i - g e_j)^2 / (v_i + v_j) = 0.455 \rho
    """
    finite = np.isfinite(emissivity).all(axis=0) & np.isfinite(covariance).all(axis=(0, 1))
    # Any system that can be inverted stands in for a pixel without a value.
    default = np.linspace(0.4, 0.6, len(emissivity))[:, np.newaxis, np.newaxis]
    value = np.where(finite, emissivity, default)
    # v = g cov(e) g^T, with g of the pseudoinverse of (e_b, 1 - e_b)
    system = np.moveaxis(np.stack([value, 1.0 - value], axis=-1), 0, 2)  # (y, x, band, 2)
    inverse = np.linalg.pinv(system)  # (y, x, 2, band)
    variance = np.einsum("yxib,bcyx,yxic->iyx", inverse, covariance, inverse)
    variance = np.where(finite, np.maximum(variance, 0.0), np.nan)
    # Squared steps from neighbour to neighbour, over the variance of independent errors.
    ratios = []
    for axis in (0, 1):
        first, second = np.delete(inverse, -1, axis), np.delete(inverse, 0, axis)
        step = np.einsum("yxib,byx->iyx", first + second, np.diff(value, axis=1 + axis)) / 2.0
        total = np.delete(variance, -1, 1 + axis) + np.delete(variance, 0, 1 + axis)
        ratios.append(np.reshape(quotient(step**2, total, np.nan), (2, -1)))
    pairs = np.concatenate(ratios, axis=1)
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    residual_share = np.zeros(2)  # as of pooled or stated emissivities, also for few pairs
    if pairs.shape[1] >= _LEAST_PAIRS:
        residual_share = np.median(pairs, axis=1) / chdtri(1, 0.5)
    # Steps larger than the deviations are of the material: then all of the error is common.
    shared = np.where(residual_share < _LARGEST_SHARE, 1.0 - np.minimum(residual_share, 1.0), 1.0)
    return np.asarray(np.sqrt(shared[:, np.newaxis, np.newaxis] * variance))


def mean_std(std: Array, common: Array) -> Array:
    """Standard deviation (time) of a mean over pixels with a common part, see `View.curve`."""
    # s^2 = (sum_i c_i / n)^2 + sum_i (s_i^2 - c_i^2) / n^2
    shared = np.where(np.isfinite(common), np.minimum(common, std), std)
    number = np.maximum(np.isfinite(std).sum(axis=-1), 1)
    independent = np.nansum(std**2 - shared**2, axis=-1) / number**2
    result = np.sqrt((np.nansum(shared, axis=-1) / number) ** 2 + independent)
    return np.asarray(np.where(np.isfinite(std).any(axis=-1), result, np.nan))


def statistics(values: npt.NDArray[np.floating]) -> dict[str, Array]:
    """Mean, least and greatest value (time), and number of valid pixels, of (time, pixel)."""
    finite = np.isfinite(values)
    number = finite.sum(axis=-1)
    total = np.sum(values, axis=-1, where=finite, dtype=np.float64)
    counted = number > 0
    return {
        "mean": np.divide(total, number, out=np.full(len(values), np.nan), where=counted),
        "minimum": np.where(counted, values.min(axis=-1, initial=np.inf, where=finite), np.nan),
        "maximum": np.where(counted, values.max(axis=-1, initial=-np.inf, where=finite), np.nan),
        "pixels": number,
    }
