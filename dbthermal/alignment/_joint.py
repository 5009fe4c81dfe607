"""Clocks of cameras compared jointly with the shift between the reflections that they see.

What moves one way before cameras side by side comes to a pixel of one view earlier, as by an
earlier clock. So the clocks are compared at places of the same reflection, whose shift is then
found anew, until neither changes. Of cameras at one place, where no shift is seen, the clocks are
those that all pixels tell: a delay beside a shift that is none would be the shift's error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.ndimage import distance_transform_edt, map_coordinates

from dbthermal import schema
from dbthermal._arrays import Mask, empty, quotient, release
from dbthermal._warnings import warned
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._offset import SEARCH, check, measured_offset
from dbthermal.alignment._reflections import Scale, seen_apart, shift_of
from dbthermal.alignment._resampling import STEP, on_one_clock
from dbthermal.schema import Status

# Pixels and frames, at most, of the means from which all is found that is of the whole image.
_PIXELS: Final = 20_000
_FRAMES: Final = 400
_COMMON: Final = 0.5  # share of a square's pixels that a frame must have
# Clocks that are tried, at most, and in a row without being better than one before.
_ROUNDS, _VAIN = 8, 2
_LATE: Final = 0.02  # clocks no further apart are the same [frame]
_FLAT: Final = 0.125  # least share of a delay that is taken to be seen [1]
# Uncertainty of the clocks, or difference from what was stated, from which it is said [frame].
_PRECISION: Final = 0.1
_SIGMAS: Final = 3.0  # standard deviations from which the images contradict what was stated
_SAME: Final = 0.5  # median shift of what both cameras see in one pixel [pixel]: 0.2, apart 2.0


@dataclass(frozen=True)
class Comparison:
    """Offset of each band's clock against the first, and how it was found."""

    offset: xr.DataArray  # (band) [s]
    std: float  # standard deviation of the largest uncertainty of them [s]
    field: xr.Dataset | None = None  # shift of the reflections; None where they are not apart
    doubts: tuple[str, ...] = ()

    def noted(self, aligned: xr.Dataset) -> xr.Dataset:
        """Capture on these clocks, with what was found beside them; doubts are warned of."""
        known = {"time_offset_std": self.std} if np.isfinite(self.std) else {}
        return warned(aligned.assign_attrs(known), *self.doubts)


def compare(
    corrected: xr.Dataset,
    scale: Scale | None = None,
    *,
    search: int = SEARCH,
    clock: str | None = None,
    lazy: bool = False,
    side_by_side: bool = True,
) -> Comparison:
    """Clocks of the cameras of registered views; those stated at the import if nothing contradicts.

    The scale of the bands is by default that of their own changes. Cameras that may not stand
    `side_by_side` are taken to stand at one place. ValueError where nothing tells the clocks, as
    `time_offset`.
    """
    names = [str(name) for name in corrected["band"].values]
    together = xr.DataArray(np.zeros(len(names)), {"band": names}, "band")
    if len(names) == 1:
        return Comparison(together, 0.0)
    for name in names[1:]:
        check(corrected, name, search)
    if side_by_side:
        result = _compared(corrected, scale, together, search=search, clock=clock, lazy=lazy)
    else:
        result = _at_one_place(corrected, search)
    if corrected.attrs.get("offset_by") != "caller":
        return result
    frame = clocks.frame_period(clocks.exposure_times(corrected)[0])
    off = float(result.offset.values[np.argmax(np.abs(result.offset.values))])
    if not abs(off) > max(_PRECISION * frame, _SIGMAS * result.std):  # or of no deviation
        return replace(result, offset=together, doubts=())
    told = f"by {off:.4f} +- {result.std:.4f} s, {off / frame:.2f} frames"
    doubt = (
        f"The stated offset of the recordings, {corrected.attrs.get('offset')} s, is contradicted "
        f"by the images {told}, which are followed. Give offset= [s] to align to keep it."
    )
    return replace(result, doubts=(*result.doubts, doubt))


def _at_one_place(corrected: xr.Dataset, search: int) -> Comparison:
    """Clocks of cameras at one place, which all pixels tell, of registered views."""
    names = [str(name) for name in corrected["band"].values]
    found = [measured_offset(corrected, name, search) for name in names[1:]]
    offsets = np.array([0.0, *(offset for offset, _ in found)])
    return Comparison(xr.DataArray(offsets, {"band": names}, "band"), max(std for _, std in found))


def apart(
    corrected: xr.Dataset, scale: Scale, offset: float | xr.DataArray, **options: Any
) -> xr.Dataset | None:
    """Shift of the reflections at an offset that is stated; None where they are not apart."""
    small, resample = _reduced(corrected, **options)
    field = _shift(resample(small, offset=offset), scale)
    field = None if field is None else _enlarged(field, corrected)
    return field if field is not None and seen_apart(field) else None


