"""A scene as two cameras record it: from raw counts to temperatures in one call.

`separate_capture` does in their order what `correction`, `alignment` and `separation` do step by
step. With a target on disk its films are there, too, and it works in the memory of some rows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from inspect import signature
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
import xarray as xr
from scipy.ndimage import distance_transform_edt, map_coordinates

from dbthermal import _rows, schema, store
from dbthermal._arrays import Mask, empty, made_on_disk, on_disk, quotient, release
from dbthermal._warnings import warned
from dbthermal.alignment import align, reflection_shift, register
from dbthermal.alignment._reflections import seen_apart
from dbthermal.alignment._resampling import STEP, on_one_clock
from dbthermal.alignment._views import registered
from dbthermal.correction import correct_capture
from dbthermal.schema import Status
from dbthermal.separation import separate
from dbthermal.separation._separate import cameras_apart
from dbthermal.store._results import check_place

__all__ = ["separate_capture"]
__dir__ = __all__.copy

# Pixels and frames, at most, of the means from which all is found that is of the whole image.
_PIXELS: Final = 20_000
_FRAMES: Final = 400
_COMMON: Final = 0.5  # share of a square's pixels that a frame must have
# Clocks that are tried, at most, and in a row without being better than one before.
_ROUNDS, _VAIN = 8, 2
_LATE: Final = 0.02  # clocks no further apart are the same [frame]
_FLAT: Final = 0.125  # least share of a delay that is taken to be seen [1]
_PRECISION: Final = 0.1  # step that is left, up to which the clocks pass as known [frame]
_STEPS: Final[tuple[Callable[..., Any], ...]] = (correct_capture, align, separate)
SAMPLE: Final = 220
"""Memory that a sample of a pixel takes at most while it is separated in memory [byte]."""


def separate_capture(  # noqa: PLR0913 - the options of each step, by name
    capture: xr.Dataset,
    correction: xr.Dataset,
    response: xr.Dataset,
    *,
    registration: Literal["translation", "affine", "homography"] | None = "homography",
    correcting: Mapping[str, Any] = MappingProxyType({}),
    aligning: Mapping[str, Any] = MappingProxyType({}),
    separating: Mapping[str, Any] = MappingProxyType({}),
    target: str | Path | None = None,
    provenance: Mapping[str, Any] = MappingProxyType({}),
) -> xr.Dataset:
    """Raw counts of two cameras to temperatures, emissivities and reflections: every step in order.

    1. `correction.correct_capture`.
    2. `alignment.register`, `align` and `reflection_shift`. Where the cameras stand apart, the
       clocks are compared where both see the same reflection, and its shift is then found anew.
    3. `separation.separate`.

    Clocks and shift are found in a reduced picture, of means over some pixels and frames, if the
    capture is large. Errors as the steps; ImportError without OpenCV, for a registration.

    Parameters
    ----------
    capture : Dataset
        Stage `capture` of `schema`, raw. With a `target` it may be lazy, as from
        `store.open_dataset`; it is then read by rows, several times.
    correction : Dataset
        From `correction.fit_correction`.
    response : Dataset
        From `calibration.fit_response`, with its `noise`.
    registration : {"translation", "affine", "homography"}, optional
        Kind of transform between the views, see `alignment.register`; None if they are on one grid
        already. A `transform` in `aligning` takes its place.
    correcting, aligning, separating : mapping, optional
        Options by name of `correction.correct_capture`, `alignment.align` and
        `separation.separate`, such as ``{"offset": 0.0}`` [s] for cameras with one clock.
    target : str or Path, optional
        Folder ``*.zarr`` for the result. What is computed on the way is then in files beside it,
        which vanish with the process: some 64 bytes for each pixel and frame, and for up to 2048
        pixels of each material as much again.
    provenance : mapping, optional
        For the `target`, see `store.save`.

    Returns
    -------
    Dataset
        As from `separation.separate`, on the first band's grid, and `reflection_shift`
        (axis, y, x) [pixel] where the cameras see reflections apart. Attributes of the alignment:
        `clock`, `time_offset` [s], `frames_lost`, `transform`. From a `target` it is lazy.

    Warns
    -----
    UserWarning
        As the steps; and where the clocks of cameras apart seem to be off by more than a tenth of a
        frame still.

    Examples
    --------
    A plate of glass, simulated, from raw counts; both cameras look through one window:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import calibration, correction, simulation
    >>> rig, rng, shape = simulation.Rig(), np.random.default_rng(1), (24, 24)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(150) / 10, shape, glass, rng)
    >>> detector = simulation.pattern(rig, shape, rng)
    >>> movies = simulation.blackbody_movies(rig, np.linspace(275, 345, 6), 16, detector, rng)
    >>> raw = simulation.capture(simulation.observe(scene, rig.response(), rng), detector)
    >>> statistics = correction.blackbody_statistics(movies)
    >>> fitted = correction.fit_correction(statistics)
    >>> response = calibration.fit_response(fitted["level"], statistics["noise"])
    >>> options = {"registration": None, "aligning": {"offset": 0.0}}
    >>> result = separate_capture(raw, fitted, response, **options)
    >>> error = result["object_temperature"] - scene["object_temperature"]
    >>> bool(abs(error).median() < 0.3)  # K
    True
    """
    for step, options in zip(_STEPS, (correcting, aligning, separating), strict=True):
        _check_options(step, options)
    if target is not None:
        place = check_place(target, ".zarr").absolute().parent
        place.mkdir(parents=True, exist_ok=True)
        with on_disk(place):
            result = separate_capture(
                capture,
                correction,
                response,
                registration=registration,
                correcting=correcting,
                aligning=aligning,
                separating=separating,
            )
            blocks = _rows.blocks(result["object_temperature"].shape)
            parts = (_let_go(result.isel(y=rows)) for rows in blocks)
            store.save_rows(parts, target, provenance or store.provenance({}))
        return store.open_dataset(target)
    lazy = made_on_disk()
    corrected = correct_capture(capture, correction, lazy=lazy, **correcting)
    if registration is not None and "transform" not in aligning:
        aligning = {**aligning, "transform": register(corrected, model=registration)}
    aligned, field = _aligned(corrected, response, {**aligning, "lazy": lazy})
    del corrected
    result = separate(aligned, response, **{"reflection_shift": field, **separating})
    kept = ("clock", "time_offset", "frames_lost", "transform")
    attrs = {name: aligned.attrs[name] for name in kept if name in aligned.attrs}
    maps = {} if field is None else {"reflection_shift": field["shift"]}
    return result.assign(maps).assign_attrs(attrs)


def _check_options(step: Callable[..., Any], options: Any) -> None:
    """Refuse what is no mapping of options that a step has by name, and is not given here."""
    name = step.__name__
    if not isinstance(options, Mapping):
        kind = type(options).__name__
        raise TypeError(f"Invalid options of '{name}' of type {kind}. Must be a mapping by name.")
    by_name = [one for one in signature(step).parameters.values() if one.kind is one.KEYWORD_ONLY]
    known = [one.name for one in by_name if one.name != "lazy"]
    for option in options:
        if option not in known:
            raise TypeError(f"Unknown option {option!r} of '{name}'. Must be one of {known}.")


def _let_go(part: xr.Dataset) -> xr.Dataset:
    """Rows of a result, when those before need no more memory."""
    release()
    return part


def _aligned(
    corrected: xr.Dataset, response: xr.Dataset, options: Mapping[str, Any]
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Capture on one clock, and the shift of its reflections; None where they are not apart."""
    options = dict(options)
    if "transform" in options:
        corrected = registered(corrected, options.pop("transform"), lazy=bool(options.get("lazy")))
    small = _of_squares(corrected)
    if small is corrected:
        aligned, field, left = _clocked(corrected, response, options, align)
    else:  # what is of the whole image is found of the small one
        resample = partial(on_one_clock, steps=STEP * _side(corrected["counts"]))
        aligned, field, left = _clocked(small, response, options, resample)
        names = corrected["band"].values
        offset = xr.DataArray(aligned.attrs["time_offset"], {"band": names}, "band")
        aligned = align(corrected, **{**options, "offset": offset})
        field = None if field is None else _enlarged(field, corrected)
    if field is None or not (seen_apart(field) and cameras_apart(aligned, response)[0] > 0.0):
        return aligned, None
    if not left <= _PRECISION:
        off = f"{left:.2g}" if np.isfinite(left) else "an unknown number of"
        aligned = warned(
            aligned,
            f"The offset found between the cameras' clocks may be off by {off} frames, more than "
            f"{_PRECISION:g}: what moves fast may be wrong without a flag. Give it [s] if known.",
        )
    return aligned, field


