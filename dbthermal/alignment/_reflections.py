"""Shift between the reflections that two cameras side by side see in one surface."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import sparse
from scipy.linalg import solveh_banded
from scipy.ndimage import distance_transform_edt, gaussian_filter
from threadpoolctl import threadpool_limits

from dbthermal import _smooth as smooth
from dbthermal import noise as noises
from dbthermal import response as responses
from dbthermal import schema
from dbthermal._arrays import Array, Mask
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import _matching as matching
from dbthermal.alignment._field import Field, Information, Spline
from dbthermal.alignment._matching import Movies
from dbthermal.alignment._offset import noise_levels, sample
from dbthermal.alignment._products import Movie

SMALLEST: Final = 24  # rows and columns of an image, at least
_COARSE: Final = 28  # pixels along the shorter side of the coarsest image, at least
_START: Final = 20  # the same of the image on which whole pixels are matched
_ROWS: Final = 32  # that are read at a time
_FOR_EACH: Final = 8  # pixels that tell a function of time
_COMMON: Final = 0.5  # share of the pixels that a frame must have in every band
_MISSING: Final = 0.1  # share of the frames that a pixel may lack
# Periods [frame] of which slower changes are left out: the shorter, the less an object that heats
# rapidly enters. A longer one is taken whose field has so many times smaller deviations, and
# a chi-square by the shorter one's data of no more than so many times that of the shorter one's own
# windows: of a field with rims it is 3 to 9, and objects that heat rapidly gave 30 to 8000.
# Functions of time that are matched: of 220 to 300 frames, fields of 36 simulated scenes are off by
# .054 pixel in the mean (by .065 with 32, by .074 with whole films).
_PLANES: Final = 128
_FEW: Final = 64  # of them, on the coarsest image
_PERIODS: Final = (5.0, 10.0, 20.0, 80.0)
_SLOW: Final = 20.0  # those of a delay, at least
_MORE: Final = 1.25
_AGREE: Final = 2.25
_KNOWN: Final = 0.2  # largest deviation of a shift by the data of a window alone [pixel]
_WIDE: Final = 6.0  # deviation of the window in which a field and its data are compared [pixel]
_RIDGE: Final = 1e-6  # of the largest information, where there is none
# Shift from which the cameras see reflections apart: in standard deviations, and in pixels.
_SIGMAS, _LEAST_SHIFT = 3.0, 0.1
_NEAR: Final = 0.125  # of the image's smaller side, by which a field is extrapolated


def reflection_shift(corrected: xr.Dataset, response: xr.Dataset) -> xr.Dataset:
    r"""
    Displacement between the reflections that two cameras side by side see in one surface.

    A registration of the object's surface does not register what that surface mirrors. What the
    other bands show at p, the reference band, the quietest, shows at p + d(p):

    .. math:: h_m(p, t) = k_m(p) h_1(p + d(p), t)

    with h the rapid changes of a band, which are the reflection's, and k a ratio of the material.
    The reflection's own texture tells d, along the baseline mostly: upright bodies have little
    texture along them, and that component is smooth, with a large deviation, and does no harm.
    It is needed where `separation.solve` flags `bands_apart` and there is no offset in time; where
    the cameras see from one place the shift is zero within its deviation.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, registered on the object's surface, all bands but the
        quietest by cameras at one place. Missing frames and samples are NaN; `status` and `segment`
        are respected. It may be lazy: it is read twice, in blocks of rows.
    response : Dataset
        Stage `response` of `schema`.

    Returns
    -------
    Dataset
        Stage `reflection_shift` of `schema`: `shift` (axis, y, x) [pixel], rows down and columns to
        the right, `shift_std`, and `known` (y, x), where texture tells the shift. It is
        extrapolated near by, and NaN farther off and where p + d(p) leaves the image. Attributes:
        `reference_band`, `bands` (the others); `delay` [s] of these, beside the shift, and
        `delay_std` [s].

    Raises
    ------
    TypeError, ValueError
        If an input is not as described, the image is too small, nothing that both bands see changes
        rapidly, or the shift is beyond a third of the image.
    """
    names = [str(name) for name in schema.check_corrected(corrected)["counts"]["band"].values]
    return shift_of(corrected, Scale.of_response(response, names)).drop_vars("energy")


@dataclass(frozen=True)
class Scale:
    """Slope (band) [count/K] of each band, or another scale of its changes, and its noise."""

    slopes: Array
    noise: Array | None  # before the alignment (band) [K], estimated from the capture if None

    @classmethod
    def of_response(cls, response: xr.Dataset, names: list[str]) -> "Scale":
        """Scale of a response, and of its noise if it states one."""
        slopes = np.array([responses.curve(response, name).reference_slope for name in names])
        noise = responses.noise(response, names) / slopes if "noise" in response else None
        return cls(slopes, noise)

    @classmethod
    def of_changes(cls, corrected: xr.Dataset) -> "Scale":
        """Scale without a response: each band's own changes in time, each on its own clock."""
        scatter, relative = noise_levels(sample(corrected), clocks.exposure_times(corrected))
        if not np.all(relative > 0.0):
            raise ValueError("Missing noise of the capture. Must be seen to match reflections.")
        return cls(scatter / relative, relative / _noise_factor(corrected))

    def noise_of(self, corrected: xr.Dataset) -> Array:
        """Noise of a capture (band) [K]."""
        if self.noise is not None:
            return np.asarray(self.noise * _noise_factor(corrected))
        signals = sample(corrected)
        here = np.all(np.isfinite(signals), axis=(0, 2))
        parts = [signal[here] / slope for signal, slope in zip(signals, self.slopes, strict=True)]
        return noises.estimate_bands(parts, corrected["time"].values[here])


