"""Rapid changes of a capture as planes: parts along a few functions of time, one reading each.

And the share of the image in which the bands show such changes displaced, in the image or in time.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import sparse
from scipy.linalg import solveh_banded
from scipy.ndimage import distance_transform_edt
from scipy.special import fdtrc

from dbthermal import _smooth as smooth
from dbthermal import noise as noises
from dbthermal import response as responses
from dbthermal import schema
from dbthermal._arrays import Array, Mask, stride
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import _splines as images
from dbthermal.alignment._offset import noise_levels, sample
from dbthermal.alignment._splines import Movie

SMALLEST: Final = 24  # rows and columns of an image whose bands are matched, at least
_ROWS: Final = 32  # that are read at a time
_COMMON, _MISSING = 0.5, 0.1  # least share of a frame's pixels, largest of a pixel's missing frames
_PIXELS: Final = 1024  # pixels, about, by which valid frames are chosen
# Functions of time: 14 fields of 220 to 300 frames are off by .021 pixel along the baseline (.020
# with 128, of 36 fields 1.2 and 1.4 times as much with 32 and with whole films); and pixels that
# tell each of them.
_PLANES, _FOR_EACH = 96, 8
EVENT: Final = 4  # functions of time of an event, that a field weighs alike
# Of displaced windows: frames, number along either side of the image, and their sides [pixel].
_FRAMES, _ALONG, _SIDES = 400, 8, (8, 16)
_BLUR: Final = 2.0  # before a displacement is looked for [pixel]
# Chance below which, and pixels or frames from which, so many windows or more are displaced.
_CHANCE, _SHIFT, _DELAY, _FEWEST = 1e-3, 0.3, 0.1, 4
# Share of a band's changes that the other does not explain. Of displaced cameras whose shift the
# step does not see: 0.016 to 0.85, in all of 13 scenes above this; at one place 0 to 0.016 in 66 of
# 72, at most 0.066. A search in vain costs time alone.
_UNEXPLAINED: Final = 0.015
_CONTRAST: Final = 3.0  # variance of a window's changes over the noise
# Functions of time, of a smooth object at most, and of what changes rapidly; pixels that tell them.
_ORDER, _RAPID_PLANES, _RAPID_PIXELS = 14, 32, 100
_COMMON_SAMPLES: Final = 0.9  # least share of a pixel's samples, over the largest such share


@dataclass(frozen=True)
class Scale:
    """Slope (band) [count/K] of each band, or another scale of its changes, and its noise."""

    slopes: Array
    noise: Array | None  # before the alignment (band) [K], estimated from the capture if None

    @classmethod
    def of_response(cls, response: xr.Dataset, names: list[str]) -> "Scale":
        """Scale of a response, and of its noise if it states one."""
        slopes = np.array([curve.reference_slope for curve in responses.curves(response, names)])
        noise = responses.noise(response, names) / slopes if "noise" in response else None
        return cls(slopes, noise)

    @classmethod
    def of_changes(cls, corrected: xr.Dataset) -> "Scale":
        """Scale without a response: each band's own changes in time, each on its own clock."""
        scatter, relative = noise_levels(sample(corrected), clocks.exposure_times(corrected))
        if not np.all(relative > 0.0):
            raise ValueError("Missing noise of the capture. Must be seen to match reflections.")
        return cls(scatter / relative, relative / schema.noise_factor(corrected))

    def noise_of(self, corrected: xr.Dataset) -> Array:
        """Noise of a capture (band) [K]."""
        if self.noise is not None:
            return np.asarray(self.noise * schema.noise_factor(corrected))
        signals = sample(corrected)
        frames = np.all(np.isfinite(signals), axis=(0, 2))
        scaled = signals[:, frames] / self.slopes[:, np.newaxis, np.newaxis]
        return noises.estimate_bands([*scaled], corrected["time"].values[frames])