def _clocked(
    corrected: xr.Dataset,
    response: xr.Dataset,
    options: Mapping[str, Any],
    resample: Callable[..., xr.Dataset],
) -> tuple[xr.Dataset, xr.Dataset | None, float]:
    """Capture on one clock, the shift of its reflections, and what clocks are off by [frame]."""
    names, tried = corrected["band"].values, list[_Trial]()
    together = xr.DataArray(np.zeros(names.size), dims="band", coords={"band": names})

    def at(**how: Any) -> tuple[xr.Dataset, xr.Dataset | None]:
        aligned = resample(corrected, **{**options, **how})
        field = _shift(aligned, response)
        if field is not None and np.isfinite(field.attrs["delay"]):
            offset = together.copy(data=aligned.attrs["time_offset"])
            tried.append(_Trial(offset, names != field.attrs["reference_band"], field))
        return aligned, field

    aligned, field = at(**({} if "offset" in options else {"offset": together}))
    if "offset" in options:
        return aligned, field, 0.0
    # What moves one way is seen earlier by one of two cameras apart, as by an earlier clock: the
    # clocks are compared at places of the same reflection, whose shift is then found anew.
    first, frame = tried.copy(), float(np.median(np.diff(aligned["time"].values)))
    tried.clear()
    try:
        aligned, field = at(reflection_shift=field)
    except ValueError:  # the shift of clocks that are far off may be a false one
        if not first or (offset := _next(first, frame)) is None:
            raise
        aligned, field = at(offset=offset)
    while tried and field is tried[-1].field:  # the last one told a delay
        if (offset := _next(tried, frame)) is None:
            break
        aligned, field = at(offset=offset)
    best, step = _step(tried, frame) if tried else (None, np.nan)
    if best is not None and field is not best.field:
        aligned, field = resample(corrected, **{**options, "offset": best.offset}), best.field
    # A delay that is not seen is known no better than by its deviation.
    left = step if best is None else float(np.hypot(step, best.field.attrs["delay_std"]))
    return aligned, field, left / frame


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


def _shift(aligned: xr.Dataset, response: xr.Dataset) -> xr.Dataset | None:
    """Shift of the reflections over all pixels; None where nothing tells it."""
    try:
        field = reflection_shift(*_of_means(aligned, response))
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


def _of_means(aligned: xr.Dataset, response: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Capture of means over frames, if it is long, and the response for it."""
    length = aligned.sizes["time"] // _FRAMES
    if length <= 1:
        return aligned.load(), response
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
    return mean, response.drop_vars(["noise", "netd"], errors="ignore")


def _enlarged(field: xr.Dataset, aligned: xr.Dataset) -> xr.Dataset:
    """Field of a capture `_of_squares` over the pixels of the whole one."""
    side, shape = _side(aligned["counts"]), (aligned.sizes["y"], aligned.sizes["x"])
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
