"""Resampling of all bands onto one clock and one pixel grid, the number of frames kept."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.sparse import csr_array, diags_array, eye_array

from dbthermal import noise as noises
from dbthermal import schema
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._offset import present, require_one_clock, sample, time_offset
from dbthermal.noise import MAD

Array = npt.NDArray[np.float64]
Movie = npt.NDArray[np.float32]

TRANSFORM: Final = schema.Variable(
    ("band", "row", "column"), "float64", "1", "pixel of the first view to pixel of this one"
)
"""Transform of `register`: for each band a 3x3 homography on (x, y, 1), in pixels."""

MAP: Final = schema.Variable(
    ("band", "axis", "y", "x"), "float64", "pixel", "row and column of the first view's pixel here"
)
"""Transform of a curved surface: for each band where each pixel of the first view lies in it."""

# Pixels a side that a sample between pixels is made of.
_TAPS: Final = 6
# A weight that is none [1].
_ROUNDING: Final = 1e-7

# Standard deviations of noise beyond which a step lies between two frames.
_STEP: Final = 5.0
# A pixel position is rounded to this, so that a border met exactly is not missed [pixel].
_DIGITS: Final = 9


def align(
    corrected: xr.Dataset,
    *,
    offset: float | xr.DataArray | None = None,
    transform: xr.DataArray | None = None,
    clock: str | None = None,
) -> xr.Dataset:
    """
    Resample all bands onto one clock, and onto the first band's grid.

    The samples of one band are not touched in time, and its noise stays white: the noisiest, by its
    noise relative to its signal, unless `clock` names another. The other bands are interpolated at
    its exposure times, on the line between the frames before and after, which for a background that
    moves in steps or at random is the expected value. An offset of whole frames is a pure shift.

    Frames are NaN in a band where the line would reach over a gap, over a change of `segment`, or
    past an end, and where its camera gave none: NaN, or a copy of the frame before. Nothing is
    extrapolated: a recording that pauses is aligned in its parts. Where a signal steps between two
    frames, by five standard deviations of noise, the sample is NaN, too: when it changed is not
    known. Interpolation makes the noise of a band smaller, by up to 0.7 (`noise_factor`), and
    correlates neighbouring frames; in the quieter of two bands that hardly counts.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`. Optionally `exposure_time` (band, time) [s], each camera's
        own stamps, which need be neither even nor of one rate, NaN behind the last frame; `segment`
        (time), which counts shutter events; `status` (y, x).
    offset : float or DataArray, optional
        How much later than the first band the others were exposed, beyond their stamps [s]: a
        number for two bands, or (band), 0 in the first. By default `time_offset` of the registered
        views.
    transform : DataArray, optional
        (band, row, column), from `register`; or, of a curved surface whose shape is known, (band,
        axis, y, x) [pixel], the row and column in each view of each pixel of the first. The views
        are interpolated by polynomials through 6x6 pixels, near a bad pixel by lines. Pixels
        outside a view, or without a place in it (NaN), are NaN.
    clock : str, optional
        Band whose samples are not touched in time.

    Returns
    -------
    Dataset
        Stage `corrected` with as many frames: `counts` (band, time, y, x) [count], float32; `time`,
        exposure times of the band `clock` on the first band's clock. After a warp, a pixel's
        `status` is that of all the pixels that it may be made of; `noise_factor` (band) [1], by how
        much interpolation in time and by a warp lessens the noise, which `separation.solve` takes
        into account.
        Attributes: `clock`, `time_offset` (of each band) [s], `frames_lost` (of each band),
        `pauses` (times of the frames before and after each gap of more than 20 frame periods, in
        turn) [s], `transform` (the matrices, row by row). `exposure_time` and other variables over
        `time` on the clocks before, as `drift`, are dropped.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, `time_offset` finds no offset, or a band's clock was set
        while it ran: its stamps step, and the images go on as without the step.

    Examples
    --------
    A shift by one whole frame: the last frame has no counterpart.

    >>> import numpy as np, xarray as xr
    >>> rng, time = np.random.default_rng(1), np.arange(40) / 10.0
    >>> counts = rng.normal(20000, 5, (2, 40, 4, 4)).astype(np.float32)
    >>> corrected = xr.Dataset(
    ...     {"counts": (("band", "time", "y", "x"), counts)},
    ...     {"band": ["8-14", "9.5"], "time": time},
    ... )
    >>> aligned = align(corrected, offset=-0.1, clock="8-14")
    >>> bool((aligned.counts[1, :-1] == counts[1, 1:]).all()), aligned.frames_lost
    (True, [0, 1])
    """
    names = [str(name) for name in schema.check_corrected(corrected)["band"].values]
    factors, recorded = np.ones(len(names)), {}
    if transform is not None:
        # Registered first: a moving reflection passes an unregistered view earlier or later.
        maps = _maps(transform, names, corrected["counts"].shape[2:])
        corrected, factors = _registered(corrected, maps)
        if "row" in transform.dims:
            places = schema.band_positions(transform, names, "the transform")
            recorded["transform"] = transform.values[places].ravel().tolist()
    counts, offsets = corrected["counts"], _offsets(corrected, offset, names)
    stamps = clocks.exposure_times(corrected) + offsets[:, np.newaxis]
    signals = sample(corrected)
    for band in () if offset is None else range(1, len(names)):  # `time_offset` has done it
        pair = [0, band]
        require_one_clock(corrected.isel(band=pair), signals[pair], stamps[pair])
    noise, relative = _noise(signals, stamps)
    reference = int(np.argmax(relative)) if clock is None else _place(clock, names)
    times, segment = clocks.fill_times(stamps[reference]), clocks.segments(corrected)
    aligned = np.empty(counts.shape, dtype=np.float32)
    for band, row in enumerate(stamps):
        movie = _single(counts.isel(band=band))
        absent = clocks.missing(movie)
        if absent.any():
            movie = np.where(absent[:, np.newaxis, np.newaxis], np.float32(np.nan), movie)
        plan = clocks.interpolation(row, ~absent, times).within(segment)
        plan = replace(plan, valid=plan.valid & (plan.labels(segment) == segment))
        plan.apply(movie, aligned[band], _largest(noise[band], movie))
        # (1 - w) I + w I' of two frames with independent noises, root mean square over time.
        shares = plan.weight[plan.valid]
        if shares.size:
            factors[band] *= np.sqrt(np.mean((1.0 - shares) ** 2 + shares**2))
    lost = np.isnan(aligned).all(axis=(2, 3)).sum(axis=1)
    result = _assembled(corrected, aligned, times)
    result = result.assign(noise_factor=("band", factors, schema.NOISE_FACTOR.attrs))
    return result.assign_attrs(
        clock=names[reference],
        time_offset=offsets.tolist(),
        frames_lost=lost.tolist(),
        pauses=clocks.pauses(times).ravel().tolist(),
        **recorded,
    )


def interpolation(places: Array, taps: int) -> csr_array:
    """
    Weights (pixel, pixel) [1] of samples at rows and columns (2, y, x) [pixel].

    Those of the polynomials through so many neighbours a side (Lagrange): of 6 they keep 95 % of
    what is four pixels long and 99.7 % from seven on, half-way between pixels; lines keep 71 and
    90 %. A place outside has no weights.
    """
    shape = places.shape[1:]
    nodes, inside, factors = np.arange(taps), np.ones(places[0].size, dtype=bool), []
    spacing = nodes[:, np.newaxis] - nodes + np.eye(taps)
    for place, size in zip(places.reshape(2, -1), shape, strict=True):
        inside &= (place >= 0) & (place <= size - 1)
        here = np.where(inside, place, 0.0)
        # Near the border the polynomial is that of the outermost pixels.
        first = np.clip(np.floor(here) - (taps // 2 - 1), 0, size - taps)
        away = (here - first)[:, np.newaxis] - nodes
        others = np.where(np.eye(taps, dtype=bool), 1.0, away[:, np.newaxis, :])
        weight = np.prod(others / spacing, axis=2)
        factors.append((weight, first[:, np.newaxis].astype(np.int32) + nodes))
    (down, row), (right, column) = factors
    weight = (down[:, :, np.newaxis] * right[:, np.newaxis]).astype(np.float32)
    pixel = row[:, :, np.newaxis] * shape[1] + column[:, np.newaxis]
    kept = inside[:, np.newaxis, np.newaxis] & (abs(weight) > _ROUNDING)
    ends = np.concatenate([[0], np.cumsum(kept.sum(axis=(1, 2)))])
    return csr_array((weight[kept], pixel[kept], ends), shape=(inside.size, inside.size))


def _weights(places: Array, bad: npt.NDArray[np.bool_]) -> csr_array:
    """Weights as `interpolation`, on lines near bad pixels (y, x), so that these do not spread."""
    if np.array_equal(places, np.indices(bad.shape)):
        return eye_array(bad.size, dtype=np.float32, format="csr")
    fine = interpolation(places, min(_TAPS, *bad.shape))
    near = (abs(fine) @ bad.ravel().astype(np.float32)) > 0
    coarse = interpolation(places, 2)
    keep, swap = (diags_array(part.astype(np.float32)) for part in (~near, near))
    result = csr_array(keep @ fine + swap @ coarse)
    result.eliminate_zeros()  # for a weight of 0 would pass a NaN on
    return result


def positions(matrix: Array, shape: tuple[int, ...]) -> Array:
    r"""
    Row and column (2, y, x) [pixel], in another view, of the pixels of the first.

    .. math:: (x', y', 1)^T \propto H (x, y, 1)^T, counted from 0 at the centre of the first pixel.
    """
    rows, columns = np.indices(shape, dtype=np.float64)
    column, row, scale = np.einsum(
        "ij,jyx->iyx", matrix, np.stack([columns, rows, np.ones_like(rows)])
    )
    return np.asarray(np.round(np.stack([row, column]) / scale, _DIGITS))


def _offsets(corrected: xr.Dataset, offset: float | xr.DataArray | None, names: list[str]) -> Array:
    """Offset of each band against the first [s]."""
    if offset is None:
        return np.array([0.0, *(time_offset(corrected, band=name) for name in names[1:])])
    if isinstance(offset, xr.DataArray):
        places = schema.band_positions(offset, names, "the time offset")
        if offset.attrs.get("units", "s") != "s":
            raise ValueError(f"Invalid unit '{offset.attrs['units']}' of the offset. Must be 's'.")
        values = offset.values[places].astype(np.float64)
    else:
        if len(names) != 2:
            raise ValueError(
                f"Invalid offset {offset} s for bands {names}. Must be one for each, (band)."
            )
        values = np.array([0.0, float(offset)])
    if values[0] != 0 or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Invalid offset {values.tolist()} s. Must be finite, and 0 in band '{names[0]}', the "
            "first."
        )
    return values


def _maps(transform: xr.DataArray, names: list[str], shape: tuple[int, ...]) -> list[Array]:
    """Rows and columns (2, y, x) in each view of the first one's pixels, in the capture's order."""
    places = schema.band_positions(transform, names, "the transform")
    if "axis" in transform.dims:
        schema.check_variable(transform, MAP, "the transform")
        if transform.shape[1:] != (2, *shape):
            raise ValueError(
                f"Invalid transform of shape {transform.shape[1:]}. Must be {(2, *shape)} in each "
                "band, as the image."
            )
        return [np.asarray(view, dtype=np.float64) for view in transform.values[places]]
    schema.check_variable(transform, TRANSFORM, "the transform")
    values = transform.values[places].astype(np.float64)
    if values.shape[1:] != (3, 3) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Invalid transform of shape {values.shape}. Must be 3x3 and finite in each band."
        )
    return [positions(matrix, shape) for matrix in values]


def _place(clock: str, names: list[str]) -> int:
    if clock not in names:
        raise ValueError(f"Unknown clock '{clock}'. Must be one of the bands {names}.")
    return names.index(clock)


def _largest(noise: float, movie: Movie) -> float:
    """Largest step [count] of noise: a difference less the mean of its two neighbours."""
    rounding = 8.0 * np.finfo(np.float32).eps * np.nanmax(np.abs(movie), initial=0.0)
    return float(_STEP * np.sqrt(3.0) * noise + rounding)


def _noise(signals: Array, stamps: Array) -> Array:
    """Noise of each band by second differences in time: in counts, and relative to its signal."""
    levels = []
    for frames, times in zip(signals, stamps, strict=True):
        here = present(frames) & np.isfinite(times)
        signal = frames[here]
        rough = noises.second_difference(signal, times[here])
        if not rough.size:  # too few frames to tell
            levels.append((0.0, 0.0))
            continue
        scatter, change = MAD * np.median(np.abs(rough), axis=0), signal.std(axis=0)
        relative = np.divide(scatter, change, out=np.zeros_like(change), where=change > 0)
        levels.append((np.median(scatter), np.median(relative)))
    return np.array(levels).T


def _single(movie: xr.DataArray) -> Movie:
    """Counts in single precision, NaN where they are infinite or beyond it."""
    counts = movie.values
    return np.where(schema.measured(counts), counts, np.nan).astype(np.float32, copy=False)


def _registered(corrected: xr.Dataset, maps: Sequence[Array]) -> tuple[xr.Dataset, Array]:
    """All views, and the status, on the first one's grid; factor of each one's noise (band)."""
    counts = corrected["counts"]
    views, less = np.empty(counts.shape, dtype=np.float32), np.ones(len(maps))
    shape = counts.shape[2:]
    status = corrected["status"].values if "status" in corrected else np.zeros(shape, np.uint32)
    result = np.zeros_like(status)
    for band, places in enumerate(maps):
        movie = _single(counts.isel(band=band))
        present = ~clocks.missing(movie)
        bad = (status > 0) | np.isnan(movie[present]).any(axis=0)
        weights = _weights(places, bad)
        outside = np.diff(weights.indptr).reshape(shape) == 0
        for frame, out in zip(movie, views[band], strict=True):
            out[:] = np.where(outside, np.nan, (weights @ frame.ravel()).reshape(shape))
        used = ~outside.ravel()
        # Independent noises of the pixels that a sample is made of: root mean square.
        less[band] = np.sqrt(np.mean((weights**2).sum(axis=1)[used])) if used.any() else 1.0
        for value in np.unique(status[status > 0]):
            share = abs(weights) @ (status == value).ravel().astype(np.float32)
            result[share.reshape(shape) > 0] |= value
    registered = corrected.assign(counts=counts.copy(data=views))
    if "status" in corrected:
        registered = registered.assign(status=corrected["status"].copy(data=result))
    return registered, less


def _assembled(corrected: xr.Dataset, aligned: Movie, times: Array) -> xr.Dataset:
    counts = corrected["counts"]
    attrs = schema.STAGES["corrected"]["counts"].attrs
    old = [name for name, part in corrected.data_vars.items() if "time" in part.dims]
    result = corrected.drop_vars(set(old) - {"counts", "segment"}).assign(
        counts=(counts.dims, aligned, {**counts.attrs, **attrs})
    )
    result = result.assign_coords(time=("time", times, corrected["time"].attrs))
    return schema.check(result, "corrected")
