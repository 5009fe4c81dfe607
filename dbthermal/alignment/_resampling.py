"""Resampling of all bands onto one clock, of views on one pixel grid (`_views`)."""

from dataclasses import replace
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, _rows, schema
from dbthermal._arrays import Array
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import _views as views
from dbthermal.alignment._offset import SEARCH, noise_levels, require_one_clock, sample, time_offset
from dbthermal.alignment._products import Movie

STEP: Final = 5.0  # standard deviations of noise of a step between two frames


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
    """Registered views on one clock, see `align`; `steps` [standard deviation of noise]."""
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
    # The clock of the noisiest band, relative to its signal.
    noise, relative = noise_levels(signals, stamps)
    if clock is not None and clock not in names:
        raise ValueError(f"Unknown clock '{clock}'. Must be one of the bands {names}.")
    reference = int(np.argmax(relative)) if clock is None else names.index(clock)
    times, segment = clocks.fill_times(stamps[reference]), schema.segments(corrected)
    # Plan the interpolation of each band, and how it reduces noise.
    plans, factors = [], np.ones(len(names))
    # Frames that are NaN, or a copy of the one before, in every block of rows.
    blocks = (counts.isel(y=rows).values for rows in _rows.blocks(counts.shape))
    copies = [[clocks.missing(views.single(film)) for film in block] for block in blocks]
    missing = np.all(copies, axis=0)
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
            # The largest step of noise: a difference less the mean of its two neighbours.
            rounding = 8.0 * np.finfo(np.float32).eps * np.nanmax(np.abs(movie), initial=0.0)
            largest = float(np.sqrt(3.0) * (steps * noise[band]) + rounding)
            plan.apply(movie, result[band], largest)
        return result

    if not np.all([plan.valid for plan in plans], axis=0).any():
        label = f"Invalid offset {offsets.tolist()} s: it leaves no frame that all bands have"
        raise ValueError(f"{label}. Must be in seconds, and the recordings overlap.")
    lost = [int(np.count_nonzero(~plan.valid)) for plan in plans]
    movie = _rows.lazy(aligned, counts) if lazy else counts.copy(data=aligned(slice(None)))
    result = _assembled(corrected, movie, times)
    factors = factors * schema.noise_factor(corrected)
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
        measured = [time_offset(corrected, band=name, search=search) for name in names[1:]]
        return np.array([0.0, *measured])
    if isinstance(offset, xr.DataArray):
        values = schema.band_values(offset, names, "the time offset", "s")
    else:
        if len(names) != 2:
            rule = "Must be one for each, (band)"
            raise ValueError(f"Invalid offset {offset} s for bands {names}. {rule}.")
        values = np.array([0.0, _numbers.real_number("offset [s]", offset)])
    if values[0] != 0 or not np.all(np.isfinite(values)):
        rule = f"Must be finite, and 0 in band '{names[0]}', the first"
        raise ValueError(f"Invalid offset {values.tolist()} s. {rule}.")
    return values


def _assembled(corrected: xr.Dataset, aligned: xr.DataArray, times: Array) -> xr.Dataset:
    """Capture with the aligned counts at the times of the reference."""
    old = [name for name, variable in corrected.data_vars.items() if "time" in variable.dims]
    result = corrected.drop_vars(set(old) - {"counts", "segment"})
    result = result.assign(counts=aligned.variable.copy(deep=False))
    attrs = schema.STAGES["corrected"]["counts"].attrs
    result["counts"].attrs = {**corrected["counts"].attrs, **attrs}
    result = result.assign_coords(time=("time", times, corrected["time"].attrs))
    return schema.check(result, "corrected")