def _reduced(corrected: xr.Dataset, **options: Any) -> tuple[xr.Dataset, Callable[..., xr.Dataset]]:
    """Capture in which is found what is of the whole image, and how it is resampled."""
    steps = STEP * _side(corrected["counts"])
    return _of_squares(corrected), partial(on_one_clock, **options, steps=steps)


def _compared(
    corrected: xr.Dataset, scale: Scale | None, together: xr.DataArray, **options: Any
) -> Comparison:
    """Clocks that the images tell."""
    stamps = clocks.exposure_times(corrected)
    clocks.require_steady(stamps, [str(name) for name in corrected["band"].values])
    small, resample = _reduced(corrected, **options)
    try:
        scale = Scale.of_changes(small) if scale is None else scale
    except ValueError:  # without noise nothing tells a shift
        return _at_one_place(corrected, options["search"])
    offset, field, left = _clocked(small, scale, together, resample)
    wide = None if field is None else _enlarged(field, corrected)
    if field is None or wide is None or not seen_apart(wide):
        return _at_one_place(corrected, options["search"])
    # A false shift may go with a false delay: then one place and its clocks explain more.
    try:
        plain = _at_one_place(corrected, options["search"])
        rival = _shift(resample(small, offset=plain.offset), scale)
    except ValueError:
        rival = None
    shift = np.inf if rival is None else np.nanmedian(np.hypot(*rival["shift"].values))
    if shift < _SAME and rival is not None and np.diff(_explained(field, rival)) > 0.0:
        return plain
    frame = clocks.frame_period(stamps[0])
    if left <= _PRECISION * frame:
        return Comparison(offset, left, wide)
    off = f"{left / frame:.2g}" if np.isfinite(left) else "an unknown number of"
    doubt = (
        f"The offset found between the cameras' clocks may be off by {off} frames, more than "
        f"{_PRECISION:g}: what moves fast may be wrong without a flag. Give it [s] if known."
    )
    return Comparison(offset, left, wide, (doubt,))


def _explained(*fields: xr.Dataset) -> tuple[float, ...]:
    """Share of the others' energy that each of two shifts explains, in the pixels of both."""
    known = np.all([one["known"].values for one in fields], axis=0)
    sums = [one["energy"].values[:, known].sum(axis=1) for one in fields]
    return tuple(float(explained / max(energy, 1e-9)) for explained, energy in sums)


def _clocked(
    small: xr.Dataset,
    scale: Scale,
    together: xr.DataArray,
    resample: Callable[..., xr.Dataset],
) -> tuple[xr.DataArray, xr.Dataset | None, float]:
    """Offsets of the clocks, the shift of the reflections, and what clocks are off by [s]."""
    names, tried = small["band"].values, list[_Trial]()

    def at(**how: Any) -> tuple[xr.DataArray, xr.Dataset | None]:
        aligned = resample(small, **how)
        offset, field = together.copy(data=aligned.attrs["time_offset"]), _shift(aligned, scale)
        if field is not None and np.isfinite(field.attrs["delay"]):
            tried.append(_Trial(offset, names != field.attrs["reference_band"], field))
        return offset, field

    _, field = at(offset=together)
    if field is None:
        return together, None, np.nan
    first, frame = tried.copy(), clocks.frame_period(clocks.exposure_times(small)[0])
    tried.clear()
    try:
        offset, field = at(reflection_shift=field)
    except ValueError:  # the shift of clocks that are far off may be a false one
        if not first or (trial := _next(first, frame)) is None:
            raise
        offset, field = at(offset=trial)
    while tried and field is tried[-1].field:  # the last one told a delay
        if (trial := _next(tried, frame)) is None:
            break
        offset, field = at(offset=trial)
    if not tried:
        return offset, field, np.nan
    best, step = _step(tried, frame)
    # A delay that is not seen is known no better than by its deviation.
    return best.offset, best.field, float(np.hypot(step, best.field.attrs["delay_std"]))


@dataclass(frozen=True, eq=False)
class _Trial:
    """Offsets of the bands' clocks [s], and the shift of the reflections found with them."""

    offset: xr.DataArray
    others: Mask  # bands but the reference of the shift
    field: xr.Dataset

    @property
    def late(self) -> float:
        """Time by which the others are seen late with these clocks [s]."""
        return float(self.field.attrs["delay"])

    @property
    def clock(self) -> float:
        """Offset of the others from the reference [s]."""
        offset = self.offset.values
        return float(offset[self.others].mean() - offset[~self.others].mean())


def _step(tried: Sequence[_Trial], frame: float) -> tuple[_Trial, float]:
    """Trial with the least delay, and the step of the others' clocks that ends it [s]."""
    best = min(tried, key=lambda one: abs(one.late))
    rest = [
        one
        for one in tried
        if np.array_equal(one.others, best.others) and abs(one.clock - best.clock) >= _LATE * frame
    ]
    beyond = [one for one in rest if one.late * best.late < 0.0]
    slope = 1.0
    if rest:  # Newton's steps are short beside noise: from the second on they are a secant's
        near = min(beyond or rest, key=lambda one: abs(one.clock - best.clock))
        slope = (near.late - best.late) / (best.clock - near.clock)
    if not slope > 0.0:
        slope = 1.0
    elif not beyond:
        slope = float(np.clip(slope, _FLAT, 1.0))
    return best, best.late / slope


