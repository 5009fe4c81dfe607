"""Resampling of all bands: views onto one pixel grid by polynomials, and onto one clock."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.sparse import csr_array, diags_array, eye_array

from dbthermal import _arrays, _numbers, _text, schema
from dbthermal._arrays import Array, Mask
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import _offset as lags
from dbthermal.alignment._splines import Movie
from dbthermal.schema import laid_on

TRANSFORM: Final = schema.Variable(
    ("band", "row", "column"), "float64", "1", "pixel of the first view to pixel of this one"
)
"""Transform of `register`: for each band a 3x3 homography on (x, y, 1), in pixels."""

MAP: Final = schema.Variable(
    ("band", "axis", "y", "x"), "float64", "pixel", "row and column of the first view's pixel here"
)
"""Transform of a curved surface: for each band where each pixel of the first view lies in it."""

# Pixels a side that make a sample between pixels: half-way 6 keep 95 % of a wave of four pixels and
# 99.7 % of seven, lines 71 and 90 %.
TAPS: Final = 6
_ROUNDING: Final = 1e-7  # weights that are rounding [1]
_MARGIN: Final = 0.1  # distance from the last pixel's centre at which its line holds [pixel]
_DIGITS: Final = 9  # of a rounded position, so that a border met exactly counts [pixel]
STEP: Final = 5.0  # standard deviations of noise of a step between two frames


def registered(corrected: xr.Dataset, transform: xr.DataArray, *, lazy: bool) -> xr.Dataset:
    """Capture with all views on the first one's grid, each band on its own clock."""
    result, shares = moved(corrected, _maps(transform, corrected), lazy=lazy)
    factors = shares * schema.noise_factor(corrected)
    result = result.assign(noise_factor=("band", factors, schema.NOISE_FACTOR.attrs))
    if "pattern_std" in result:
        result["pattern_std"] = result["pattern_std"] * shares
        result["pattern_std"].attrs.update(schema.PATTERN_STD.attrs)
    if "row" in transform.dims:
        names = [str(name) for name in corrected["band"].values]
        places = schema.band_positions(transform, names, "the transform")
        result.attrs["transform"] = transform.values[places].ravel().tolist()
    return result


def moved(corrected: xr.Dataset, maps: Sequence[Array], *, lazy: bool) -> tuple[xr.Dataset, Array]:
    """Views and status at other rows and columns, and the factor of each band's noise."""
    counts, status = corrected["counts"], corrected.get("status")
    flags = np.zeros(counts.shape[2:], dtype=np.uint8) if status is None else status.values
    weights = [_weights(places, flags > 0) for places in maps]

    def views(rows: slice) -> Movie:
        """Rows of all bands."""
        pairs = zip(counts, weights, strict=True)
        return np.stack([_warped(view, matrix, rows) for view, matrix in pairs])

    warped = _arrays.lazy(views, counts) if lazy else counts.copy(data=views(slice(None)))
    result = corrected.assign(counts=warped)
    if status is not None:
        result = result.assign(status=status.copy(data=_warped_status(flags, weights)))
    # Root mean square over the image, for pixels of independent noise.
    squares = [(matrix**2).sum(axis=1)[np.diff(matrix.indptr) > 0] for matrix in weights]
    return result, np.sqrt([np.mean(matrix) if matrix.size else 1.0 for matrix in squares])


def reflected(field: xr.Dataset, corrected: xr.Dataset) -> list[Array]:
    """Rows and columns (2, y, x) of one reflection in each band; NaN where it is unknown."""
    field = laid_on(field, corrected, "the reflection shift", "the capture")
    pixels = np.indices(corrected["counts"].shape[2:], dtype=np.float64)
    place = pixels + field["shift"].where(field["known"]).transpose("axis", "y", "x").values
    reference = str(field.attrs["reference_band"])
    return [place if str(band) == reference else pixels for band in corrected["band"].values]


def interpolation(places: Array, taps: int) -> csr_array:
    """Lagrange weights (pixel, pixel) [1] of `taps` pixels a side, for places (2, y, x) [pixel]."""
    shape, complete, factors = places.shape[1:], np.ones(places[0].size, dtype=bool), []
    for place, size in zip(places.reshape(2, -1), shape, strict=True):
        within, start, weight = lagrange(place, size, taps)
        # A place without enough neighbours has no weights, but for `_MARGIN`.
        complete &= within
        factors.append((weight, start[:, np.newaxis] + np.arange(taps, dtype=np.int32)))
    (down, row), (right, column) = factors
    weight = (down[:, :, np.newaxis] * right[:, np.newaxis]).astype(np.float32)
    pixel = row[:, :, np.newaxis] * shape[1] + column[:, np.newaxis]
    mask = complete[:, np.newaxis, np.newaxis] & (abs(weight) > _ROUNDING)
    ends = np.concatenate([[0], np.cumsum(mask.sum(axis=(1, 2)))])
    return csr_array((weight[mask], pixel[mask], ends), shape=(complete.size, complete.size))