def _noise_factor(corrected: xr.Dataset) -> Array:
    """Noise (band) [1] over that before the alignment."""
    whole = np.ones(corrected.sizes["band"])
    return np.asarray(corrected["noise_factor"].values if "noise_factor" in corrected else whole)


def shift_of(corrected: xr.Dataset, scale: Scale) -> xr.Dataset:
    """Displacement as `reflection_shift`, and its `energy`, see `matching.delay`."""
    with threadpool_limits(limits=1, user_api="blas"):  # on any number of cores the same field
        return _found(corrected, _Capture.of(corrected, scale))


def _found(corrected: xr.Dataset, capture: "_Capture") -> xr.Dataset:
    """Field of a checked capture, from coarse to fine."""
    shape = capture.valid.shape
    spline = Spline((shape[0], shape[1]), max(shape) / 3.0)
    factor = 2 ** max(0, int(np.log2(min(shape) / _COARSE)))
    capture, tried, period, field = _coarse(capture, spline, factor)
    # The delay is seen in slower changes, too, in which there is more than noise.
    slow = min((one for one in tried if one >= max(period, _SLOW)), default=max(tried))
    functions = [tried[one] for one in sorted({period, slow})]
    movies, white = capture.planes(functions), _white(capture.frames.size, period)

    def level(place: int, factor: int) -> Movies:
        """Movies of the changes within one of the periods, of coarser pixels."""
        pictures = [matching.binned(movie, factor) for movie in movies[place]]
        freedom = _freedom(functions[place])
        return Movies.blurred(pictures, capture.valid, capture.noise, freedom, factor, white)

    while factor > 2:
        factor //= 2
        field, _ = matching.refine(level(0, factor), field)
    fine = level(0, 1)
    field, data = matching.refine(fine, field)
    spread = _variances(field, fine, _told(data), _squares(data))
    # What a rate's planes are of the delay's, by its functions.
    times = corrected["time"].values[capture.frames]
    change = np.gradient(np.eye(times.size), times, axis=0).T @ functions[-1]
    rate = np.linalg.lstsq(functions[-1], change)[0].astype(np.float32)
    slower = fine if len(movies) == 1 else level(-1, 1)
    late, std, energy = matching.delay(slower, rate, field.on(fine.centres()))
    result = _result(corrected, capture, field, data, spread)
    result["energy"] = ("part", "y", "x"), energy
    return result.assign_attrs(delay=late, delay_std=std)


def seen_apart(field: xr.Dataset) -> bool:
    """Say that the cameras stand apart: along an axis their shift is more than its deviation."""
    known = field["known"].values
    if not known.any():
        return False
    both = (np.abs(field[name].values[:, known]) for name in ("shift", "shift_std"))
    shift, std = (np.median(part, axis=1) for part in both)
    return bool(np.any(shift > np.maximum(_SIGMAS * std, _LEAST_SHIFT)))


