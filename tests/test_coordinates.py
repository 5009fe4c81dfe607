"""Two arrays that meet in a public function lie on the same coordinates, or an error says where."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from dbthermal import (
    alignment,
    calibration,
    correction,
    figures,
    limits,
    metrics,
    response,
    separation,
    simulation,
)
from dbthermal import emissivity as emissivities
from dbthermal._coordinates import laid_on

RIG = simulation.Rig(bad_fraction=0.0)
CAMERA = RIG.response()
BANDS = list(RIG.bands)
SHAPE = (6, 8)

Labelled = xr.DataArray | xr.Dataset


def place(array: xr.DataArray) -> xr.DataArray:
    """A map on the window of the capture: rows from 100, columns from 200."""
    return array.assign_coords(
        {dim: start + np.arange(SHAPE[axis]) for axis, (dim, start) in enumerate(WINDOW.items())}
    )


WINDOW = {"y": 100, "x": 200}
RNG = np.random.default_rng(1)
TIME = np.arange(60) / 10.0
GLASS = xr.DataArray([0.86, 0.72], dims="band", coords={"band": BANDS})
SCENE = simulation.walkers(TIME, SHAPE, GLASS, RNG).assign_coords(
    y=100 + np.arange(6), x=200 + np.arange(8)
)
CAPTURE = simulation.observe(SCENE, CAMERA, RNG)
PIXELS = place(xr.DataArray(np.ones(SHAPE, dtype=bool), dims=("y", "x")))
FRAMES = xr.DataArray(np.ones(60, dtype=bool), {"time": TIME}, dims="time")
CLOSED = FRAMES & (FRAMES["time"] > 3.05) & (FRAMES["time"] < 3.25)
MAPS = place(
    xr.DataArray(np.full((2, *SHAPE), 0.86), {"band": BANDS}, dims=("band", "y", "x"))
) - xr.DataArray([0.0, 0.14], {"band": BANDS}, dims="band")
DETECTOR = simulation.pattern(RIG, SHAPE, RNG).assign_coords(SCENE[["y", "x"]].coords)
CORRECTION = xr.Dataset(
    {
        "gain": xr.ones_like(MAPS),
        "offset": xr.zeros_like(MAPS),
        "bad": xr.zeros_like(MAPS, dtype=bool),
    }
)
RAW = CAPTURE.assign(counts=CAPTURE["counts"].round().astype(np.uint16))
FLAT = 20000.0 * xr.ones_like(MAPS)
RESULT = separation.solve(CAPTURE, CAMERA)
APPARENT = response.apparent_temperature(CAMERA, CAPTURE["counts"])
TABLE = emissivities.embedded_table()
NOISE = emissivities.filter_noise(0.03, [str(name) for name in TABLE["band"].values])
CONTACT = TABLE.sel(band=BANDS)[["emissivity"]].assign(
    emissivity_std=0.01 + 0.0 * TABLE["emissivity"].sel(band=BANDS)
)
BLACKBODY = CAMERA["counts"]
STEPS = xr.DataArray([0.0, 0.1], {"band": BANDS}, dims="band")
TRANSFORM = xr.DataArray(
    np.stack([np.eye(3)] * 2), {"band": BANDS}, dims=("band", "row", "column"), attrs={"units": "1"}
)
solve = partial(separation.solve, CAPTURE, CAMERA)
calibrated = partial(solve, method="calibrated")
frames = partial(figures.separated_frames, title="plate", labels=("a [K]", "b [K]", "c [K]"))
CHANGE = separation.reflected_change(APPARENT, RESULT)
OBJECT = RESULT["object_temperature"]
FEW = {"time": slice(0, 2)}


def film(**changes: xr.DataArray) -> list[Any]:
    """A film of two frames."""
    parts = {"apparent": APPARENT, "emission": OBJECT, "change": CHANGE, **changes}
    return list(figures.separated_film(*(part.isel(FEW) for part in parts.values()), title="a"))


def few(emission: xr.DataArray = OBJECT, reflection: xr.DataArray = CHANGE) -> Figure:
    """Rows of two frames."""
    return frames(*(part.isel(FEW) for part in (APPARENT, emission, reflection)))


# Name: function of the second array, that array, its dims whose coordinates count.
LAID: dict[str, tuple[Callable[[Any], Any], Labelled, str]] = {
    "solve mask of pixels": (lambda mask: solve(mask=mask), PIXELS, "y x"),
    "solve mask of frames": (lambda mask: solve(mask=mask), FRAMES, "time"),
    "solve mask": (lambda mask: solve(mask=mask), FRAMES & PIXELS, "time y x"),
    "solve pool": (lambda pool: solve(pool=pool), PIXELS.astype(int), "y x"),
    "solve emissivity": (lambda known: calibrated(emissivity=known), MAPS, "y x band"),
    "solve emissivity_std": (
        lambda std: calibrated(emissivity=MAPS, emissivity_std=0.1 * std),
        MAPS,
        "y x band",
    ),
    "solve response": (lambda camera: separation.solve(CAPTURE, camera), CAMERA, "band"),
    "materials": (
        lambda result: separation.materials(result, CAPTURE, CAMERA),
        RESULT,
        "time y x band",
    ),
    "reflected_change": (
        lambda apparent: separation.reflected_change(apparent, RESULT),
        APPARENT,
        "time y x",
    ),
    "apparent_temperature": (
        lambda camera: response.apparent_temperature(camera, CAPTURE["counts"]),
        CAMERA,
        "band",
    ),
    "fit_response": (
        lambda noise: calibration.fit_response(BLACKBODY, noise),
        CAMERA["noise"],
        "band",
    ),
    "correct": (lambda maps: correction.correct(RAW, maps), CORRECTION, "y x band"),
    "renew_offset": (lambda flat: correction.renew_offset(CORRECTION, flat), FLAT, "y x band"),
    "correct_capture flat": (
        lambda flat: correction.correct_capture(RAW, CORRECTION, flat=flat),
        FLAT,
        "y x band",
    ),
    "correct_capture drift_reference": (
        lambda patch: correction.correct_capture(RAW, CORRECTION, drift_reference=patch),
        PIXELS,
        "y x",
    ),
    "undo_drift": (lambda patch: correction.undo_drift(CAPTURE, patch), PIXELS, "y x"),
    "undo_lag": (lambda lag: correction.undo_lag(CAPTURE, 0.01 + 0.01 * lag), STEPS, "band"),
    "find_shutter": (
        lambda closed: correction.find_shutter(CAPTURE, closed=closed),
        CLOSED,
        "time",
    ),
    "align offset": (lambda offset: alignment.align(CAPTURE, offset=offset), STEPS, "band"),
    "align transform": (
        lambda transform: alignment.align(CAPTURE, offset=0.0, transform=transform),
        TRANSFORM,
        "band",
    ),
    "bounds": (lambda camera: limits.bounds(SCENE.isel(y=[0]), camera), CAMERA, "band"),
    "plan": (lambda noise: limits.plan(TABLE.isel(material=[0]), noise), NOISE, "band"),
    "rank_filters": (lambda noise: emissivities.rank_filters(TABLE, noise), NOISE, "band"),
    "correlation": (
        lambda truth: metrics.correlation(CAPTURE["counts"], truth),
        APPARENT,
        "time y x band",
    ),
    "correlation mask": (
        lambda mask: metrics.correlation(CAPTURE["counts"][0], CAPTURE["counts"][1], mask),
        PIXELS,
        "y x",
    ),
    "relative_error_celsius": (
        lambda truth: metrics.relative_error_celsius(OBJECT, truth),
        SCENE["object_temperature"],
        "time y x",
    ),
    "truth_and_estimate": (
        lambda truth: figures.truth_and_estimate(truth, RESULT, (1, 1)),
        SCENE,
        "y x",
    ),
    "separated_frames emission": (lambda part: few(emission=part), OBJECT, "time y x"),
    "separated_frames reflection": (lambda part: few(reflection=part), CHANGE, "time y x"),
    "separated_film emission": (lambda part: film(emission=part), OBJECT, "time y x"),
    "separated_film change": (lambda part: film(change=part), CHANGE, "time y x"),
    "emissivity_by_contact": (
        lambda table: figures.emissivity_by_contact(CONTACT, table),
        CONTACT["emissivity"],
        "material band",
    ),
    "observe": (lambda camera: simulation.observe(SCENE, camera, RNG), CAMERA, "band"),
    "capture": (lambda detector: simulation.capture(CAPTURE, detector), DETECTOR, "y x band"),
}
ALONG = [(name, dim) for name, (_, _, dims) in LAID.items() for dim in dims.split()]


def moved(array: Labelled, dim: str) -> Labelled:
    """The same values on other coordinates: those of the window beside, or other names."""
    values = array[dim].values
    other = values + 1 if values.dtype.kind in "if" else np.char.add(values.astype(str), "'")
    return array.assign_coords({dim: (dim, other, array[dim].attrs)})


@pytest.mark.parametrize("name", LAID)
def test_the_same_coordinates_are_accepted(name: str) -> None:
    """On the same coordinates, rounded or without those that may be missing, all functions run."""
    call, array, dims = LAID[name]
    rounded = {
        dim: (dim, array[dim].values * (1 + 2e-16), array[dim].attrs)
        for dim in {*dims.split()} & {"time", "y", "x"}
    }
    call(array.assign_coords(rounded))
    if isinstance(array, xr.DataArray):
        call(array.drop_vars([dim for dim in ("y", "x") if dim in array.coords]))


def test_shutter_events_of_another_capture_are_refused() -> None:
    """Events whose times are not those of their frames are of another capture."""
    events = correction.find_shutter(CAPTURE, closed=CLOSED)
    assert correction.mark_shutter(CAPTURE, events).attrs["shutter_events"] == 2
    other = events.assign(start=events["start"] + 5.0)
    with pytest.raises(ValueError, match=r"of the events: 8\.1 at position 0, where .* 3\.1"):
        correction.mark_shutter(CAPTURE, other)


@pytest.mark.parametrize(("name", "dim"), ALONG)
def test_other_coordinates_are_refused(name: str, dim: str) -> None:
    """On other coordinates the error names the dim, or the band, and the value."""
    call, array, _ = LAID[name]
    other = moved(array, dim)
    first = {"band": "Missing band '"}.get(dim, f"Invalid '{dim}' of .*: {other[dim].values[0]} at")
    with pytest.raises(ValueError, match=first):
        call(other)


@pytest.mark.parametrize(("name", "dim"), [pair for pair in ALONG if pair[1] in {"time", "y", "x"}])
def test_another_order_and_size_are_refused(name: str, dim: str) -> None:
    """In another order, as mirrored, or of another size, an array is refused by its dim."""
    call, array, _ = LAID[name]
    with pytest.raises(ValueError, match=f"'{dim}'"):
        call(array.isel({dim: slice(None, None, -1)}))
    if "film" not in name and "frames" not in name.rsplit("_", maxsplit=1)[-1]:
        with pytest.raises(ValueError, match=f"Invalid size .* of '{dim}'"):
            call(array.isel({dim: slice(1, None)}))


def test_bands_go_by_name() -> None:
    """In another order of bands the result is the same; a repeated band is refused."""
    swapped = [1, 0]
    for known in (MAPS, GLASS):
        xr.testing.assert_identical(
            calibrated(emissivity=known), calibrated(emissivity=known.isel(band=swapped))
        )
    other = response.apparent_temperature(CAMERA, CAPTURE["counts"].isel(band=swapped))
    xr.testing.assert_identical(
        metrics.correlation(APPARENT, CAPTURE["counts"]),
        metrics.correlation(APPARENT, CAPTURE["counts"].isel(band=swapped)),
    )
    xr.testing.assert_identical(other.isel(band=swapped), APPARENT)
    with pytest.raises(ValueError, match="Repeated band"):
        calibrated(emissivity=GLASS.assign_coords(band=["8-14", "8-14"]))


@pytest.mark.parametrize(
    ("here", "there", "same"),
    [
        (np.arange(3), np.arange(3.0) + 1e-13, True),
        (np.cumsum(np.full(20000, 0.1)), 0.1 * np.arange(1, 20001), True),
        (np.array([0.1, 0.2, 0.3], dtype=np.float32), np.array([0.1, 0.2, 0.3]), True),
        (1.7e9 + np.arange(3) / 60, 1.7e9 + np.arange(3) / 60 + 1 / 600, False),
        (np.array([0.0, np.nan]), np.array([0.0, np.nan]), False),
        (np.array(["a", "b"]), np.array(["a", "c"]), False),
        (np.array([1, 2]), np.array(["1", "2"]), True),
        (np.array([2**53, 2**53 + 2]), np.array([2**53, 2**53 + 4]), False),
    ],
)
def test_values_differ_beyond_rounding(
    here: np.ndarray[Any, Any], there: np.ndarray[Any, Any], *, same: bool
) -> None:
    """Coordinates are the same within rounding, whatever their type and size."""
    first, second = (
        xr.DataArray(np.zeros(len(part)), {"time": part}, dims="time") for part in (here, there)
    )
    if same:
        assert laid_on(first, second, "a", "b").indexes["time"].equals(second.indexes["time"])
    else:
        with pytest.raises(ValueError, match="Invalid 'time' of a: "):
            laid_on(first, second, "a", "b")
