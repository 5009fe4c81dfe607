"""Clocks of cameras compared jointly with the shift between the reflections that they see.

What moves before cameras side by side comes to a pixel of one view earlier, as by an earlier clock.
So the clocks are compared at places of the same reflection, whose shift is then estimated anew,
until neither changes. Without a shift the clocks are those of all pixels.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.ndimage import distance_transform_edt, map_coordinates

from dbthermal import schema
from dbthermal._arrays import Mask, empty, quotient, release
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._offset import SEARCH, check, measured_offset
from dbthermal.alignment._planes import Scale
from dbthermal.alignment._reflections import seen_apart, shift_of
from dbthermal.alignment._resampling import STEP, on_one_clock
from dbthermal.schema import Status, warned

_PIXELS, _FRAMES = 20_000, 400  # of the capture of means that gives clocks and shift, at most
_COVERAGE: Final = 0.5  # share of a square's pixels that a frame must have
_ROUNDS, _VAIN = 8, 2  # clocks that are tried, at most, and in a row without improvement
_TOLERANCE: Final = 0.02  # difference below which clocks are the same [frame]
_FLAT: Final = 0.125  # least share of a delay that is taken to be seen [1]
# Uncertainty of the clocks, or difference from a stated offset, that gives a warning [frame].
_PRECISION: Final = 0.1
_SIGMAS: Final = 3.0  # standard deviations from which the images contradict a stated offset
_SAME: Final = 0.5  # median shift of cameras at one place, at most [pixel]: 0.2, displaced 2.0


@dataclass(frozen=True)
class Comparison:
    """Offset of each band's clock against the first, and how it was found."""

    offset: xr.DataArray  # (band) [s]
    std: float  # standard deviation of the least certain offset [s]
    field: xr.Dataset | None = None  # shift of the reflections; None where they are not apart
    doubts: tuple[str, ...] = ()

    def noted(self, aligned: xr.Dataset) -> xr.Dataset:
        """Capture with the standard deviation of its clocks; doubts become warnings."""
        deviation = {"time_offset_std": self.std} if np.isfinite(self.std) else {}
        return warned(aligned.assign_attrs(deviation), *self.doubts)


def compare(
    corrected: xr.Dataset,
    scale: Scale | None = None,
    *,
    search: int = SEARCH,
    clock: str | None = None,
    lazy: bool = False,
) -> Comparison:
    """Clocks of the cameras of registered views; the stated ones unless the images contradict.

    The scale is by default that of changes. ValueError, as `time_offset`, if nothing tells clocks.
    """
    names = [str(name) for name in corrected["band"].values]
    synchronous = xr.DataArray(np.zeros(len(names)), {"band": names}, "band")
    if len(names) == 1:
        return Comparison(synchronous, 0.0)
    for name in names[1:]:
        check(corrected, name, search)
    result = _compared(corrected, scale, synchronous, search=search, clock=clock, lazy=lazy)
    if corrected.attrs.get("offset_by") != "caller":
        return result
    frame = clocks.frame_period(clocks.exposure_times(corrected)[0])
    largest = float(result.offset.values[np.argmax(np.abs(result.offset.values))])
    if not abs(largest) > max(_PRECISION * frame, _SIGMAS * result.std):  # or of no deviation
        return replace(result, offset=synchronous, doubts=())
    contradiction = f"by {largest:.4f} +- {result.std:.4f} s, {largest / frame:.2f} frames"
    doubt = (
        f"The stated offset of the recordings, {corrected.attrs.get('offset')} s, is contradicted "
        f"by the images {contradiction}, which are followed. Give offset= [s] to align to keep it."
    )
    return replace(result, doubts=(*result.doubts, doubt))


def _at_one_place(corrected: xr.Dataset, search: int) -> Comparison:
    """Clocks of cameras at one place, from all pixels of registered views."""
    names = [str(name) for name in corrected["band"].values]
    pairs = [measured_offset(corrected, name, search) for name in names[1:]]
    offsets = np.array([0.0, *(offset for offset, _ in pairs)])
    return Comparison(xr.DataArray(offsets, {"band": names}, "band"), max(std for _, std in pairs))


