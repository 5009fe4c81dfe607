"""Tiles of a capture: the inputs of each, cut out of the capture, and the estimate that it yields.

A capture is read in blocks of rows and separated a few hundred pixels at a time, so that a tile
fits in the processor's cache. A tile's bands are in the order of their noise, the quietest first:
the regression for the emissivity needs a quiet ordinate.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import mixing, schema
from dbthermal._arrays import select
from dbthermal._samples import Grain
from dbthermal.response import Curve
from dbthermal.schema import Status
from dbthermal.separation import _quality as quality
from dbthermal.separation._apart import displaced
from dbthermal.separation._inputs import Inputs, Method
from dbthermal.separation._quality import Bits, status_bits

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
Window = tuple[slice, slice]
"""Rows and columns of a tile in the image."""
Patch = tuple[Window, Whole, slice, slice | Whole]
"""A window, and its pixels: numbers in the image, places among those read, and in the window."""

KEPT_ATTRS: Final = ("origin", "radiometric", "source", "twin")
"""Attributes of a capture that its result has, too."""

PIXELS: Final = 320
"""Pixels in a tile, unless a method sets its own number."""

# Samples of a band in a tile, at most: with more, 30,000 frames take 1.3 times as long.
_SAMPLES: Final = 2**19
_COMPILED: Final = 8  # times as many pixels in a tile of a compiled method
# Samples of a band that are resampled at once: few rows would mostly read those around them.
_BLOCK_SAMPLES: Final = 2**23
_NOISE_STEP: Final = 0.05  # resampled samples whose noise differs by less are separated together
RANGE_SIGMAS: Final = 5.0  # standard deviations beyond the calibrated range that are flagged
USELESS: Final = 1e6  # temperature [K], emissivity [1] or deviation beyond which is no result
BROKEN: Final = np.uint32(Status.OBJECT_NOT_SMOOTH | Status.BANDS_APART)
"""Flags of a model that does not hold: the pixel tells nothing of its material."""
LOW, LEAST_MEAN = np.uint32(Status.ROLES_MAY_BE_SWAPPED), 0.5
"""Flag of low emissivities, and the mean of the bands below which they are."""

# In simulated worlds 92 and 96 % of 24 materials hold by 12 and 16, 79 by 4, 88 by 8 or 32.
SPANS: Final = 16
"""Spans of time that each tell an emissivity's error."""

_MAPS: Final = ("emissivity", "reflection_ratio")
WITHOUT_STD: Final = ("object_temperature_std", "background_temperature_std", "emissivity_std")
"""Variables that a method without standard deviations never estimates."""
WITHOUT_BACKGROUND: Final = (*WITHOUT_STD, "background_temperature")
"""Variables that a method which neglects the background never estimates."""


@dataclass(frozen=True)
class Pixels:
    """A record of arrays and records, optional ones among them, whose last axis is the pixel."""

    def select_pixels(self, selected: Mask | Whole) -> Self:
        arrays: dict[str, Any] = {}
        for name, value in vars(self).items():
            within = value.select_pixels(selected) if isinstance(value, Pixels) else value
            arrays[name] = select(value, selected) if isinstance(value, np.ndarray) else within
        return replace(self, **arrays)

    def replace_pixels(self, selected: Mask | Whole, record: Self) -> None:
        """Replace the selected pixels by those of a record, in order, in place."""
        for field in fields(self):
            value, values = getattr(self, field.name), getattr(record, field.name)
            if isinstance(value, Pixels):
                value.replace_pixels(selected, values)
            elif value is not None:
                value[..., selected] = values


@dataclass(frozen=True)
class Material(Pixels):
    """Reflection ratios and emissivity of each pixel by its material; NaN for others."""

    ratio: Array  # reflection ratios (band, pixel) [1]
    inverse_energy: Array  # their variance, see `ReflectionRatio` (pixel) [1/K^2]
    emissivity: Array  # of the first band (pixel) [1]
    noise_variance: Array  # its variance from the noise, NaN of a guess (pixel) [1]
    drift_variance: Array  # its variance from the background's slow part (pixel) [1]
    spread: Array  # variance of single pixels' ratios about these, as `inverse_energy` (pixel)

    @classmethod
    def of_ratios(cls, ratio: Array, inverse_energy: Array, spread: Array | float = 0.0) -> Self:
        """Materials without an emissivity."""
        blank, zeros = np.full(ratio.shape[1], np.nan), np.zeros(ratio.shape[1])
        return cls(ratio, inverse_energy, blank, blank, blank, zeros + spread)


