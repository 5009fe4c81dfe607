"""A scene as two cameras record it: from raw counts to temperatures in one call.

`separate_capture` does in their order what `correction`, `alignment` and `separation` do step by
step. With a target on disk it works by rows, in the memory of some of them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypedDict

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import distance_transform_edt, grey_dilation, grey_erosion, map_coordinates

from dbthermal import schema, store
from dbthermal.alignment import align, reflection_shift, register
from dbthermal.correction import correct_capture
from dbthermal.schema import Status
from dbthermal.separation import SubspaceSettings, complete, materials, solve

__all__ = ["Aligning", "Completing", "Correcting", "separate_capture"]

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Pixels and frames, at most, of the reduced capture, from which all is found that is of the whole
# image; and frames whose mean is registered.
_PIXELS: Final = 20_000
_FRAMES: Final = 400
_REGISTERED: Final = 200
# Times that clock and shift of the reflections are estimated in turn.
_ROUNDS: Final = 3
# Shift from which the cameras see reflections apart: in standard deviations, and in pixels.
_SIGMAS, _LEAST_SHIFT = 3.0, 0.1
# Memory of the rows that are separated together, and what a sample of an image takes there [byte].
_MEMORY: Final = 2**31
_SAMPLE: Final = 80
# Rows around them, at least, and in multiples of the shift.
_HALO, _SHIFTS = 8, 4.0
_BAD: Final = int(Status.DEAD_PIXEL | Status.SATURATED | Status.INVALID_SAMPLES)


class Correcting(TypedDict, total=False):
    """Options of `correction.correct_capture`."""

    flat: xr.DataArray
    flat_after: xr.DataArray
    shutter: bool
    time_constant: float | xr.DataArray
    bad_pixels: float | None
    drift_reference: xr.DataArray


class Aligning(TypedDict, total=False):
    """Options of `alignment.align`."""

    offset: float | xr.DataArray
    transform: xr.DataArray
    clock: str


class Completing(TypedDict, total=False):
    """Options of `separation.complete`."""

    surroundings: float | xr.DataArray
    surroundings_std: float
    prior: str | xr.DataArray | xr.Dataset


def __dir__() -> list[str]:
    return __all__


def separate_capture(  # noqa: PLR0913 - the options of each step, by name
    capture: xr.Dataset,
    correction: xr.Dataset,
    response: xr.Dataset,
    *,
    registration: Literal["translation", "affine", "homography"] | None = "homography",
    correcting: Correcting | None = None,
    aligning: Aligning | None = None,
    settings: SubspaceSettings | None = None,
    completing: Completing | None = None,
    workers: int = 2,
    target: str | Path | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """
    Raw counts of two cameras to temperatures, emissivities and reflections: every step in order.

    1. `correction.correct_capture`.
    2. `alignment.register`, `align` and `reflection_shift`. Where the cameras stand apart, the
       clocks are compared where both see the same reflection, and its shift is then found anew.
    3. `separation.solve`, of a small picture first, `materials` of that, and `solve` of the capture
       pooled over them, with the reflections' shift.
    4. `separation.complete`.

    What is of the whole image (time offset, transform, shift, materials, surroundings) is found in
    a reduced picture, of means over some pixels and frames, if the capture is large.

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
    correcting, aligning, completing : dict, optional
        Options of these steps by name.
    settings : SubspaceSettings, optional
        Options of the separation.
    workers : int
        Number of threads.
    target : str or Path, optional
        Folder ``*.zarr`` for the result. It is separated and written by blocks of rows, in about
        3 GB however long the capture is. Materials are then pooled within a block.
    provenance : mapping, optional
        For the `target`, see `store.save`.

    Returns
    -------
    Dataset
        Stage `separated`, as from `separation.complete`, on the first band's grid, with
        `reflection_shift` (axis, y, x) [pixel] where the cameras see reflections apart. Attributes
        of the alignment: `clock`, `time_offset` [s], `frames_lost`, `transform`; `reflections`,
        "apart", "together", or why their shift is not known. From a `target` it is lazy.

    Raises
    ------
    ImportError
        If OpenCV, for a registration, or scikit-image is not installed.
    TypeError, ValueError
        As the steps do.

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
    lazy = target is not None
    corrected = correct_capture(capture, correction, lazy=lazy, **correcting or {})
    options = Aligning(**aligning or {})
    if registration is not None and "transform" not in options:
        some = slice(None, None, max(1, corrected.sizes["time"] // _REGISTERED))
        options["transform"] = register(corrected.isel(time=some), model=registration)
    plan = _planned(corrected, response, options, settings, workers, lazy=lazy)

    def separated(rows: slice) -> xr.Dataset:
        """Some rows of the result."""
        around, own = _around(rows, plan)
        part = plan.aligned.isel(y=around).load()
        labels = plan.labels.isel(y=around)
        result = solve(
            part,
            response,
            settings=settings,
            pool=labels if bool((labels >= 0).any()) else None,
            reflection_shift=None if plan.field is None else plan.field.isel(y=around),
            workers=workers,
        )
        result = complete(result, part, response, labels, workers=workers, **completing or {})
        return result.isel(y=own).assign(plan.maps(rows)).assign_attrs(plan.attrs)

    if target is None:
        return separated(slice(0, plan.aligned.sizes["y"]))
    parts = (separated(rows) for rows in _blocks(plan.aligned))
    store.save_rows(parts, target, store.provenance({}) if provenance is None else provenance)
    return store.open_dataset(target)


@dataclass(frozen=True)
class _Plan:
    """Aligned capture, and what is of the whole image."""

    aligned: xr.Dataset
    field: xr.Dataset | None  # shift of the reflections, where it matters
    labels: xr.DataArray  # materials (y, x)
    attrs: dict[str, Any]

    def maps(self, rows: slice) -> dict[str, xr.DataArray]:
        """Maps of some rows for the result."""
        if self.field is None:
            return {}
        return {"reflection_shift": self.field["shift"].isel(y=rows)}


def _planned(
    corrected: xr.Dataset,
    response: xr.Dataset,
    options: Aligning,
    settings: SubspaceSettings | None,
    workers: int,
    *,
    lazy: bool,
) -> _Plan:
    """Align a capture, and find what is of the whole image."""
    names = corrected["band"].values
    together = xr.DataArray(np.zeros(names.size), dims="band", coords={"band": names})
    first: Aligning = {"offset": together, **options}
    aligned = align(corrected, **first, lazy=lazy)
    small, known = _reduced(aligned, response)
    field, found = _shift(small, known)
    if "offset" not in options:
        # What moves one way is seen earlier by one of two cameras apart, as by an earlier clock:
        # the clocks are compared at places of the same reflection, whose shift is then found anew.
        for _ in range(_ROUNDS - 1 if field is not None else 1):
            wide = None if field is None else _enlarged(field, aligned)
            aligned = align(corrected, **options, reflection_shift=wide, lazy=lazy)
            small, known = _reduced(aligned, response)
            field, found = _shift(small, known)
    apart = field if found == "apart" else None
    alone = solve(small, known, settings=settings, reflection_shift=apart, workers=workers)
    labels = _labels(materials(alone, small, known), aligned)
    wide = None if apart is None else _enlarged(apart, aligned)
    kept = ("clock", "time_offset", "frames_lost", "transform")
    attrs = {name: aligned.attrs[name] for name in kept if name in aligned.attrs}
    return _Plan(aligned, wide, labels, {**attrs, "reflections": found})


def _shift(small: xr.Dataset, response: xr.Dataset) -> tuple[xr.Dataset | None, str]:
    """Shift of the reflections, None where it is not found; whether they are apart, or why not."""
    try:
        field = reflection_shift(small, response)
    except ValueError as error:  # as where nothing moves, or the image is too small
        return None, str(error)
    shift, std = (
        np.hypot(*field[name].values[:, field["known"].values]) for name in ("shift", "shift_std")
    )
    apart = np.median(shift) > max(_SIGMAS * np.median(std), _LEAST_SHIFT)
    return field, "apart" if apart else "together"


def _reduced(aligned: xr.Dataset, response: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Capture of means over squares of pixels and over frames, and the response for it."""
    height, width, frames = (aligned.sizes[dim] for dim in ("y", "x", "time"))
    side, length = _reduction(aligned)
    if side == length == 1:
        return aligned.load(), response
    rows, columns, times = height // side, width // side, frames // length
    good, segment = np.ones((height, width), dtype=bool), np.zeros(frames, dtype=np.int32)
    if "status" in aligned:
        good = (aligned["status"].values & _BAD) == 0
    if "segment" in aligned:
        segment = aligned["segment"].values
    parts = segment[: times * length].reshape(times, length)
    means = np.full((aligned.sizes["band"], times, rows, columns), np.nan, dtype=np.float32)
    for row in range(rows):
        block = slice(row * side, (row + 1) * side)
        counts = aligned["counts"].isel(y=block).values[:, : times * length, :, : columns * side]
        valid = np.all(schema.measured(counts), axis=0) & good[block, : columns * side]
        valid = valid.reshape(times, length, side, columns, side)
        # Of all bands the same samples, on one side of a shutter event.
        valid &= (parts == parts[:, :1]).reshape(times, length, 1, 1, 1)
        number = valid.sum(axis=(1, 2, 4))
        for band, movie in enumerate(counts):
            total = movie.reshape(valid.shape).sum(axis=(1, 2, 4), where=valid, dtype=np.float64)
            np.divide(total, number, out=means[band, :, row], where=number > 0, casting="same_kind")
    clock = aligned["time"].values[: times * length].reshape(times, length).mean(axis=1)
    lost = ~good[: rows * side, : columns * side].reshape(rows, side, columns, side)
    small = xr.Dataset(
        {
            "counts": (aligned["counts"].dims, means, aligned["counts"].attrs),
            "status": (("y", "x"), lost.all(axis=(1, 3)) * np.uint32(Status.DEAD_PIXEL)),
            "segment": ("time", parts[:, 0], schema.SEGMENT.attrs),
        },
        coords={"band": aligned["band"], "time": ("time", clock, aligned["time"].attrs)},
        attrs=aligned.attrs,
    )
    # Interpolated samples are not independent: the noise of their means is that of the means.
    return small, response.drop_vars(["noise", "netd"], errors="ignore")


def _reduction(aligned: xr.Dataset) -> tuple[int, int]:
    """Side of a square of pixels, and number of frames, of which `_reduced` takes the mean."""
    pixels = aligned.sizes["y"] * aligned.sizes["x"]
    side = int(np.ceil(np.sqrt(max(1.0, pixels / _PIXELS))))
    return side, max(1, aligned.sizes["time"] // _FRAMES)


def _enlarged(field: xr.Dataset, aligned: xr.Dataset) -> xr.Dataset:
    """Field of a reduced capture over the pixels of the whole one."""
    side, shape = _reduction(aligned)[0], (aligned.sizes["y"], aligned.sizes["x"])
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


def _labels(small: xr.DataArray, aligned: xr.Dataset) -> xr.DataArray:
    """Materials of the whole capture from those of a reduced one; none where two of them meet."""
    side, values = _reduction(aligned)[0], small.values
    if side > 1:
        alike = grey_erosion(values, 3) == grey_dilation(values, 3)
        values = np.where(alike, values, -1).repeat(side, axis=0).repeat(side, axis=1)
        beyond = [(0, aligned.sizes[d] - n) for d, n in zip("yx", values.shape, strict=True)]
        values = np.pad(values, beyond, mode="edge")
    here = {dim: aligned[dim] for dim in ("y", "x") if dim in aligned.coords}
    return xr.DataArray(values, dims=("y", "x"), coords=here, attrs=small.attrs)


def _blocks(aligned: xr.Dataset) -> Iterator[slice]:
    """Rows that are separated together."""
    height = aligned.sizes["y"]
    rows = max(1, _MEMORY // (_SAMPLE * aligned.sizes["time"] * aligned.sizes["x"]))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def _around(rows: slice, plan: _Plan) -> tuple[slice, slice]:
    """Rows with those around them that they are separated with, and their own among these."""
    halo = _HALO
    if plan.field is not None:
        halo += int(np.ceil(_SHIFTS * np.nanmax(np.abs(plan.field["shift"].sel(axis="y").values))))
    first, last = max(0, rows.start - halo), min(plan.aligned.sizes["y"], rows.stop + halo)
    return slice(first, last), slice(rows.start - first, rows.stop - first)