def apart(
    corrected: xr.Dataset, scale: Scale, offset: float | xr.DataArray, **options: Any
) -> xr.Dataset | None:
    """Shift of the reflections at a stated offset; None if they are not displaced."""
    small, resample = _reduced(corrected, **options)
    field = _shift(resample(small, offset=offset), scale)
    field = None if field is None else _enlarged(field, corrected)
    return field if field is not None and seen_apart(field) else None


def _reduced(corrected: xr.Dataset, **options: Any) -> tuple[xr.Dataset, Callable[..., xr.Dataset]]:
    """Capture of means over squares of pixels, and how it is resampled."""
    steps = STEP * _side(corrected["counts"])
    return _of_squares(corrected), partial(on_one_clock, **options, steps=steps)


def _compared(
    corrected: xr.Dataset, scale: Scale | None, synchronous: xr.DataArray, **options: Any
) -> Comparison:
    """Clocks from the images."""
    stamps = clocks.exposure_times(corrected)
    clocks.require_steady(stamps, [str(name) for name in corrected["band"].values])
    small, resample = _reduced(corrected, **options)
    try:
        scale = Scale.of_changes(small) if scale is None else scale
    except ValueError:  # without noise nothing tells a shift
        return _at_one_place(corrected, options["search"])
    # Compare clocks and shift in the reduced picture.
    offset, field, uncertainty = _clocked(small, scale, synchronous, resample)
    full_field = None if field is None else _enlarged(field, corrected)
    if field is None or full_field is None or not seen_apart(full_field):
        return _at_one_place(corrected, options["search"])
    # A false shift may go with a false delay: then one place and its clocks explain more.
    with suppress(ValueError):
        at_one_place = _at_one_place(corrected, options["search"])
        rival = _shift(resample(small, offset=at_one_place.offset), scale)
        better = rival is not None and rival.attrs["explained"] > field.attrs["explained"]
        if rival is not None and better and np.nanmedian(np.hypot(*rival["shift"].values)) < _SAME:
            return at_one_place
    frame = clocks.frame_period(stamps[0])
    if uncertainty <= _PRECISION * frame:
        return Comparison(offset, uncertainty, full_field)
    count = f"{uncertainty / frame:.2g}" if np.isfinite(uncertainty) else "an unknown number of"
    doubt = (
        f"The offset found between the cameras' clocks may be off by {count} frames, more than "
        f"{_PRECISION:g}: what moves fast may be wrong without a flag. Give it [s] if known."
    )
    return Comparison(offset, uncertainty, full_field, (doubt,))


def _clocked(
    small: xr.Dataset, scale: Scale, synchronous: xr.DataArray, resample: Callable[..., xr.Dataset]
) -> tuple[xr.DataArray, xr.Dataset | None, float]:
    """Offsets of the clocks, shift of the reflections, uncertainty [s]."""
    names, trials = small["band"].values, list[_Trial]()

    def compare_at(**clock: Any) -> tuple[xr.DataArray, xr.Dataset | None]:
        aligned = resample(small, **clock)
        offset, field = synchronous.copy(data=aligned.attrs["time_offset"]), _shift(aligned, scale)
        if field is not None and np.isfinite(field.attrs["delay"]):
            trials.append(_Trial(offset, names != field.attrs["reference_band"], field))
        return offset, field

    _, field = compare_at(offset=synchronous)
    if field is None:
        return synchronous, None, np.nan
    synchronous_trials, frame = trials.copy(), clocks.frame_period(clocks.exposure_times(small)[0])
    trials.clear()
    try:
        offset, field = compare_at(reflection_shift=field)
    except ValueError:  # the shift of clocks that are far off may be a false one
        if not synchronous_trials or (trial := _next(synchronous_trials, frame)) is None:
            raise
        offset, field = compare_at(offset=trial)
    while trials and field is trials[-1].field:  # the last trial has a delay
        if (trial := _next(trials, frame)) is None:
            break
        offset, field = compare_at(offset=trial)
    if not trials:
        return offset, field, np.nan
    best, step = _step(trials, frame)
    # The uncertainty is at least the standard deviation of the delay.
    uncertainty = float(np.hypot(step, best.field.attrs["delay_std"]))
    return best.offset, best.field, uncertainty


