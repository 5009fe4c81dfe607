"""Resampling of all bands onto one clock, of views on one pixel grid (`_views`)."""

from dataclasses import replace
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, _rows, schema
from dbthermal import noise as noises
from dbthermal._arrays import Array, Mask
from dbthermal._warnings import warned
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import _views as views
from dbthermal.alignment._offset import SEARCH, present, require_one_clock, sample, time_offset
from dbthermal.alignment._views import Movie
from dbthermal.noise import MAD

STEP: Final = 5.0  # standard deviations of noise beyond which a step lies between two frames


def align(
    corrected: xr.Dataset,
    *,
    offset: float | xr.DataArray | None = None,
    transform: xr.DataArray | None = None,
    search: int = SEARCH,
    clock: str | None = None,
    reflection_shift: xr.Dataset | None = None,
    lazy: bool = False,
) -> xr.Dataset:
    """Resample all bands onto one clock, and onto the first band's grid.

    The samples of one band are not touched in time, and its noise stays white: the noisiest, by its
    noise relative to its signal, unless `clock` names another. The other bands are interpolated at
    its exposure times by what is to be expected between four frames: the line between two for a
    random walk, nearly a cubic for what is smooth. An offset of whole frames is a pure shift.

    Frames are NaN in a band where that would reach over a gap, over a change of `segment`, or
    past an end, and where its camera gave none: NaN, or a copy of the frame before. Where a signal
    steps between two frames, by five standard deviations of noise, the sample is NaN, too, for when
    it changed is not known, and those beside it, where a curve overshoots. Interpolation makes the
    noise of a band smaller, by up to 0.8 (`noise_factor`), and correlates neighbouring frames.

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
        are interpolated by polynomials through 6x6 pixels, near the border and bad pixels by
        lines. Pixels outside a view, or without a place in it (NaN), are NaN.
    search : int
        Largest lag that `time_offset` searches, either way [frame].
    clock : str, optional
        Band whose samples are not touched in time.
    reflection_shift : Dataset, optional
        From the function of this name: the time offset is found of places that show the same
        reflection. It changes nothing else.
    lazy : bool
        Compute the counts when they are read, some rows at a time and each time anew, as
        `correction.correct_capture` does: the capture may be lazy, too.

    Returns
    -------
    Dataset
        Stage `corrected` with as many frames: `counts` (band, time, y, x) [count], float32; `time`,
        exposure times of the band `clock` on the first band's clock. After a warp, a pixel's
        `status` is that of all the pixels that it may be made of; `noise_factor` (band) [1], by how
        much interpolation in time and over pixels lessens the noise, root mean square;
        `pattern_std`, lessened over pixels. Attributes: `clock`, `time_offset` (of each band) [s],
        `frames_lost` (of each band), `pauses` (times of the frames before and after each gap of
        more than 20 frame periods, in turn) [s], `transform` (the matrices, row by row). Other
        variables over `time`, as `exposure_time` and `drift`, are dropped.

    Warns
    -----
    UserWarning
        If an offset leaves no frame of a band.

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
    schema.check_corrected(corrected)
    if transform is not None:
        # Registered first: a moving reflection passes an unregistered view earlier or later.
        corrected = views.registered(corrected, transform, lazy=lazy)
    return on_one_clock(
        corrected,
        offset=offset,
        search=search,
        clock=clock,
        reflection_shift=reflection_shift,
        lazy=lazy,
    )


def on_one_clock(
    corrected: xr.Dataset,
    *,
    offset: float | xr.DataArray | None = None,
    search: int = SEARCH,
    clock: str | None = None,
    reflection_shift: xr.Dataset | None = None,
    lazy: bool = False,
    steps: float = STEP,
) -> xr.Dataset:
    """Registered views on one clock, see `align`; of other steps [standard deviation of noise].

    Means over pixels have less noise, but step no less where something passes.
    """
    names = [str(name) for name in corrected["band"].values]
    counts, alike = corrected["counts"], corrected
    if reflection_shift is not None:
        schema.check(reflection_shift, "reflection_shift")
    if reflection_shift is not None and offset is None:
        alike, _ = views.moved(corrected, views.reflected(reflection_shift, corrected), lazy=lazy)
    offsets = _offsets(alike, offset, names, search)
    stamps = clocks.exposure_times(corrected) + offsets[:, np.newaxis]
    signals = sample(corrected)
    for band in () if offset is None else range(1, len(names)):  # `time_offset` has done it
        pair = [0, band]
        require_one_clock(corrected.isel(band=pair), signals[pair], stamps[pair])
    noise, relative = _noise(signals, stamps)
    reference = int(np.argmax(relative)) if clock is None else _place(clock, names)
    times, segment = clocks.fill_times(stamps[reference]), clocks.segments(corrected)
    plans, factors, missing = [], np.ones(len(names)), _missing(counts)
    for band, (row, absent) in enumerate(zip(stamps, missing, strict=True)):
        plan = clocks.interpolation(row, ~absent, times, segment, clocks.growth(signals[band]))
        plans.append(replace(plan, valid=plan.valid & (plan.labels(segment) == segment)))
        power = plans[band].power()[plans[band].valid]  # of independent noises
        factors[band] = np.sqrt(np.mean(power)) if power.size else 1.0

    def aligned(rows: slice) -> Movie:
        """Counts of some rows at the times of the reference."""
        movies = counts.isel(y=rows)
        result = np.empty(movies.shape, dtype=np.float32)
        for band, plan in enumerate(plans):
            movie = views.single(movies.isel(band=band).values)
            if missing[band].any():
                movie = np.where(missing[band][:, None, None], np.float32(np.nan), movie)
            plan.apply(movie, result[band], _largest(steps * noise[band], movie))
        return result

    lost = [int(np.count_nonzero(~plan.valid)) for plan in plans]
    movie = _rows.lazy(aligned, counts) if lazy else counts.copy(data=aligned(slice(None)))
    result = _assembled(corrected, movie, times)
    rule = f"at offsets of {offsets.tolist()} s: are they in seconds, do the recordings overlap?"
    apart = (stamps.max(axis=1) < times.min()) | (stamps.min(axis=1) > times.max())
    gone = [name for name, away in zip(names, apart, strict=True) if away]
    result = warned(result, *(f"No frame of band '{name}' is left {rule}" for name in gone))
    if "noise_factor" in corrected:
        factors = factors * corrected["noise_factor"].values
    result = result.assign(noise_factor=("band", factors, schema.NOISE_FACTOR.attrs))
    return result.assign_attrs(
        clock=names[reference],
        time_offset=offsets.tolist(),
        frames_lost=lost,
        pauses=clocks.pauses(times).ravel().tolist(),
    )


def _offsets(
    corrected: xr.Dataset, offset: float | xr.DataArray | None, names: list[str], search: int
) -> Array:
    """Offset of each band against the first [s]."""
    if offset is None:
        found = [time_offset(corrected, band=name, search=search) for name in names[1:]]
        return np.array([0.0, *found])
    if isinstance(offset, xr.DataArray):
        values = schema.band_values(offset, names, "the time offset", "s")
    else:
        if len(names) != 2:
            raise ValueError(
                f"Invalid offset {offset} s for bands {names}. Must be one for each, (band)."
            )
        values = np.array([0.0, _numbers.real_number("offset [s]", offset)])
    if values[0] != 0 or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Invalid offset {values.tolist()} s. Must be finite, and 0 in band '{names[0]}', the "
            "first."
        )
    return values


def _place(clock: str, names: list[str]) -> int:
    if clock not in names:
        raise ValueError(f"Unknown clock '{clock}'. Must be one of the bands {names}.")
    return names.index(clock)


def _largest(noise: float, movie: Movie) -> float:
    """Largest step [count] of so much noise: a difference less the mean of its two neighbours."""
    rounding = 8.0 * np.finfo(np.float32).eps * np.nanmax(np.abs(movie), initial=0.0)
    return float(np.sqrt(3.0) * noise + rounding)


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


def _missing(films: xr.DataArray) -> Mask:
    """Frames (band, time) that are NaN, or a copy of the one before, in every block of rows."""
    parts = [
        [clocks.missing(views.single(movie)) for movie in films.isel(y=rows).values]
        for rows in _rows.blocks(films.shape)
    ]
    return np.asarray(np.all(parts, axis=0))


def _assembled(corrected: xr.Dataset, aligned: xr.DataArray, times: Array) -> xr.Dataset:
    """Capture with the aligned counts at the times of the reference."""
    old = [name for name, part in corrected.data_vars.items() if "time" in part.dims]
    result = corrected.drop_vars(set(old) - {"counts", "segment"})
    result = result.assign(counts=aligned.variable.copy(deep=False))
    attrs = schema.STAGES["corrected"]["counts"].attrs
    result["counts"].attrs = {**corrected["counts"].attrs, **attrs}
    result = result.assign_coords(time=("time", times, corrected["time"].attrs))
    return schema.check(result, "corrected")