@dataclass(frozen=True)
class Survey(Pixels):
    """Contribution of each pixel to the estimate for its material."""

    scatter: Array  # noise-whitened, of rapid changes, less noise, at the pixel's order and at the
    # two largest ones looked at (3, band, band, pixel) [1]
    frames: Array  # their degrees of freedom, 0 of a pixel that tells nothing (3, pixel)
    ratio: Array  # reflection ratios of the pixel alone (band, pixel) [1]
    null_weights: Array  # see `ReflectionRatio` (band, pixel) [1]
    emissivity: Array  # of the first band, of the pixel alone (pixel) [1]; NaN where undefined
    noise_variance: Array  # its variance from the noise, independent of other pixels' (pixel) [1]
    drift_variance: Array  # its variance from the background, common to all pixels (pixel) [1]
    influence: Array  # of the reflections in each span of time on it (span, pixel) [1]

    @classmethod
    def empty(cls, bands: int, pixels: int) -> Self:
        """Survey of pixels that tell nothing."""
        scatter, frames = np.zeros((3, bands, bands, pixels)), np.zeros((3, pixels))
        vectors, numbers = np.full((2, bands, pixels), np.nan), np.full((3, pixels), np.nan)
        arrays = scatter, frames, *vectors, *numbers, np.zeros((SPANS, pixels))
        return cls(*arrays)


@dataclass(frozen=True)
class Tile:
    """Inputs of one tile: linearised signals, responses, noise, and quantities known beforehand."""

    signals: Array  # less the reference temperature (band, time, pixel) [K], finite
    time: Array  # (time,) [s]
    curves: tuple[Curve, ...]  # response of each band, of one reference temperature
    noise: tuple[float, ...]  # standard deviation of each band's signal at the reference [K]
    shape: tuple[int, int]  # rows and columns; pixels follow one another along the rows
    rng: np.random.Generator  # the tile's own source of random starts
    pattern: tuple[float, ...] = ()  # residual fixed pattern of each band [K], empty without
    gain: Array | None = None  # noise of the bands after the first over that (pixel) [1]
    segment: Whole | None = None  # number of shutter events before each frame (time,)
    material: Material | None = None
    emissivity: Array | None = None  # known beforehand (band, pixel) [1]
    emissivity_covariance: Array | None = None  # (band, band, pixel) [1]
    division: Mask | None = None  # frames with which pieces of time begin, if kept (time, pixel)
    surveyed: bool = True  # the estimate's survey is needed

    @property
    def reference(self) -> float:
        """Reference temperature [K] that the signals are relative to."""
        return self.curves[0].reference

    def blackbody(self, band: int, temperature: Array) -> Array:
        """Signal of a blackbody at a temperature [K] in a band, relative to the reference [K]."""
        return self.curves[band].signal(temperature) - self.reference

    def temperature(self, band: int, signal: Array) -> Array:
        """Temperature [K] of the blackbody with a signal [K]; NaN where undefined."""
        return self.curves[band].temperature(signal + self.reference)

    def scaled(self, stds: tuple[float, ...]) -> Array:
        """Standard deviations (band, pixel) [K] of each pixel, of those of the bands."""
        result = np.repeat(np.array(stds)[:, np.newaxis], self.signals.shape[2], axis=1)
        if self.gain is not None:
            result[1:] *= self.gain
        return result

    def mixed(self, emissivity: Array, temperatures: Array) -> Array:
        """Signals (band, time, pixel) [K] of object and background (2, time, pixel) [K]."""
        signals = []
        for band, share in enumerate(emissivity):
            emitted, reflected = (self.blackbody(band, film) for film in temperatures)
            signals.append(mixing.mixed(share, emitted, reflected))
        return np.stack(signals)

    def select_frames(self, selected: Mask) -> "Tile":
        segment = None if self.segment is None else self.segment[selected]
        signals, time = select(self.signals, selected, axis=1), self.time[selected]
        return replace(self, signals=signals, time=time, segment=segment, division=None)

    def select_pixels(self, selected: Mask | Whole) -> "Tile":
        """Return the tile of the selected pixels (pixel) alone, as one row."""
        names = "signals", "gain", "emissivity", "emissivity_covariance", "division"
        present = {name: vars(self)[name] for name in names if vars(self)[name] is not None}
        arrays: dict[str, Any] = {name: select(present[name], selected) for name in present}
        material = None if self.material is None else self.material.select_pixels(selected)
        return replace(self, shape=(1, arrays["signals"].shape[2]), material=material, **arrays)