@dataclass(frozen=True, eq=False)
class _Trial:
    """Offsets of the bands' clocks [s], and the shift of the reflections found with them."""

    offset: xr.DataArray
    late_bands: Mask  # bands but the reference of the shift
    field: xr.Dataset

    @property
    def delay(self) -> float:
        """Delay that remains with these clocks [s]."""
        return float(self.field.attrs["delay"])

    @property
    def clock(self) -> float:
        """Offset of the late bands from the reference [s]."""
        offset = self.offset.values
        return float(offset[self.late_bands].mean() - offset[~self.late_bands].mean())


def _step(trials: Sequence[_Trial], frame: float) -> tuple[_Trial, float]:
    """Trial with the least delay, and the step of its clocks that removes the delay [s]."""
    best = min(trials, key=lambda trial: abs(trial.delay))
    peers = [trial for trial in trials if np.array_equal(trial.late_bands, best.late_bands)]
    distinct = [trial for trial in peers if abs(trial.clock - best.clock) >= _TOLERANCE * frame]
    opposite = [trial for trial in distinct if trial.delay * best.delay < 0.0]
    slope = 1.0
    # Newton's steps are short beside noise: from the second on they are a secant's.
    if distinct:
        neighbour = min(opposite or distinct, key=lambda trial: abs(trial.clock - best.clock))
        slope = (neighbour.delay - best.delay) / (best.clock - neighbour.clock)
    if not slope > 0.0:
        slope = 1.0
    elif not opposite:
        slope = float(np.clip(slope, _FLAT, 1.0))
    return best, best.delay / slope


def _next(trials: Sequence[_Trial], frame: float) -> xr.DataArray | None:
    """Offsets of the clocks to be tried next [s]; None when the trials end."""
    best, step = _step(trials, frame)
    if len(trials) >= _ROUNDS or len(trials) - 1 - trials.index(best) >= _VAIN:
        return None
    change = step * best.late_bands
    offset = best.offset.copy(data=best.offset.values + change - change[0])
    repeated = any(float(abs(offset - trial.offset).max()) < _TOLERANCE * frame for trial in trials)
    return None if repeated else offset


def _shift(aligned: xr.Dataset, scale: Scale) -> xr.Dataset | None:
    """Shift of the reflections over all pixels; None if it cannot be estimated."""
    try:
        field = shift_of(*_of_means(aligned, scale))
    except ValueError:  # as where nothing moves, or the image is too small
        return None
    return field if bool(field["known"].any()) else None


def _side(counts: xr.DataArray) -> int:
    """Side of the squares [pixel] over which the image is averaged."""
    return int(np.ceil(np.sqrt(max(1.0, counts[0, 0].size / _PIXELS))))