@dataclass(frozen=True)
class Capture:
    """Capture and all that matching needs to know of it, the quietest band first."""

    counts: xr.DataArray
    bands: npt.NDArray[np.intp]  # places in the counts
    slopes: Array  # of the bands [count/K]
    noise: Array  # of the bands [K]
    valid: Mask  # pixels (y, x)
    frames: npt.NDArray[np.intp]  # that every band has
    rough: npt.NDArray[np.intp]  # first of four frames that follow one another evenly

    @classmethod
    def of(cls, corrected: xr.Dataset, scale: Scale) -> "Capture":
        counts = schema.check_corrected(corrected)["counts"]
        names = [str(name) for name in counts["band"].values]
        if len(names) < 2:
            raise ValueError(f"Invalid bands {names} of the corrected. Must be two or more.")
        if min(counts.shape[2:]) < SMALLEST:
            size = f"{counts.shape[2]} rows and {counts.shape[3]} columns"
            rule = f"Must have at least {SMALLEST} of each to match reflections"
            raise ValueError(f"Invalid image of {size}. {rule}.")
        slopes, noise = scale.slopes, scale.noise_of(corrected)
        order = np.argsort(noise / schema.noise_factor(corrected), kind="stable")
        valid = (schema.pixel_status(corrected) & np.uint32(schema.UNMEASURED)) == 0
        frames = _frames(counts)
        times, segment = corrected["time"].values[frames], schema.segments(corrected)[frames]
        steps = np.diff(times)
        joined = (steps < 1.5 * np.median(steps)) & (np.diff(segment) == 0)
        rough = np.flatnonzero(joined[:-2] & joined[1:-1] & joined[2:])
        return cls(counts, order, slopes[order], noise[order], valid, frames, rough)

    def blocks(self, height: int) -> Iterator[tuple[slice, list[Movie], Mask]]:
        """Rows, their films (time, y, x) [count] in the frames, and pixels that lack few."""
        whole = self.frames.size == self.counts.sizes["time"]
        for start in range(0, self.valid.shape[0], height):
            rows = slice(start, start + height)
            films = self.counts.isel(y=rows).values
            films = films if whole else films[:, self.frames]
            flat = films.astype(np.float32, copy=False).reshape(*films.shape[:2], -1)
            filled, shares = zip(*(bridged(flat[band]) for band in self.bands), strict=True)
            complete = (np.min(shares, axis=0) >= 1.0 - _MISSING).reshape(films.shape[2:])
            yield rows, [film.reshape(films.shape[1:]) for film in filled], complete

    def smoothing(self, period: float) -> Array:
        """Smoother that passes half of a period [frame], as `solveh_banded` takes a matrix."""
        size, weight = self.frames.size, (2.0 * np.sin(np.pi / period)) ** -6
        terms, shape = [-1.0, 3.0, -3.0, 1.0], (size - 3, size)
        third = sparse.diags_array(terms, offsets=range(4), shape=shape, format="csr")[self.rough]
        penalty = sparse.dia_array(sparse.eye_array(size) + weight * third.T @ third)
        return np.stack([np.pad(penalty.diagonal(lag), (lag, 0)) for lag in (3, 2, 1, 0)])

    def functions(self, signals: Movie, period: float) -> Movie:
        """Functions (time, plane), each of a moment, of most changes within a period [frame]."""
        smoothing = self.smoothing(period)
        sample = signals.reshape(-1, signals.shape[-1])
        sample = sample[:: max(1, len(sample) // (_FOR_EACH * _PLANES))]
        leading = smooth.leading(rapid(sample, smoothing), _PLANES)
        leading = leading[:, : max(1, leading.shape[1] // EVENT) * EVENT]
        # Eigenvectors of time within their span are the most local functions, in order. Events, of
        # some in a row, take turns: the first function of each, then the second.
        _, turn = np.linalg.eigh(leading.T @ (np.arange(len(leading))[:, np.newaxis] * leading))
        events = max(1, turn.shape[1] // EVENT)
        turn = turn.reshape(-1, events, turn.shape[1] // events).swapaxes(1, 2).reshape(turn.shape)
        functions = rapid((leading @ turn).T, smoothing).T
        return np.ascontiguousarray(functions, np.float32)

    def planes(self, functions: Movie) -> list[Movie]:
        """Parts (y, x, plane) [K] of the bands along some functions of time (time, plane)."""
        result = np.empty((self.bands.size, *self.valid.shape, functions.shape[1]), np.float32)
        for rows, films, _ in self.blocks(_ROWS):
            for movie, film, slope in zip(result, films, self.slopes, strict=True):
                planes = film.reshape(len(film), -1).T @ (functions / np.float32(slope))
                movie[rows] = planes.reshape(movie[rows].shape)
        if not self.valid.all():
            nearest = distance_transform_edt(~self.valid, return_indices=True)[1]
            result[:, ~self.valid] = result[:, *nearest[:, ~self.valid]]
        return list(result)

    def binned(self, factor: int) -> tuple[list[Movie], Mask]:
        """Signals (y, x, time) [K] of squares of pixels, and the pixels that lack few frames."""
        valid, blocks = self.valid.copy(), []
        for rows, films, complete in self.blocks(max(1, _ROWS // factor) * factor):
            valid[rows] &= complete
            mask = valid[rows, :, np.newaxis]
            share = np.maximum(images.binned(mask.astype(np.float64), factor), factor**-2)
            signals = [np.moveaxis(film, 0, -1) for film in films]
            if not mask.all():
                signals = [np.where(mask, signal, np.float32(0.0)) for signal in signals]
            scale = (self.slopes[:, None, None, None] * share).astype(np.float32)
            blocks.append(np.stack([images.binned(signal, factor) for signal in signals]) / scale)
        return list(np.concatenate(blocks, axis=1)), valid


def white(frames: int, period: float) -> float:
    """Degrees of freedom of white noise that a smoother leaves, see `Capture.smoothing`."""
    frequency = np.pi * (np.arange(frames) + 0.5) / frames
    ratio = (np.sin(0.5 * frequency) / np.sin(np.pi / period)) ** 6
    return float(np.sum((ratio / (1.0 + ratio)) ** 2))


def bridged(film: Movie) -> tuple[Movie, Array]:
    """Film (time, pixel) with gaps bridged by lines, and the share (pixel) of measured samples."""
    measured = schema.measured(film)
    if measured.all():
        return film, np.ones(film.shape[1])
    result = np.where(measured, film, np.float32(np.nan))
    smooth.bridge(result, measured.any(axis=0))
    # A pixel without any sample is zero.
    return np.nan_to_num(result, copy=False), measured.mean(axis=0)


def rapid(signal: npt.NDArray[Any], smoothing: Array) -> npt.NDArray[Any]:
    """Signal (y, x, time) less what a smoother passes."""
    flat = signal.reshape(-1, signal.shape[-1]).T
    flat = flat - flat.mean(axis=0)
    return np.asarray((flat - solveh_banded(smoothing, flat)).T).reshape(signal.shape)


def _frames(counts: xr.DataArray) -> npt.NDArray[np.intp]:
    """Frames in which most of the pixels that every band ever measures are measured."""
    step = stride(counts.shape[2:], _PIXELS)
    valid = schema.measured(counts[:, :, ::step, ::step].values)
    view = valid.any(axis=1).all(axis=0)  # a view may show the object alone
    share = valid[..., view].mean(axis=2).min(axis=0) if view.any() else np.zeros(valid.shape[1])
    frames = np.flatnonzero(share > _COMMON)
    if frames.size < noises.MINIMUM_FRAMES:
        rule = f"Must be at least {noises.MINIMUM_FRAMES}"
        raise ValueError(f"Invalid number {frames.size} of frames that all bands have. {rule}.")
    return frames


def displaced_windows(corrected: xr.Dataset, scale: Scale) -> tuple[bool, float]:
    r"""Tell whether the cameras may see reflections displaced, and in which share of windows.

    A Gauss-Newton step from no displacement (Lucas, Kanade 1981, An iterative image registration
    technique, IJCAI) matches the windows, of changes that no smooth object shows; and once more of
    those too rapid for an object that heats within seconds:

    .. math:: z_2 = \kappa_w \, (z_1 + d \cdot \nabla z_1)

    A displacement in the image, or in time, counts if it exceeds that of a poor registration, and
    chance (Hotelling's T-squared of a jackknife over the windows): an object's rapid changes, or a
    border of materials, displace a window, but not all windows alike.

    The step is blind beyond the size of the texture: changes may be displaced, too, if those of the
    first band explain too little of those of the second band at the same pixels.
    """
    if min(corrected.sizes.get(name, 0) for name in ("y", "x")) < SMALLEST:
        return False, 0.0
    equations, unexplained = zip(*_window_equations(corrected, scale), strict=True)
    share = max(_share(windows) for windows in equations)
    return share > 0.0 or min(unexplained) > _UNEXPLAINED, share


def _share(windows: Array) -> float:
    """Share of windows whose bands are apart, from normal equations A d = g (window, 4, 3)."""
    number, total, size = len(windows), windows.sum(axis=0), windows.shape[2]
    # All windows, and all but each window in turn, must determine a displacement.
    sums = np.concatenate([total[np.newaxis], total - windows])
    if number < _FEWEST or np.linalg.eigvalsh(sums[:, :size]).min() <= 0.0:
        return 0.0
    shift, *replicates = np.linalg.solve(sums[:, :size], sums[:, size, :, np.newaxis])[..., 0]
    covariance = (number - 1) ** 2 / number * np.cov(np.transpose(replicates))
    square, free = shift @ np.linalg.solve(covariance, shift), number - size
    chance = fdtrc(size, free, free / (number - 1) / size * square)
    in_image = np.linalg.solve(total[:2, :2], total[size, :2])
    in_time = total[size, 2] / total[2, 2]
    if chance > _CHANCE or (np.hypot(*in_image) < _SHIFT and abs(in_time) < _DELAY):
        return 0.0
    # Windows whose residual is smaller with it: 2 d g - d A d > 0.
    return float(np.mean((2.0 * windows[:, size] - windows[:, :size] @ shift) @ shift > 0.0))


def _window_equations(corrected: xr.Dataset, scale: Scale) -> Iterator[tuple[Array, float]]:
    """Normal equations A d = g (window, 4, 3) of shifts down, right [pixel] and in time [frame].

    For each kind of changes; and the share of the second band's energy that is not explained.
    """
    frames = slice(None, None, max(1, corrected.sizes["time"] // _FRAMES))
    noise = scale.noise_of(corrected)
    bands = np.argsort(noise / schema.noise_factor(corrected), kind="stable")[:2]
    time = corrected["time"].values[frames]
    slopes = scale.slopes[bands].astype(np.float32)[:, np.newaxis, np.newaxis, np.newaxis]
    counts, (rows, columns) = corrected["counts"].variable[:, frames], _measured(corrected)

    def films(rows: slice, columns: slice) -> Movie:
        """Films (band, time, y, x) [K] of some rows and columns."""
        film = counts[:, :, rows, columns].values[bands].astype(np.float32)
        film[:, :, (np.ptp(film, axis=1) == 0.0).any(axis=0)] = np.nan  # of dead pixels
        film[:, ~schema.measured(film).all(axis=0)] = np.nan  # the same samples in both bands
        flat = film.reshape(2, time.size, -1)
        (first, share), (second, _) = (bridged(block) for block in flat)
        mask = share > _COMMON_SAMPLES * share.max()
        result = np.where(mask, np.stack([first, second]), np.float32(0.0))
        return np.asarray(result.reshape(film.shape) / slopes, np.float32)

    # Functions of time of what changes rapidly in the quietest band.
    height, width = rows.stop - rows.start, columns.stop - columns.start
    step = stride((height, width), _RAPID_PIXELS)
    grid = slice(rows.start, rows.stop, step), slice(columns.start, columns.stop, step)
    signals = films(*grid)[0].reshape(time.size, -1).T.astype(np.float64)
    segment = schema.segments(corrected)[frames]
    orders = min(_ORDER, time.size // 4), time.size // 4
    curves = [smooth.subspace(time, order, segment=segment).functions for order in orders]
    functions = [smooth.leading(signals, _RAPID_PLANES, block) for block in curves]
    rates = [np.gradient(block, axis=0).T @ block for block in functions]

    # Sums over the windows of rows of windows.
    side = int(np.clip(min(height, width) // _ALONG, *_SIDES))
    tops, lefts = (
        span.start + np.linspace(0, size - side, min(_ALONG, size // side)).astype(int)
        for span, size in ((rows, height), (columns, width))
    )
    sums: list[list[Array]] = [[] for _ in functions]
    for top in tops:
        film = films(slice(top, top + side), columns)
        places = np.indices(film.shape[2:]).astype(np.float64)
        for block, function, rate in zip(sums, functions, rates, strict=True):
            planes = film.reshape(2, time.size, -1).mT @ function.astype(np.float32)
            planes = planes.reshape(2, *film.shape[2:], -1)
            first, second = images.splines(planes[0], _BLUR), images.blurred(planes[1], _BLUR)
            weights, steps = np.ones((1, *places.shape[1:], 1), np.float32), rate.astype(np.float32)
            pairs = images.products(first, [second], places, weights, steps)[0][0].sum(axis=0)
            slices = (slice(start, start + side) for start in lefts - columns.start)
            block.extend(pairs[window].sum(axis=0) for window in slices)
    # Noise of variance s^2, blurred by b: s^2 / (4 pi b^2), of a slope 1 / (2 b^2) of that.
    levels, slope = side**2 * noise[bands] ** 2 / (4.0 * np.pi * _BLUR**2), 0.5 / _BLUR**2
    for windows, rate in zip(sums, rates, strict=True):
        squares = np.array([len(rate), len(rate) * slope, len(rate) * slope, np.sum(rate**2)])
        squares *= levels[0]
        strong = [window for window in windows if window[0] > (_CONTRAST + 1.0) * squares[0]]
        pairs = np.reshape(strong, (-1, 15))
        energies = np.sum(pairs[:, 14] - len(rate) * levels[1])
        explained = np.sum(np.maximum(pairs[:, 4], 0.0) ** 2 / (pairs[:, 0] - squares[0]))
        unexplained = 1.0 - explained / max(energies, explained) if len(pairs) >= _FEWEST else 0.0
        yield images.normal_equations(pairs, squares), unexplained


def _measured(corrected: xr.Dataset) -> tuple[slice, slice]:
    """Rows and columns with samples in some frames, as of an object in a part of the image."""
    frames = slice(None, None, max(1, corrected.sizes["time"] // _ALONG))
    pixels = schema.measured(corrected["counts"].isel(time=frames).values).all(axis=0).any(axis=0)
    pixels |= not pixels.any()
    rows, columns = (np.flatnonzero(pixels.any(axis=axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
