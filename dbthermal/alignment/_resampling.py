"""Resampling of all bands onto one clock and one pixel grid, the number of frames kept."""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _rows, schema
from dbthermal import noise as noises
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._offset import present, require_one_clock, sample, time_offset
from dbthermal.alignment._warping import displaced, registered, single
from dbthermal.noise import MAD

Array = npt.NDArray[np.float64]
Movie = npt.NDArray[np.float32]

TRANSFORM: Final = schema.Variable(
    ("band", "row", "column"), "float64", "1", "pixel of the first view to pixel of this one"
)
"""Transform of `register`: for each band a 3x3 homography on (x, y, 1), in pixels."""

# Standard deviations of noise beyond which a step lies between two frames.
_STEP: Final = 5.0


def align(
    corrected: xr.Dataset,
    *,
    offset: float | xr.DataArray | None = None,
    transform: xr.DataArray | None = None,
    clock: str | None = None,
    reflection_shift: xr.Dataset | None = None,
    lazy: bool = False,
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
        (band, row, column), from `register`: the views are warped by bilinear interpolation. Pixels
        outside a view are NaN.
    clock : str, optional
        Band whose samples are not touched in time.
    reflection_shift : Dataset, optional
        From the function `reflection_shift`, for `time_offset` to find the offset by.
    lazy : bool
        Compute the counts when they are read, some rows at a time and each time anew, as
        `correction.correct_capture` does: the capture may be lazy, too.

    Returns
    -------
    Dataset
        Stage `corrected` with as many frames: `counts` (band, time, y, x) [count], float32; `time`,
        exposure times of the band `clock` on the first band's clock. After a warp, a pixel's
        `status` is that of all the pixels that it may be made of; `noise_factor` (band) [1], by how
        much interpolation in time and over pixels lessens the noise, root mean square, which
        `separation.solve` takes into account; `pattern_std`, lessened over pixels.
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
    matrices = None if transform is None else _matrices(transform, names)
    views = corrected["counts"]
    shares = np.ones(len(names))
    if matrices is not None:
        # Registered first: a moving reflection passes an unregistered view earlier or later.
        corrected, shares = registered(corrected, matrices, lazy=lazy)
    counts, alike = corrected["counts"], corrected
    if reflection_shift is not None:
        alike = displaced(corrected, reflection_shift, lazy=lazy)
    offsets = _offsets(alike, offset, names)
    stamps = clocks.exposure_times(corrected) + offsets[:, np.newaxis]
    signals = sample(alike)
    for band in () if offset is None else range(1, len(names)):  # `time_offset` has done it
        pair = [0, band]
        require_one_clock(corrected.isel(band=pair), signals[pair], stamps[pair])
    noise, relative = _noise(signals, stamps)
    reference = int(np.argmax(relative)) if clock is None else _place(clock, names)
    times, segment = clocks.fill_times(stamps[reference]), clocks.segments(corrected)
    plans, factors, missing = [], np.ones(len(names)), _missing(views)
    for band, (row, absent) in enumerate(zip(stamps, missing, strict=True)):
        plan = clocks.interpolation(row, ~absent, times).within(segment)
        plans.append(replace(plan, valid=plan.valid & (plan.labels(segment) == segment)))
        # (1 - w) I + w I' of two frames with independent noises, root mean square over time.
        weight = plans[band].weight[plans[band].valid]
        factors[band] = np.sqrt(np.mean((1.0 - weight) ** 2 + weight**2)) if weight.size else 1.0

    def aligned(rows: slice) -> Movie:
        """Counts of some rows at the times of the reference."""
        movies = counts.isel(y=rows)
        result = np.empty(movies.shape, dtype=np.float32)
        for band, plan in enumerate(plans):
            movie = single(movies.isel(band=band).values)
            if missing[band].any():
                movie = np.where(
                    missing[band][:, np.newaxis, np.newaxis], np.float32(np.nan), movie
                )
            plan.apply(movie, result[band], _largest(noise[band], movie))
        return result

    lost = [int(np.count_nonzero(~plan.valid)) for plan in plans]
    movie = _rows.lazy(aligned, counts) if lazy else counts.copy(data=aligned(slice(None)))
    result = _assembled(corrected, movie, times)
    result = result.assign(noise_factor=("band", factors * shares, schema.NOISE_FACTOR.attrs))
    if "pattern_std" in result:
        result["pattern_std"] = result["pattern_std"] * shares
        result["pattern_std"].attrs.update(schema.PATTERN_STD.attrs)
    return result.assign_attrs(
        clock=names[reference],
        time_offset=offsets.tolist(),
        frames_lost=lost,
        pauses=clocks.pauses(times).ravel().tolist(),
        **({} if matrices is None else {"transform": matrices.ravel().tolist()}),
    )


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


def _matrices(transform: xr.DataArray, names: list[str]) -> Array:
    """Homographies (band, 3, 3) in the capture's order."""
    schema.check_variable(transform, TRANSFORM, "the transform")
    places = schema.band_positions(transform, names, "the transform")
    values = transform.values[places].astype(np.float64)
    if values.shape[1:] != (3, 3) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Invalid transform of shape {values.shape}. Must be 3x3 and finite in each band."
        )
    return np.asarray(values)


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


def _missing(views: xr.DataArray) -> npt.NDArray[np.bool_]:
    """Frames (band, time) that are NaN, or a copy of the one before, in every block of rows."""
    parts = [
        [clocks.missing(single(movie)) for movie in views.isel(y=rows).values]
        for rows in _rows.blocks(views.shape)
    ]
    return np.asarray(np.all(parts, axis=0))


def _assembled(corrected: xr.Dataset, aligned: xr.DataArray, times: Array) -> xr.Dataset:
    counts = corrected["counts"]
    attrs = schema.STAGES["corrected"]["counts"].attrs
    old = [name for name, part in corrected.data_vars.items() if "time" in part.dims]
    result = corrected.drop_vars(set(old) - {"counts", "segment"}).assign(
        counts=aligned.variable.copy(deep=False)
    )
    result["counts"].attrs = {**counts.attrs, **attrs}
    result = result.assign_coords(time=("time", times, corrected["time"].attrs))
    return schema.check(result, "corrected")