def _of_squares(corrected: xr.Dataset) -> xr.Dataset:
    """Capture of means over squares of pixels of a large image, each band on its own clock."""
    counts, side = corrected["counts"], _side(corrected["counts"])
    if side == 1:
        return corrected
    bands, frames, height, width = (*counts.shape[:2], *(n // side for n in counts.shape[2:]))
    film = empty((bands, frames, height, width), np.float32)
    covered = np.zeros((height, width), bool)
    bad = (schema.pixel_status(corrected) & np.uint32(schema.UNMEASURED)) != 0
    for row in range(height):
        window = slice(row * side, (row + 1) * side), slice(0, width * side)
        values = counts[:, :, *window].values
        valid = schema.measured(values) & ~bad[window]
        means = np.where(valid, values, 0.0).sum(axis=1, dtype=np.float64)
        means = quotient(means, valid.sum(axis=1), np.nan)
        measured = np.isfinite(means).all(axis=0)  # the same pixels in all bands
        valid &= measured
        change = np.where(valid, values - means[:, np.newaxis], 0.0)
        squares = (bands, -1, side, width, side)
        number = valid.reshape(squares).sum(axis=(2, 4))
        changes = quotient(change.reshape(squares).sum(axis=(2, 4)), number, np.nan)
        pixels = measured.reshape(side, width, side).sum(axis=(0, 2))
        levels = np.where(measured, means, 0.0).reshape(squares).sum(axis=(2, 4))
        common = number > _COVERAGE * pixels
        film[:, :, row] = np.where(common, changes + quotient(levels, pixels, np.nan), np.nan)
        covered[row] = pixels > 0
        release()
    dims, attrs = counts.dims, counts.attrs
    return corrected.drop_dims(["y", "x"]).assign(
        counts=(dims, film, attrs),
        status=(dims[2:], np.where(covered, 0, Status.DEAD_PIXEL).astype(np.uint32)),
        # Neighbours that a registration made of the same pixels have their mean's noise together.
        noise_factor=("band", np.full(bands, 1.0 / side), schema.NOISE_FACTOR.attrs),
    )


def _of_means(aligned: xr.Dataset, scale: Scale) -> tuple[xr.Dataset, Scale]:
    """Capture of means over frames, if it is long, and its scale."""
    length = aligned.sizes["time"] // _FRAMES
    if length <= 1:
        return aligned.load(), scale
    counts = aligned.drop_vars(["y", "x"], errors="ignore")["counts"]
    segment = aligned.get("segment", xr.zeros_like(aligned["time"], dtype=np.int32))
    labels = segment.values[np.arange(segment.size) // length * length]
    rows = []
    for top in range(counts.sizes["y"]):
        block = counts[:, :, top : top + 1].astype(np.float64)
        # The same samples in all bands, on one side of a shutter event.
        valid = schema.measured(block).all("band") & (segment == labels)
        rows.append(block.where(valid).coarsen(time=length, boundary="trim").mean())
    mean = xr.Dataset(
        {
            "counts": xr.concat(rows, "y").astype(np.float32).assign_attrs(counts.attrs),
            "segment": ("time", labels[: rows[0].sizes["time"] * length : length]),
        },
        attrs=aligned.attrs,
    )
    if "status" in aligned:
        mean["status"] = aligned["status"].variable
    # Interpolated samples are not independent: the noise of their means is that of the means.
    return mean, replace(scale, noise=None)


def _enlarged(field: xr.Dataset, aligned: xr.Dataset) -> xr.Dataset:
    """Field of a capture `_of_squares` over the pixels of the whole one."""
    side, shape = _side(aligned["counts"]), (aligned.sizes["y"], aligned.sizes["x"])
    if side == 1:
        return field
    # The centre of a square of n pixels is n - 1 half pixels from that of its first.
    places = (np.indices(shape) - 0.5 * (side - 1)) / side
    ends = np.reshape(field["known"].shape, (2, 1, 1)) - 1
    squares = tuple(np.minimum(np.indices(shape) // side, ends))
    missing = np.isnan(field["shift"].values).any(axis=0)
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    values = {"known": (field["known"].dims, field["known"].values[squares], field["known"].attrs)}
    for name in ("shift", "shift_std"):
        filled = field[name].values[:, nearest[0], nearest[1]]
        enlarged = [map_coordinates(plane, places, order=1, mode="nearest") for plane in filled]
        planes = np.where(missing[squares], np.nan, side * np.stack(enlarged))
        values[name] = (field[name].dims, planes, field[name].attrs)
    coordinates = {dim: aligned[dim] for dim in ("y", "x") if dim in aligned.coords}
    return xr.Dataset(values, coords={"axis": field["axis"], **coordinates}, attrs=field.attrs)