def lagrange(place: Array, size: int, taps: int) -> tuple[Mask, npt.NDArray[np.int32], Array]:
    """Positions with enough neighbours on a line of pixels, the first one, and all weights."""
    nodes = np.arange(taps)
    spacing = nodes[:, np.newaxis] - nodes + np.eye(taps)
    complete = (place >= taps // 2 - 1 - _MARGIN) & (place <= size - taps // 2 + _MARGIN)
    position = np.where(complete, place, 0.0)
    start = np.clip(np.floor(position) - (taps // 2 - 1), 0, size - taps)
    away = (position - start)[:, np.newaxis] - nodes
    factors = np.where(np.eye(taps, dtype=bool), 1.0, away[:, np.newaxis, :])
    return complete, start.astype(np.int32), np.prod(factors / spacing, axis=2)


def positions(matrix: Array, shape: tuple[int, ...]) -> Array:
    r"""Row and column (2, y, x) [pixel], in another view, of the pixels of the first.

    .. math:: (x', y', 1)^T \propto H (x, y, 1)^T, counted from 0 at the centre of the first pixel.
    """
    rows, columns = np.indices(shape, dtype=np.float64)
    points = np.stack([columns, rows, np.ones_like(rows)])
    column, row, scale = np.einsum("ij,jyx->iyx", matrix, points)
    scale = np.where(scale * matrix[2, 2] > 0, scale, np.nan)  # else behind the camera
    return np.asarray(np.round(np.stack([row, column]) / scale, _DIGITS))


def single(counts: npt.NDArray[Any]) -> Movie:
    """Counts in single precision, NaN where they are infinite or beyond it."""
    return np.where(schema.measured(counts), counts, np.nan).astype(np.float32, copy=False)


def _maps(transform: xr.DataArray, corrected: xr.Dataset) -> list[Array]:
    """Rows and columns (2, y, x) in each view of the first one's pixels, in the capture's order."""
    names = [str(name) for name in corrected["band"].values]
    shape = corrected["counts"].shape[2:]
    array = schema.check_numbers(transform, "transform")
    expected = MAP if "axis" in array.dims else TRANSFORM
    schema.check_variable(transform, expected, "the transform")
    values = transform.values[schema.band_positions(transform, names, "the transform")]
    if expected is MAP:
        if values.shape[1:] != (2, *shape):
            rule = f"Must be {(2, *shape)} in each band, as the image"
            raise ValueError(f"Invalid transform of shape {values.shape[1:]}. {rule}.")
        return [*values.astype(np.float64)]
    if values.shape[1:] != (3, 3) or not np.all(np.isfinite(values)):
        rule = "Must be 3x3 and finite in each band"
        raise ValueError(f"Invalid transform of shape {values.shape}. {rule}.")
    return [positions(matrix, shape) for matrix in values.astype(np.float64)]


def _weights(places: Array, bad: Mask) -> csr_array:
    """Weights as `interpolation`, of lines near the border and near bad pixels."""
    if np.array_equal(places, np.indices(bad.shape)):
        return eye_array(bad.size, dtype=np.float32, format="csr")
    fine = interpolation(places, TAPS)
    border = (np.diff(fine.indptr) == 0) | (abs(fine) @ bad.ravel().astype(np.float32) > 0)
    coarse = interpolation(places, 2)
    keep, swap = (diags_array(rows.astype(np.float32)) for rows in (~border, border))
    result = csr_array(keep @ fine + swap @ coarse)
    result.eliminate_zeros()  # for a weight of 0 would pass a NaN on
    return result


def _warped(view: xr.DataArray, weights: csr_array, rows: slice) -> Movie:
    """Some rows (time, y, x) of the first view's pixels; NaN outside the view."""
    height, width = view.shape[1:]
    top, end, _ = rows.indices(height)
    block = csr_array(weights[top * width : end * width])
    result = np.full((len(view), end - top, width), np.nan, dtype=np.float32)
    if block.nnz == 0:
        return result
    first, last = block.indices.min() // width, block.indices.max() // width
    block = csr_array(block[:, first * width : (last + 1) * width])
    frames = single(view.isel(y=slice(first, last + 1)).values)
    covered = np.diff(block.indptr).reshape(end - top, width) > 0
    for frame, out in zip(frames, result, strict=True):
        out[covered] = (block @ frame.ravel()).reshape(covered.shape)[covered]
    return result


def _warped_status(flags: npt.NDArray[Any], weights: Sequence[csr_array]) -> npt.NDArray[Any]:
    """Bits (y, x) of every pixel that a warped one may be made of, in any of the views."""
    result = np.zeros_like(flags)
    for value in np.unique(flags[flags > 0]):
        bad = (flags == value).ravel().astype(np.float32)
        for matrix in weights:
            result[(abs(matrix) @ bad).reshape(flags.shape) > 0] |= value
    return result


def on_one_clock(
    corrected: xr.Dataset,
    *,
    offset: float | xr.DataArray | None = None,
    search: int = lags.SEARCH,
    clock: str | None = None,
    reflection_shift: xr.Dataset | None = None,
    lazy: bool = False,
    steps: float = STEP,
) -> xr.Dataset:
    """Registered views on one clock, see `align`; `steps` [standard deviation of noise]."""
    names = [str(name) for name in corrected["band"].values]
    counts, capture = corrected["counts"], corrected
    if reflection_shift is not None:
        schema.check(reflection_shift, "reflection_shift")
    if reflection_shift is not None and offset is None:
        capture, _ = moved(corrected, reflected(reflection_shift, corrected), lazy=lazy)
    offsets = _offsets(capture, offset, names, search)
    stamps = clocks.exposure_times(corrected) + offsets[:, np.newaxis]
    signals = lags.sample(corrected)
    for band in () if offset is None else range(1, len(names)):  # `time_offset` has done it
        pair = [0, band]
        lags.require_one_clock(corrected.isel(band=pair), signals[pair], stamps[pair])
    # The clock of the noisiest band, relative to its signal.
    noise, relative = lags.noise_levels(signals, stamps)
    _text.check_listed("Unknown clock", clock, [None, *names])
    reference = int(np.argmax(relative)) if clock is None else names.index(clock)
    times, segment = clocks.fill_times(stamps[reference]), schema.segments(corrected)
    # Plan the interpolation of each band, and how it reduces noise.
    plans, thin = [], -(-signals[0].size // lags.TELLING)
    factors, rapid = np.ones((2, len(names)))
    # Frames that are NaN, or a copy of the frame before, in every block of rows.
    blocks = (counts.isel(y=rows).values for rows in _arrays.blocks(counts.shape))
    copies = [[clocks.missing(single(film)) for film in block] for block in blocks]
    missing = np.all(copies, axis=0)
    for band, (row, absent) in enumerate(zip(stamps, missing, strict=True)):
        plan = clocks.interpolation(row, ~absent, times, segment)
        plan.valid[plan.labels(segment) != segment] = False
        shown = np.stack([signals[place, :, ::thin] for place in (reference, band)])
        plans.append(lags.bent(plan, shown, times, segment, np.sqrt(3.0) * steps * noise[band]))
        factors[band], rapid[band] = plans[band].noise_factors()

    def aligned(rows: slice) -> Movie:
        """Counts of some rows at the times of the reference."""
        movies = counts.isel(y=rows)
        result = np.empty(movies.shape, dtype=np.float32)
        for band, plan in enumerate(plans):
            movie = single(movies.isel(band=band).values)
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
    movie = _arrays.lazy(aligned, counts) if lazy else counts.copy(data=aligned(slice(None)))
    result = _assembled(corrected, movie, times)
    factors *= schema.noise_factor(corrected)
    result = result.assign(noise_factor=("band", factors, schema.NOISE_FACTOR.attrs))
    return result.assign_attrs(
        clock=names[reference],
        rapid_noise_factor=(rapid * corrected.attrs.get("rapid_noise_factor", 1.0)).tolist(),
        time_offset=offsets.tolist(),
        frames_lost=[int(np.count_nonzero(~plan.valid)) for plan in plans],
        pauses=clocks.pauses(times).ravel().tolist(),
    )


def _offsets(
    corrected: xr.Dataset, offset: float | xr.DataArray | None, names: list[str], search: int
) -> Array:
    """Offset of each band against the first [s]."""
    if offset is None:
        measured = [lags.time_offset(corrected, band=name, search=search) for name in names[1:]]
        return np.array([0.0, *measured])
    if isinstance(offset, xr.DataArray):
        values = schema.band_values(offset, names, "the time offset", "s")
    else:
        if len(names) != 2 or np.ndim(offset):
            rule = "Must be one for each: a number for two, or a DataArray (band), 0 in the first"
            raise ValueError(f"Invalid offset {offset!r:.60} s for bands {names}. {rule}.")
        values = np.array([0.0, _numbers.real_number("offset [s]", offset)])
    if values[0] != 0 or not np.all(np.isfinite(values)):
        rule = f"Must be finite, and 0 in band '{names[0]}', the first"
        raise ValueError(f"Invalid offset {values.tolist()} s. {rule}.")
    return values


def _assembled(corrected: xr.Dataset, aligned: xr.DataArray, times: Array) -> xr.Dataset:
    """Capture with the aligned counts at the times of the reference."""
    old = [name for name, variable in corrected.data_vars.items() if "time" in variable.dims]
    result = corrected.drop_vars({*old} - {"counts", "segment"}).assign(counts=aligned.variable)
    attrs = schema.STAGES["corrected"]["counts"].attrs
    result["counts"].attrs = {**corrected["counts"].attrs, **attrs}
    result = result.assign_coords(time=("time", times, corrected["time"].attrs))
    return schema.check(result, "corrected")