@dataclass(frozen=True)
class Estimate(Pixels):
    """Estimate of one tile; NaN where a quantity is undefined, with a status bit that says so."""

    object_temperature: Array  # (time, pixel) [K]
    object_temperature_std: Array
    background_temperature: Array  # (time, pixel) [K]
    background_temperature_std: Array
    emissivity: Array  # (band, pixel) [1]
    emissivity_std: Array
    status: Bits  # `schema.Status` (pixel)
    reflection_ratio: Array | None = None  # reflectivity over the first band's (band, pixel) [1]
    reflection_ratio_std: Array | None = None
    emissivity_covariance: Array | None = None  # (band, band, pixel) [1]
    drift_std: Array | None = None  # of the first band's emissivity by the background (pixel) [1]
    survey: Survey | None = None  # for the material, of a method that pools
    division: Mask | None = None  # frames with which pieces of time begin (time, pixel)

    @classmethod
    def without_std(
        cls,
        tile: Tile,
        object_temperature: Array,
        status: Bits,
        emissivity: Array | None = None,
        background_temperature: Array | None = None,
    ) -> "Estimate":
        """Estimate without standard deviations; NaN for quantities that are not passed."""
        missing = np.full_like(object_temperature, np.nan)
        std = np.full((len(tile.curves), status.size), np.nan)
        background = missing if background_temperature is None else background_temperature
        value = std if emissivity is None else emissivity
        return cls(object_temperature, missing, background, missing, value, std, status)

    def replace_scatter(self, order: int, selected: Mask, scatter: Array, frames: Array) -> None:
        """Replace a scatter of a sound survey, and its degrees of freedom (pixel), in place."""
        if self.survey is not None:
            sound = self.survey.frames[0, selected] > 0
            self.survey.scatter[order][..., selected] = np.where(sound, scatter, 0.0)
            self.survey.frames[order, selected] = np.where(sound, frames, 0.0)

    def check_range(self, curve: Curve, *, not_estimated: Collection[str] = ()) -> "Estimate":
        """Flag temperatures outside the calibrated range of a response, and missing values."""
        values: dict[str, Any] = {}
        beyond = np.zeros(self.status.shape, dtype=bool)
        for name in ("object_temperature", "background_temperature", *_MAPS):
            value, std = getattr(self, name), getattr(self, f"{name}_std")
            if value is None or name in not_estimated:
                continue
            precise = (std < USELESS) | (f"{name}_std" in not_estimated)
            # Samples without a useful deviation become NaN; a pixel that is NaN in all samples by
            # another bit gets no further bit.
            lost = ~((np.abs(value) < USELESS) & precise)
            explained = np.all(np.isnan(value), axis=0) & (self.status != 0)
            beyond |= np.any(lost, axis=0) & ~explained
            values[name] = np.where(lost, np.nan, value)
            values[f"{name}_std"] = np.where(lost, np.nan, std)
            if name.endswith("temperature"):
                margin = RANGE_SIGMAS * np.nan_to_num(std, posinf=np.inf)
                outside = (value < curve.lowest - margin) | (value > curve.highest + margin)
                beyond |= np.any(outside, axis=0)
        status = self.status | status_bits({Status.OUTSIDE_RESPONSE: beyond})
        return replace(self, **values, status=status)


Section = tuple[Mask, Mask, Tile]  # frames (time), pixels (pixel), and the tile of these


@dataclass(frozen=True)
class Cut:
    """A window of the image, its data quality, and a tile by set of frames."""

    window: Window
    places: Whole  # numbers of the pixels in the image (pixel)
    status: Bits  # (pixel)
    valid: Mask  # samples of the capture (time, pixel)
    sections: list[Section]