@dataclass(frozen=True)
class _Capture:
    """Capture and all that matching needs to know of it, the quietest band first."""

    counts: xr.DataArray
    bands: npt.NDArray[np.intp]  # places in the counts
    slopes: Array  # of the bands [count/K]
    noise: Array  # of the bands [K]
    valid: Mask  # pixels (y, x)
    frames: npt.NDArray[np.intp]  # that every band has
    rough: npt.NDArray[np.intp]  # first of four frames that follow one another evenly

    @classmethod
    def of(cls, corrected: xr.Dataset, scale: Scale) -> "_Capture":
        """Check a capture."""
        counts = schema.check_corrected(corrected)["counts"]
        names = [str(name) for name in counts["band"].values]
        if len(names) < 2:
            raise ValueError(f"Invalid bands {names} of the corrected. Must be two or more.")
        if min(counts.shape[2:]) < SMALLEST:
            raise ValueError(
                f"Invalid image of {counts.shape[2]} rows and {counts.shape[3]} columns. Must have "
                f"at least {SMALLEST} of each to match reflections."
            )
        slopes, noise = scale.slopes, scale.noise_of(corrected)
        order = np.argsort(noise, kind="stable")
        valid = np.ones(counts.shape[2:], dtype=bool)
        if "status" in corrected:
            valid &= (corrected["status"].values & int(schema.UNMEASURED)) == 0
        frames = _frames(counts)
        times, segment = corrected["time"].values[frames], clocks.segments(corrected)[frames]
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
            filled, share = bridged(flat)
            few = np.all(share >= 1.0 - _MISSING, axis=0).reshape(films.shape[2:])
            yield rows, [filled[band].reshape(films.shape[1:]) for band in self.bands], few

    def smoothing(self, period: float) -> Array:
        """Smoother that passes half of a period [frame], as `solveh_banded` takes a matrix."""
        size, weight = self.frames.size, (2.0 * np.sin(np.pi / period)) ** -6
        third = sparse.diags_array(
            [-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(size - 3, size), format="csr"
        )[self.rough]
        penalty = sparse.dia_array(sparse.eye_array(size) + weight * third.T @ third)
        return np.stack([np.pad(penalty.diagonal(lag), (lag, 0)) for lag in (3, 2, 1, 0)])

    def functions(self, signals: Array, period: float) -> Movie:
        """Functions (time, plane) of the changes within a period [frame] that signals show most."""
        smoothing = self.smoothing(period)
        some = signals.reshape(-1, signals.shape[-1])
        some = some[:: max(1, len(some) // (_FOR_EACH * _PLANES))]
        functions = _rapid(smooth.leading(_rapid(some, smoothing), _PLANES).T, smoothing).T
        return np.ascontiguousarray(functions, np.float32)

    def planes(self, functions: list[Movie]) -> list[list[Movie]]:
        """Parts (y, x, plane) [K] of the bands along each of some functions of time."""
        together = np.concatenate(functions, axis=1)
        result = np.empty((self.bands.size, *self.valid.shape, together.shape[1]), np.float32)
        for rows, films, _ in self.blocks(_ROWS):
            for movie, film, slope in zip(result, films, self.slopes, strict=True):
                planes = film.reshape(len(film), -1).T @ (together / np.float32(slope))
                movie[rows] = planes.reshape(movie[rows].shape)
        if not self.valid.all():
            nearest = distance_transform_edt(
                ~self.valid, return_distances=False, return_indices=True
            )
            result[:, ~self.valid] = result[:, *nearest[:, ~self.valid]]
        ends = np.cumsum([part.shape[1] for part in functions])
        return [list(part) for part in np.split(result, ends[:-1], axis=3)]

    def binned(self, factor: int) -> tuple[list[Movie], Mask]:
        """Signals (y, x, time) [K] of squares of pixels, and the pixels that lack few frames."""
        valid, parts = self.valid.copy(), []
        for rows, films, few in self.blocks(max(1, _ROWS // factor) * factor):
            valid[rows] &= few
            here = valid[rows, :, np.newaxis].astype(np.float64)
            share = np.maximum(matching.binned(here, factor), factor**-2)
            squares = [_sums(film, None if here.all() else here, factor) for film in films]
            share = self.slopes[:, None, None, None] * factor**2 * share
            parts.append(np.stack(squares) / share.astype(np.float32))
        return list(np.concatenate(parts, axis=1)), valid


def _sums(film: Movie, here: Array | None, factor: int) -> Movie:
    """Sums (y, x, time) of a film (time, y, x) over squares of pixels, of those that are here."""
    film = film if here is None else np.where(here[..., 0] > 0.0, film, np.float32(0.0))
    rows, columns = (size // factor * factor for size in film.shape[1:])
    parts = (
        film[:, i:rows:factor, j:columns:factor] for i, j in np.ndindex(factor, factor)
    )
    return np.moveaxis(sum(parts), 0, -1)


def _coarse(
    capture: _Capture, spline: Spline, factor: int
) -> tuple[_Capture, dict[float, Movie], float, Field]:
    """Capture with its valid pixels, functions of all periods, the best period, rough field."""
    signals, valid = capture.binned(factor)
    frames, tried, result = capture.frames.size, dict[float, Movie](), None
    refusal: ValueError | None = None
    before, seen, sizes, limit = None, np.False_, np.inf, np.inf  # of the field that was taken
    for period in _PERIODS:
        if frames < 2 * period and result is not None:
            break
        tried[period] = capture.functions(signals[0], period)
        functions = tried[period][:, :_FEW]
        pictures = [part @ functions for part in signals]
        level = Movies.blurred(
            pictures, valid, capture.noise, _freedom(functions), factor, _white(frames, period)
        )
        begin = None if result is None else result[-1]
        if begin is None:
            # Whole frames, of which what is rare in a pixel's time is cut.
            half = 2 if min(level.shape) >= 2 * _START else 1
            rough = replace(
                level,
                valid=matching.binned(level.valid * 1.0, half) > 0.5,
                noise=level.noise / half,
                factor=factor * half,
            )
            smoothing = capture.smoothing(period)
            films = [_rapid(matching.binned(part, half), smoothing) for part in signals]
            try:
                begin = matching.start(rough, films, _white(frames, period), spline)
            except ValueError as error:  # slower changes may tell more
                refusal = error
        if begin is None:
            continue
        field, data = matching.refine(level, begin)
        told, squares = _told(data, factor), _squares(data, factor)
        variance = _variances(field, level, told, squares)
        # Deviations of the field in the pixels in which one of both is known by its data.
        size = 0.25 * np.log(variance).sum(axis=0)
        gain = np.mean((sizes - size)[told | seen]) if told.any() else 0.0
        # A field of slower changes must fit the data of the more robust one.
        apart = 0.0 if before is None else begin.disagreement(before, level.centres(), field)
        better = gain > np.log(_MORE) or told.sum() > _MORE * seen.sum()
        if better and apart < limit:
            before, seen, sizes = data, told, size
            limit = min(limit, _AGREE * max(squares[:, told].mean(), 1.0))
            result = (replace(capture, valid=valid), tried, period, field)
    if result is None:
        raise refusal or ValueError(
            "Missing texture in the reflections: no rapid change that the bands share. "
            "Must be seen in both to find their shift; let somebody walk by."
        )
    return result


def _told(data: Information, factor: int = 1) -> Mask:
    """Pixels (y, x) where the data of a window alone tell the shift in one direction."""
    area = 4.0 * np.pi * (matching.WINDOW * factor) ** 2
    return np.asarray(area * matching.eigenvalues(data.tensor)[0] > 1.0 / _KNOWN**2)


def _squares(data: Information, factor: int = 1) -> Array:
    """Squares (2, y, x) of the steps that windows ask for, over their variances [1]."""
    area = 4.0 * np.pi * (matching.WINDOW * factor) ** 2
    tensor = np.moveaxis(area * data.tensor[[[0, 1], [1, 2]]], (0, 1), (-2, -1))
    inverse = np.linalg.inv(tensor + _RIDGE * max(tensor.max(), 1.0) * np.eye(2))
    steps = np.einsum("yxij,jyx->iyx", inverse, area * data.gradient)
    return np.asarray(steps**2 / np.moveaxis(np.diagonal(inverse, axis1=2, axis2=3), 2, 0))


def _variances(field: Field, level: Movies, told: Mask, squares: Array) -> Array:
    """
    Variance (2, y, x) of a field [pixel^2], times the data's reduced chi-square about the field.

    The field is smoother than the reflection where windows ask for steps beyond their own noise.
    """
    sums = [
        gaussian_filter(part * told, _WIDE / level.factor, axes=(-2, -1))
        for part in (squares, np.ones(told.shape))
    ]
    chi = np.maximum(sums[0] / np.maximum(sums[1], 1e-9), 1.0)
    return np.asarray(chi * field.variances(level.centres()))


def _freedom(functions: Array) -> float:
    """Degrees of freedom of white noise along functions of time (time, plane)."""
    return float(np.sum(functions**2))


def _white(frames: int, period: float) -> float:
    """Degrees of freedom of white noise that a smoother leaves, see `_Capture.smoothing`."""
    frequency = np.pi * (np.arange(frames) + 0.5) / frames
    ratio = (np.sin(0.5 * frequency) / np.sin(np.pi / period)) ** 6
    return float(np.sum((ratio / (1.0 + ratio)) ** 2))


def bridged(films: Movie) -> tuple[Movie, Array]:
    """Films (band, time, pixel) with missing samples on the line between those before and after.

    And the share of the samples (band, pixel) that are measured; a pixel without any is zero.
    """
    known = schema.measured(films)
    if known.all():
        return films, np.ones((len(films), films.shape[2]))
    bands, pixels = np.nonzero(~known.all(axis=1))
    film, here = films[bands, :, pixels], known[bands, :, pixels]
    frame = np.arange(film.shape[1])
    before = np.maximum.accumulate(np.where(here, frame, -1), axis=1)
    after = np.minimum.accumulate(np.where(here, frame, frame.size)[:, ::-1], axis=1)[:, ::-1]
    before, after = (
        np.clip(np.where(before < 0, after, before), 0, frame.size - 1),
        np.where(after == frame.size, np.maximum(before, 0), after),
    )
    film = np.where(here, film, np.float32(0.0))
    low, high = (np.take_along_axis(film, place, axis=1) for place in (before, after))
    weight = (frame - before) / np.maximum(after - before, 1)
    result = films.copy()
    result[bands, :, pixels] = low + weight.astype(np.float32) * (high - low)
    return result, known.mean(axis=1)


def _rapid(signal: Array, smoothing: Array) -> Array:
    """Signal (y, x, time) less what a smoother passes."""
    flat = signal.reshape(-1, signal.shape[-1]).T
    flat = flat - flat.mean(axis=0)
    return np.asarray((flat - solveh_banded(smoothing, flat)).T).reshape(signal.shape)


def _frames(counts: xr.DataArray) -> npt.NDArray[np.intp]:
    """Frames in which most of the pixels that every band ever measures are measured."""
    step = max(1, int(np.sqrt(counts[0, 0].size / 1024)))
    some = schema.measured(counts[:, :, ::step, ::step].values)
    ever = some.any(axis=1).all(axis=0)  # a view may show the object alone
    share = some[..., ever].mean(axis=2).min(axis=0) if ever.any() else np.zeros(some.shape[1])
    used = np.flatnonzero(share > _COMMON)
    if used.size < noises.MINIMUM_FRAMES:
        raise ValueError(
            f"Invalid capture of {used.size} frames that all bands have. Must be at least "
            f"{noises.MINIMUM_FRAMES}."
        )
    return used


def _result(
    corrected: xr.Dataset, capture: _Capture, field: Field, data: Information, variance: Array
) -> xr.Dataset:
    """Field as a dataset, NaN far from where it is known."""
    shape = capture.valid.shape
    centres = [np.arange(size, dtype=np.float64) for size in shape]
    shift = field.on(centres)
    reached = matching.inside(np.indices(shape) + shift, np.ones(shape, dtype=bool))
    known = _told(data) & reached
    distance = np.asarray(distance_transform_edt(~known))
    near = (distance <= _NEAR * min(shape)) & reached & known.any()
    # Away from where it is known the field may change as much as it does there.
    slopes = np.square(np.gradient(shift, axis=(1, 2))).sum(axis=0)[:, known]
    growth = np.multiply.outer(slopes.sum(axis=1) / max(1, known.sum()), distance**2)
    std = np.sqrt(np.maximum(variance, 0.0) + growth)
    names = [str(name) for name in corrected["band"].values[capture.bands]]
    values = {
        "shift": np.where(near, shift, np.nan).astype(np.float32),
        "shift_std": np.where(near, std, np.nan).astype(np.float32),
        "known": known,
    }
    places = {name: corrected[name] for name in ("y", "x") if name in corrected.coords}
    result = xr.Dataset(
        schema.variables("reflection_shift", values),
        coords={"axis": ["y", "x"], **places},
        attrs={**corrected.attrs, "reference_band": names[0], "bands": names[1:]},
    )
    return schema.check(result, "reflection_shift")