def _next(tried: Sequence[_Trial], frame: float) -> xr.DataArray | None:
    """Offsets of the clocks to be tried next [s]; None if they, or enough others, have been."""
    best, step = _step(tried, frame)
    if len(tried) >= _ROUNDS or len(tried) - 1 - tried.index(best) >= _VAIN:
        return None
    behind = step * best.others
    offset = best.offset.copy(data=best.offset.values + behind - behind[0])
    known = any(float(abs(offset - one.offset).max()) < _LATE * frame for one in tried)
    return None if known else offset


def _shift(aligned: xr.Dataset, scale: Scale) -> xr.Dataset | None:
    """Shift of the reflections over all pixels; None where nothing tells it."""
    try:
        field = shift_of(*_of_means(aligned, scale))
    except ValueError:  # as where nothing moves, or the image is too small
        return None
    return field if bool(field["known"].any()) else None


def _side(counts: xr.DataArray) -> int:
    """Side of the squares [pixel] of which what is of the whole image is found."""
    return int(np.ceil(np.sqrt(max(1.0, counts[0, 0].size / _PIXELS))))


def _of_squares(corrected: xr.Dataset) -> xr.Dataset:
    """Capture of means over squares of pixels, if its image is large, each band on its own clock.

    Of each pixel's changes about its own mean: one that lacks a sample does not move the others'.
    """
    counts, side = corrected["counts"], _side(corrected["counts"])
    if side == 1:
        return corrected
    bands, frames, height, width = (*counts.shape[:2], *(n // side for n in counts.shape[2:]))
    film, seen = empty((bands, frames, height, width), np.float32), np.zeros((height, width), bool)
    bad = np.zeros(counts.shape[2:], dtype=bool)
    if "status" in corrected:
        bad = (corrected["status"].values & int(schema.UNMEASURED)) != 0
    for row in range(height):
        part = slice(row * side, (row + 1) * side), slice(0, width * side)
        values = counts[:, :, *part].values
        here = schema.measured(values) & ~bad[part]
        own = np.where(here, values, 0.0).sum(axis=1, dtype=np.float64)
        own = quotient(own, here.sum(axis=1), np.nan)
        told = np.isfinite(own).all(axis=0)  # of all bands the same pixels
        here &= told
        change = np.where(here, values - own[:, np.newaxis], 0.0)
        squares = (bands, -1, side, width, side)
        number = here.reshape(squares).sum(axis=(2, 4))
        changes = quotient(change.reshape(squares).sum(axis=(2, 4)), number, np.nan)
        all_told = told.reshape(side, width, side).sum(axis=(0, 2))
        levels = np.where(told, own, 0.0).reshape(bands, 1, side, width, side).sum(axis=(2, 4))
        common = number > _COMMON * all_told
        film[:, :, row] = np.where(common, changes + quotient(levels, all_told, np.nan), np.nan)
        seen[row] = all_told > 0
        release()
    dims, attrs = counts.dims, counts.attrs
    return corrected.drop_dims(["y", "x"]).assign(
        counts=(dims, film, attrs),
        status=(dims[2:], np.where(seen, 0, Status.DEAD_PIXEL).astype(np.uint32)),
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
    first = segment.values[np.arange(segment.size) // length * length]
    rows = []
    for top in range(counts.sizes["y"]):
        block = counts[:, :, top : top + 1].astype(np.float64)
        # Of all bands the same samples, on one side of a shutter event.
        valid = schema.measured(block).all("band") & (segment == first)
        rows.append(block.where(valid).coarsen(time=length, boundary="trim").mean())
    mean = xr.Dataset(
        {
            "counts": xr.concat(rows, "y").astype(np.float32).assign_attrs(counts.attrs),
            "segment": ("time", first[: rows[0].sizes["time"] * length : length]),
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
    near = tuple(
        np.clip(np.rint(place).astype(np.intp), 0, size - 1)
        for place, size in zip(places, field["known"].shape, strict=True)
    )
    lost = np.isnan(field["shift"].values).any(axis=0)
    nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
    values = {"known": (field["known"].dims, field["known"].values[near], field["known"].attrs)}
    for name in ("shift", "shift_std"):
        filled = field[name].values[:, nearest[0], nearest[1]]
        wide = side * np.stack(
            [map_coordinates(one, places, order=1, mode="nearest") for one in filled]
        )
        values[name] = (field[name].dims, np.where(lost[near], np.nan, wide), field[name].attrs)
    here = {dim: aligned[dim] for dim in ("y", "x") if dim in aligned.coords}
    return xr.Dataset(values, coords={"axis": field["axis"], **here}, attrs=field.attrs)