def windows(rows: slice, columns: slice, pixels: int) -> Iterator[Window]:
    """Yield windows of at most so many pixels that cover some rows and columns of an image."""
    width = min(columns.stop - columns.start, pixels)
    height = max(1, pixels // width)
    for top in range(rows.start, rows.stop, height):
        for left in range(columns.start, columns.stop, width):
            lines = slice(top, min(top + height, rows.stop))
            yield lines, slice(left, min(left + width, columns.stop))


def largest(method: Method, settings: Any, capture: xr.Dataset) -> int:
    """Pixels in a tile of a capture, at most."""
    times = _COMPILED if method.compiled else 1
    fitting = max(1, min(times * PIXELS, _SAMPLES // capture.sizes["time"]))
    return int(getattr(settings, "batch", fitting))


def cut(
    inputs: Inputs, rows: slice, material: Material | None = None, wanted: Mask | None = None
) -> Iterator[Cut]:
    """Read rows, and cut all pixels, or those `wanted` in the image (pixel), into tiles."""
    displacement, method = inputs.displacement, inputs.method
    sampled = _sampler(inputs, rows)
    width, frames = inputs.capture.sizes["x"], inputs.capture.sizes["time"]
    limit = largest(method, inputs.settings, inputs.capture)
    size = limit if displacement is None else max(width, _BLOCK_SAMPLES // frames)
    size = (rows.stop - rows.start) * width if method.whole_image else size
    for window in windows(rows, slice(0, width), size):
        selected, patches = _patches(window, width, limit if method.compiled else size, wanted)
        if not patches:
            continue
        # Read the pixels together; judge the samples, and group the pixels by valid frames.
        counts, usable, valid, status, gain = sampled(window, selected)
        for patch, places, span, chosen in patches:
            # A tile's own samples lie together: rows of a large film are far apart in memory.
            signals = np.ascontiguousarray(counts[..., span], dtype=np.float64)
            bridged, flags = np.ascontiguousarray(usable[:, span]), status[span]
            if method.whole_image or method.every_frame:
                sets = quality.common_frames(signals, bridged, flags, method.minimum_frames)
            else:
                sets = list(quality.frame_sets(bridged, flags))
            packed = inputs.division[:, places]
            division = np.unpackbits(packed, axis=0, count=frames).view(bool)
            tile = replace(
                tile_of(inputs, signals, patch, chosen),
                surveyed=displacement is None or wanted is not None,
                gain=gain[1, span] if displacement is not None and method.compiled else None,
                division=division if packed.any() else None,
                material=None if material is None else material.select_pixels(places),
            )
            if inputs.difference is not None:
                tile.signals[1:] -= inputs.difference(places)
            sections = list[Section]()
            for mask, pixels in sets:  # of which there may be many, each of few pixels
                whole = method.whole_image or np.all(pixels)
                section = tile if whole else tile.select_pixels(pixels)
                section = section if np.all(mask) else section.select_frames(mask)
                if displacement is None or method.compiled:
                    sections.append((mask, pixels, section))
                else:
                    sections.extend(of_one_noise(mask, pixels, section, gain[1], limit))
            yield Cut(patch, places, flags, valid[:, span], sections)


def _patches(
    window: Window, width: int, pixels: int, selection: Mask | None
) -> tuple[slice | Whole, list[Patch]]:
    """Pixels of a window that are wanted, and patches of at most so many of them."""
    if selection is None:
        patches, start = list[Patch](), 0
        for patch in windows(*window, pixels):
            places = _numbers(patch, width)
            patches.append((patch, places, slice(start, start + places.size), slice(None)))
            start += places.size
        return slice(None), patches
    places = _numbers(window, width)
    selected = np.flatnonzero(selection[places])
    spans = [slice(start, start + pixels) for start in range(0, selected.size, pixels)]
    return selected, [(window, places[selected[span]], span, selected[span]) for span in spans]


def _numbers(window: Window, width: int) -> Whole:
    """Numbers of the pixels of a window in the image."""
    lines, columns = (np.arange(span.start, span.stop) for span in window)
    return np.add.outer(lines * width, columns).ravel()


def read(inputs: Inputs, rows: slice) -> tuple[Array, Mask, Mask, Array]:
    """Signals (band, frame, pixel) [K] of some rows; frames (time), pixels, noise (band, pixel)."""
    window = rows, slice(0, inputs.capture.sizes["x"])
    counts, usable, _, status, gain = _sampler(inputs, rows)(window, slice(None))
    # Frames that most pixels have, pixels with all of these; bands from the quietest, noise over
    # that of a sample [1].
    sets = quality.common_frames(counts, usable, status, inputs.method.minimum_frames)
    frames, pixels = sets[0] if sets else (np.ones(len(usable), dtype=bool), status < 0)
    signals = tile_of(inputs, counts, window, slice(None)).signals
    signals = signals if frames.all() else signals[:, frames]  # no copy: a row may be large
    return signals, frames, pixels, gain[[0] + [1] * (len(signals) - 1)]


def _sampler(inputs: Inputs, rows: slice) -> Callable[[Window, slice | Whole], displaced.Paired]:
    """Function that reads some pixels of a window of the rows, as `displaced.paired`."""
    displacement, fewest = inputs.displacement, inputs.method.minimum_frames
    source = rows if displacement is None else displacement.source(rows)
    slopes = np.array([curve.reference_slope for curve in inputs.curves])

    @cache  # and never read where all that is wanted of it is kept
    def load() -> tuple[xr.Dataset, list[Grain]]:
        block = inputs.capture.isel(y=source).load()
        return block, quality.grains(block, inputs.noise * slopes)

    def sampled(window: Window, selected: slice | Whole) -> displaced.Paired:
        if displacement is not None:
            capture, lines = inputs.capture, window[0]
            return displaced.paired(capture, load, displacement, lines, source, selected, fewest)
        block, grains = load()
        inner = slice(window[0].start - rows.start, window[0].stop - rows.start)
        view = block.isel(y=inner, x=window[1])
        if not isinstance(selected, slice):  # as one row
            places = np.divmod(selected[np.newaxis], view.sizes["x"])
            y, x = (xr.DataArray(place, dims=("y", "x")) for place in places)
            view = view.drop_vars(("y", "x"), errors="ignore").isel(y=y, x=x)
        counts, valid, status = quality.read(view, fewest, grains)
        counts, usable = quality.bridge(counts, valid, view["time"].values.astype(np.float64))
        return counts, usable, valid, status, np.ones((2, status.size))

    return sampled


def tile_of(inputs: Inputs, counts: Array, window: Window, selected: slice | Whole) -> Tile:
    """Tile of counts (band, time, pixel) [count], the quietest band first, of some of a window."""
    bands, place = inputs.bands, (window[0].start, window[1].start)
    curves = tuple(inputs.curves[band] for band in bands)
    emissivity, covariance = (
        None
        if values is None
        else values[(..., *window)].reshape(*values.shape[:-2], -1)[..., selected]
        for values in (inputs.emissivity, inputs.emissivity_covariance)
    )
    if emissivity is not None and covariance is not None:
        emissivity, covariance = emissivity[bands], covariance[np.ix_(bands, bands)]
    height = window[0].stop - window[0].start if isinstance(selected, slice) else 1
    # The linearised signals (see `response`), less the reference temperature.
    signals = counts if bands == sorted(bands) else counts[bands]
    for signal, curve in zip(signals, curves, strict=True):
        np.subtract(signal, curve.reference_counts, out=signal)
        np.divide(signal, curve.reference_slope, out=signal)
    return Tile(
        signals=signals,
        time=inputs.capture["time"].values.astype(np.float64),
        curves=curves,
        noise=tuple(inputs.noise[bands].tolist()),
        shape=(height, counts.shape[2] // height),
        rng=np.random.default_rng(np.random.SeedSequence(inputs.seed, spawn_key=place)),
        pattern=tuple(inputs.pattern[bands]),
        segment=schema.segments(inputs.capture),
        emissivity=emissivity,
        emissivity_covariance=covariance,
    )


def of_one_noise(
    frames: Mask, pixels: Mask, tile: Tile, gain: Array, most: int
) -> Iterator[Section]:
    """Yield parts of a tile, of at most so many pixels whose resampled bands have one noise."""
    order = np.rint(np.log(gain[pixels]) / _NOISE_STEP).astype(np.intp)
    for level in np.unique(order):
        members = np.flatnonzero(order == level)
        for start in range(0, members.size, most):
            chosen = members[start : start + most]
            group = np.zeros_like(pixels)
            group[np.flatnonzero(pixels)[chosen]] = True
            factors = np.append(1.0, [np.exp(np.log(gain[group]).mean())] * (len(tile.noise) - 1))
            # A residual pattern is independent from pixel to pixel, and is scaled like the noise.
            noise, pattern = (tuple(factors * stds) for stds in (tile.noise, tile.pattern))
            section = replace(tile.select_pixels(chosen), noise=noise, pattern=pattern)
            yield frames, group, section
