"""Arguments that do not fit: each is named, with the value and the rule, before any work.

One table of calls and messages for the rooms of the package, and one of the arrays that must lie on
the same coordinates as another one; what is stage by stage is in test_schema.py.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, emissivity_of, transform_of
from refused import assert_raises, assert_refused, raising
from scenes import field

from dbthermal import (
    alignment,
    calibration,
    correction,
    figures,
    limits,
    mixing,
    noise,
    planck,
    readers,
    response,
    separation,
    simulation,
    store,
)
from dbthermal import emissivity as emissivities
from dbthermal.scene import separate_capture
from dbthermal.schema import Status, laid_on
from reproduction import figures as drawings
from reproduction.experiments.twins import reflected_change
from reproduction.figures.scenes import truth_and_estimate
from reproduction.filters import rank_filters
from reproduction.methods.dbvt import DbvtSettings

RIG = simulation.Rig(bad_fraction=0.0)
CAMERA = RIG.response()
BANDS = list(RIG.bands)
SHAPE = (6, 8)
RNG = np.random.default_rng(1)
TIME = np.arange(60) / 10.0
PLACE = {"y": 100 + np.arange(6), "x": 200 + np.arange(8)}
SCENE = simulation.walkers(TIME, SHAPE, GLASS, RNG).assign_coords(PLACE)
CAPTURE = simulation.observe(SCENE, CAMERA, RNG)
DETECTOR = simulation.pattern(RIG, SHAPE, RNG).assign_coords(SCENE[["y", "x"]].coords)
RAW = simulation.capture(CAPTURE, DETECTOR)
MOVIES = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 3), 16, DETECTOR, RNG)
STATISTICS = correction.blackbody_statistics(MOVIES)
CORRECTION = correction.fit_correction(STATISTICS)
RESULT = separation.solve(CAPTURE, CAMERA, workers=1)
APPARENT = response.apparent_temperature(CAMERA, CAPTURE["counts"])
CHANGE = reflected_change(APPARENT, RESULT)
OBJECT = RESULT["object_temperature"]
PIXELS = xr.DataArray(np.ones(SHAPE, dtype=bool), PLACE, dims=("y", "x"))
FRAMES = xr.DataArray(np.ones(60, dtype=bool), {"time": TIME}, dims="time")
CLOSED = FRAMES & (FRAMES["time"] > 3.05) & (FRAMES["time"] < 3.25)
MAPS = PIXELS * GLASS.transpose("band")
MAPS = MAPS.transpose("band", "y", "x")
TABLE = emissivities.embedded_table()
NOISE = emissivities.filter_noise(0.03, [str(name) for name in TABLE["band"].values])
CONTACT = TABLE.sel(band=BANDS)[["emissivity"]].assign(
    emissivity_std=0.01 + 0.0 * TABLE["emissivity"].sel(band=BANDS)
)
STEPS = xr.DataArray([0.0, 0.1], {"band": BANDS}, dims="band")
TRANSFORM = transform_of(np.eye(3)).assign_attrs(units="1")
solve: Callable[..., xr.Dataset] = partial(separation.solve, CAPTURE, CAMERA)
calibrated = partial(solve, method="calibrated")
walked = partial(simulation.walkers, TIME, SHAPE, GLASS, RNG)
fitted = partial(calibration.fit_response, CAMERA["counts"])
completed = partial(separation.complete, RESULT, CAPTURE, CAMERA)
grouped: Callable[..., Any] = partial(separation.materials, corrected=CAPTURE, response=CAMERA)
aligned: Callable[..., Any] = partial(alignment.align, CAPTURE)
Call = Callable[[], Any]
Labelled = xr.DataArray | xr.Dataset


def recorded(band: int = 0, **attrs: str) -> xr.Dataset:
    """Recording of one band."""
    counts = RAW["counts"].isel(band=band, drop=True).assign_attrs(attrs)
    return readers.array(counts.drop_vars(["y", "x"]), unit="count", clock=10.0)


def paired(first: xr.Dataset, second: xr.Dataset) -> xr.Dataset:
    """Two recordings as one capture."""
    return readers.two_bands(first, second, bands=("8-14", "9.5"), offset=0.0)


def streamed(time: Any, frames: Any = None, segment: Any = 0, **options: Any) -> Any:
    """Frames that a stream takes."""
    options = {"frame_rate": 10.0} | options
    stream = separation.Stream(CAPTURE.isel(time=[0]), CAMERA, **options)
    first = CAPTURE["counts"].values[:, 0] if frames is None else frames
    return stream.update(time, first, segment=segment)


def whole(**options: Any) -> xr.Dataset:
    """All steps from raw counts."""
    return separate_capture(RAW, CORRECTION, CAMERA, registration=None, **options)


def captured(**changes: Any) -> Call:
    """`solve` of the capture with other variables."""
    return lambda: separation.solve(CAPTURE.assign(**changes), CAMERA)


def viewed(**changes: Any) -> Call:
    """`solve` with a response of other variables."""
    return lambda: separation.solve(CAPTURE, CAMERA.assign(**changes))


def displaced(change: Callable[[xr.Dataset], xr.Dataset]) -> Call:
    """`solve` with a changed field of the reflections' shift."""
    return lambda: solve(reflection_shift=change(FIELD))


def units(array: xr.DataArray, unit: str) -> xr.DataArray:
    """The array in another unit."""
    return array.assign_attrs(units=unit)


ONE, NOTHING = np.ones((60, 3)), cast(Any, None)
COUNTS, KELVIN = CAPTURE["counts"], units(CAPTURE["counts"], "K")
EMPTY = CAPTURE.isel(y=slice(0, 0))  # so that what is refused is refused before the work
LABELS = xr.zeros_like(COUNTS[0, 0], dtype=int)
STILL = recorded().isel(time=[0])
FLAGGED = recorded().assign(frame_flags=("time", np.full(60, 65536)))
COLD = STATISTICS.assign_coords(temperature=[2.0, 40.0, 70.0])
DATES, PATCH = np.datetime64("2026-01-01", "ns") + np.arange(60), PIXELS.expand_dims("patch")
NEGATIVE = RESULT.assign(object_temperature_std=-RESULT["object_temperature_std"])
FALLING = CAPTURE.isel(time=[*range(40), 39, *range(40, 60)])
TURNED = CAPTURE.transpose("time", "band", "y", "x")
FIELD = field(np.zeros((2, *SHAPE))).assign_coords(PLACE)
TWICE = xr.concat([PATCH, PATCH], "patch")
FLAT = 20000.0 * xr.ones_like(MAPS)
PLAIN = xr.Dataset({"gain": xr.ones_like(MAPS), "offset": 0.0 * MAPS, "bad": MAPS < 0})
EVEN = CAPTURE.assign(counts=COUNTS.round().astype(np.uint16))
CELSIUS = units(OBJECT, "degC")
DARK = correction.Reference(CAMERA, TWICE & False, (300.0, 310.0))
correcting: Callable[..., Any] = partial(correction.correct_capture, EVEN, PLAIN)
SETTINGS: list[tuple[Any, dict[str, Any], str]] = [
    (separation.SubspaceSettings, {"background_drift": None}, "background_drift"),
    (separation.SubspaceSettings, {"background_drift": "3"}, "background_drift"),
    (separation.CalibratedSettings, {"smooth": "false"}, "smooth 'false' of method"),
    (DbvtSettings, {"steps": True}, "steps True of method"),
    (DbvtSettings, {"batch": 2.5}, "whole number"),
    (DbvtSettings, {"start": None}, "start None of method"),
]
CASES: list[tuple[Call, str]] = [
    (lambda: calibration.Bias(air_temperature=22.0), r"air_temperature \[K\] 22.0.*in kelvin"),
    (lambda: walked(temperatures=(22.0, 32.0, 60.0)), "temperatures.*in kelvin"),
    (lambda: correction.fit_correction(COLD), "temperature.*in kelvin"),
    (lambda: correction.Reference(CAMERA, PATCH, (22.0,)), r"temperatures \[K\] 22.0.*in kelvin"),
    (lambda: limits.CaptureDesign(level=22.0), "level 22.0.*in kelvin"),
    (lambda: fitted(room_temperature=22.0), "room_temperature of the response 22.0.*in kelvin"),
    (lambda: fitted(gain_std=2.0), "gain_std of the response 2.0"),
    *(
        (partial(calibration.fit_response, CAMERA["counts"], **cast(Any, {name: value})), name)
        for name in ("blackbody_accuracy", "blackbody_emissivity", "room_temperature")
        for value in ("0.1", None, True, [0.1, 0.2], np.nan)
    ),
    (lambda: fitted(background_ratio_std=cast(Any, "0.1")), "background_ratio_std '0.1'"),
    (lambda: noise.estimate(ONE, ONE, 3.0), r"time \[s\] 3.0 of shape"),
    (lambda: separation.without_calibration(RESULT, drift=cast(Any, "no")), "drift 'no'"),
    (lambda: walked(crossings=cast(Any, "7")), "crossings '7'"),
    (lambda: simulation.blackbody_movies(RIG, TIME + 280, cast(Any, 1.5), DETECTOR, RNG), "s 1.5"),
    (lambda: figures.status(RESULT.astype(float)), "'status' of the result.*mask, average or fill"),
    (lambda: figures.reflection_shift(RESULT), "Missing variable 'shift' in the field"),
    (lambda: rows(frames=APPARENT[0]), r"Invalid dims \('time', 'y', 'x'\) of the inputs"),
    (lambda: store.save_figure(NOTHING, "a.png", {}), "Invalid figure of type NoneType"),
    (lambda: store.provenance(cast(Any, [1])), "Invalid parameters of type list"),
    (lambda: store.save(CAPTURE, "a.zarr", {"a": np.nan}), "Invalid parameter 'provenance'"),
    (lambda: paired(NOTHING, STILL), "Invalid recording of band '8-14' of type NoneType"),
    (lambda: aligned(offset=[0, 1]), "DataArray .band., 0 in the first"),
    (lambda: limits.plan(TABLE.sel(band=["8-14"]), NOISE), "Missing band '8-14', or a second one"),
    (lambda: simulation.Background(level=22.0), r"level \[K\] 22.0.*in kelvin"),
    (lambda: simulation.Background(drift=np.nan), "drift"),
    (lambda: planck.spectral_radiance(10.0, 300.0), r"wavelength \[m\] 10.0.*not in micrometres"),
    (lambda: planck.spectral_radiance(1e-5, [[9.0], [9.0, 9.0]]), "list. Must be numbers in equal"),
    (lambda: planck.spectral_radiance(1e-5, cast(Any, CAPTURE)), "temperature .K. of type Dataset"),
    (lambda: simulation.Rig(noise=(30.0, 350.0)), r"noise \[K\] 30.0.*not in millikelvin"),
    (lambda: simulation.Rig(lowest=-10.0), r"range \[K\] -10.0.*in kelvin"),
    (lambda: simulation.heating(TIME, cast(Any, "a"), 300.0, 9.0), r"start and stop \[K\] 'a'"),
    (lambda: simulation.walkers(TIME, cast(Any, 4), GLASS, 1), r"shape 4 of shape \(\). Must have"),
    (lambda: simulation.walkers(TIME, SHAPE, GLASS, cast(Any, "1")), "rng '1'. Must be a Gener"),
    (lambda: simulation.walkers(TIME, SHAPE, MAPS[:, 1:], 1), r"\(2, 5, 8\). Must have \(2, 6, 8"),
    (lambda: simulation.side_by_side(TABLE["emissivity"], cast(Any, (4.0, 4.0))), "shape 4.0.*who"),
    (lambda: simulation.scene(TIME, ONE, ONE, GLASS), r"\(60, 3\). Must have \(60, 3, 1\)"),
    (lambda: simulation.pattern(cast(Any, SHAPE), SHAPE, RNG), "Invalid rig of type tuple"),
    (lambda: simulation.capture(RAW, DETECTOR), "dtype uint16 .* raw counts"),
    (lambda: simulation.capture(CAPTURE, DETECTOR.drop_vars("gain")), "Missing variable 'gain' in"),
    (lambda: simulation.observe(SCENE, CAMERA, RNG, "int16"), "dtype int16 of 'counts'"),
    (lambda: limits.plan(TABLE, 1e3 * NOISE), r"noise \[K\] in band '8-14' .*not in millikelvin"),
    (lambda: figures.plan(TABLE, TABLE, ["gold"]), "Unknown material 'gold'. Must be one of"),
    (lambda: correcting(reference=3.0), "Invalid reference of type float"),
    (lambda: completed(surroundings=295.0, surroundings_std=True), "surroundings_std"),
    (lambda: completed(surroundings_std=1e-30), "surroundings_std"),
    (lambda: separation.separate(EMPTY, CAMERA, surroundings_std=1e-30), "surroundings_std"),
    (lambda: separation.complete(NEGATIVE, CAPTURE, CAMERA), "object_temperature_std.*negative"),
    (lambda: streamed(np.datetime64("2024-01-01")), "time"),
    (lambda: streamed("0.1"), "time"),
    (lambda: streamed(0.1, segment=1.5), "segment"),
    (lambda: streamed(0.1, KELVIN[:, 0]), "units 'K'"),
    (lambda: streamed(0.1, memory=[10.0]), "memory"),
    (lambda: streamed(0.1, latency=1e9), "latency"),
    *(
        (partial(streamed, 0.1, **{name: 0.0}), f"Invalid {name}")
        for name in ("frame_rate", "latency", "memory", "refresh")
    ),
    (
        lambda: separation.Stream(CAPTURE, CAMERA.drop_vars("noise"), frame_rate=10.0),
        "Missing noise of the response",
    ),
    (lambda: paired(STILL, STILL), "Same counts"),
    (lambda: paired(FLAGGED, recorded(1)), "frame_flags"),
    (lambda: mixing.matrix([86.0, 72.0]), "emissivity 86.0"),
    (lambda: mixing.condition_number(0.9), "two bands"),
    (lambda: noise.estimate(ONE.astype(complex), ONE, TIME), "signal"),
    (lambda: noise.second_difference(ONE[:4], [0.0, 1.0, 1.0, 2.0]), "Must increase strictly"),
    (lambda: aligned(offset=0.0, reflection_shift=3), "shift"),
    (lambda: alignment.align(RAW, offset=0.0), "correct_capture, of a camera that corrects itself"),
    (lambda: correction.correct_capture(RAW, CORRECTION, shutter=NOTHING), "shutter"),
    (lambda: correction.correct_capture(RAW, NOTHING), "Invalid correction of type NoneType"),
    (lambda: correction.correct_capture(NOTHING, CORRECTION), "Invalid capture of type NoneType"),
    (lambda: whole(target="all.nc"), r"Must end in '\.zarr'"),
    (lambda: whole(correcting=None), "correct_capture.*Mapping"),
    (lambda: whole(aligning={"ofset": 0.0}), "ofset.*offset"),
    (lambda: store.open_dataset(NOTHING), "path"),
    (lambda: readers.flir(NOTHING), "path"),
    (lambda: separation.separate(NOTHING, CAMERA), "corrected"),
    (lambda: separation.separate(cast(Any, "a.zarr"), CAMERA), "of type str. Must be a Dataset"),
    (lambda: separation.separate(CAPTURE, CAMERA, workers=cast(Any, 1.5)), "workers 1.5.*whole"),
    (lambda: separation.separate(CAPTURE, CAMERA, outdoors=cast(Any, "no")), "outdoors 'no'.*True"),
    (lambda: separation.without_calibration(CAPTURE), "separated"),
    (
        lambda: separation.without_calibration(RESULT.sel(band=["9.5"]), drift=False),
        "Missing band '8-14' in the result",
    ),
    (lambda: separation.solve(RAW, CAMERA), "correct_capture.*correction.corrected_by"),
    (lambda: solve("magic"), r"Unknown method 'magic'. Must be one of \['subspace', 'calibrated'"),
    (lambda: solve(response_kind="cubic"), "Unknown kind of response 'cubic'"),
    (lambda: separation.solve(CAPTURE.isel(band=[0]), CAMERA), "Must be two or more"),
    (lambda: separation.solve(TURNED, CAMERA), r"dims \('time', 'band', 'y', 'x'\) of 'counts'"),
    (lambda: separation.solve(FALLING, CAMERA), "'time' of 'counts' .*: 3.9 s is followed by 3.9"),
    (
        lambda: calibrated(emissivity=emissivity_of(0.8, 1.2)),
        r"emissivity 1.2 in band '9.5', pixel \(0, 0\). Must lie in \(0, 1\)",
    ),
    (lambda: calibrated(emissivity=emissivity_of(0.8, 0.8)), "same in both bands. Must differ"),
    (lambda: calibrated(emissivity=0.9), r"DataArray of dims \('band',\) .* such as xr.DataArray"),
    *(
        (lambda drift=drift: separation.SubspaceSettings(drift), f"background_drift {drift} K")
        for drift in (-1.0, np.nan, np.inf)
    ),
    (lambda: solve(pool=np.zeros(SHAPE, int)), "Invalid pool of type ndarray"),
    (
        partial(separation.separate, CAPTURE, CAMERA, materials=cast(Any, "")),
        "materials of type str",
    ),
    (lambda: solve(pool=xr.zeros_like(COUNTS[0, 0])), "Invalid dtype float32 of the pool"),
    (lambda: solve(pool=LABELS[:, :-1]), "Invalid size 7 of 'x' of the pool"),
    (lambda: solve(pool=LABELS.transpose("x", "y")), r"Invalid dims \('x', 'y'\) of the pool"),
    (lambda: solve(mask=xr.DataArray(np.ones(60), dims="time")), "dtype float64 of the mask"),
    (lambda: solve(mask=[True] * 60), "Invalid mask of type list"),
    (lambda: solve(mask=xr.DataArray(np.ones(9, bool), dims="time")), "of the mask"),
    (lambda: solve(mask=xr.DataArray([True, True], dims="band")), "of the mask"),
    (captured(segment=("time", np.ones(60))), "dtype float64 of"),
    (captured(segment=("time", np.arange(60)[::-1])), "do not fall"),
    (captured(segment=("x", np.arange(8))), "Must be .'time',"),
    (captured(segment=("time", np.arange(60))), "59 shutter events in 60 frames"),
    (captured(time=("time", DATES)), "dtype datetime64.* of dates .time - time.0.. / np.timedelta"),
    (captured(counts=COUNTS.astype(np.longdouble)), "Must be a real number of at most 64 bits"),
    (captured(status=0.5 * LABELS), "dtype float64 .* mask, average or fill single variables"),
    (captured(counts=KELVIN), "units 'K' of 'counts' of the corrected. Must be 'count'"),
    (captured(status=(("x", "y"), np.zeros((8, 6), np.uint16))), "dims .'x', 'y'. of 'status'"),
    (captured(status=(("y", "x"), np.full(SHAPE, 2**31, np.uint32))), "Unknown bits 2147483648"),
    (viewed(noise=units(CAMERA["noise"], "K")), "units 'K' of 'noise' of the response"),
    (viewed(noise=3.0), "Invalid dims .. of 'noise' of the response"),
    (viewed(noise=("band", [1.0, -1.0])), "noise .count. -1.0 in band '9.5'. Must be finite"),
    (viewed(offset=("band", [np.nan, 0.0])), "offset of the response in band '8-14'. Must be fin"),
    *((partial(make, **values), named) for make, values, named in SETTINGS),
    (displaced(lambda it: it.assign_attrs(reference_band="9.5")), "reference_band .'9.5'. of"),
    (displaced(lambda it: it.assign_attrs(bands=["3-5"])), "bands .'3-5'. of the reflection shift"),
    (displaced(lambda it: it.assign_coords(axis=["x", "y"])), "axis .'x', 'y'. of the reflection"),
    (displaced(lambda it: it.assign(shift=it["shift"] * np.nan)), "without a number"),
    (displaced(lambda it: it.assign(shift=it["shift"].where(it["x"] > 203))), "where it is known"),
    (displaced(lambda it: it.assign(shift_std=it["shift_std"] - 1.0)), "Invalid shift_std"),
    (displaced(lambda it: it.assign(shift=it["shift"] + 30.0)), "shift of 30 pixel. Must be less"),
    (displaced(lambda it: it.drop_vars("known")), "Missing variable 'known' in the reflection_sh"),
    (lambda: completed(prior=emissivity_of(1.2, 0.9)), "emissivity of the prior 1.2. Must lie in"),
    (lambda: completed(prior="glas"), "Unknown prior 'glas'"),
    (lambda: completed(surroundings=22.0), r"\[K\] 22.0.* not in degrees Celsius"),
    (lambda: completed(surroundings=2e4), r"surroundings \[K\] 20000.0. Must lie in"),
    (lambda: completed(surroundings=units(xr.DataArray(22.0), "degC")), "units 'degC' of"),
    (lambda: completed(surroundings=295.0, surroundings_std=0.0), r"surroundings_std \[K\] 0.0"),
    (lambda: completed(workers=0), "number of workers 0. Must be a whole number, at least 1"),
    (lambda: completed(LABELS[:3]), "Invalid size 3 of"),
    (lambda: grouped(RESULT, error_rate=0.0), r"error_rate 0\.0"),
    (lambda: grouped(RESULT, resolution=1.5), r"resolution 1\.5"),
    (lambda: grouped(RESULT.drop_vars("reflection_ratio")), "Missing variable 'reflection_ratio'"),
    (lambda: grouped(RESULT.isel(band=[1])), r"Missing band '8-14' in the result, of \['9.5'\]."),
    (lambda: separation.materials(RESULT, TURNED, CAMERA), "Invalid dims"),
    (lambda: correction.Reference(CAMERA, TWICE, (300.0, 300.0)), "Must differ"),
    (lambda: correction.Reference(CAMERA, TWICE, (300.0,)), r"temperatures \[K\]"),
    (lambda: correcting(reference=DARK), "Invalid patch 0"),
    (lambda: reflected_change(APPARENT.isel(band=[1, 0]), RESULT), r"first band '9\.5'. Must be '"),
    (
        lambda: figures.separated_temperatures(APPARENT, CELSIUS, CHANGE, title="a"),
        "Invalid units 'degC' of the emission",
    ),
    (lambda: film(CELSIUS), "Invalid units 'degC' of the emission"),
    (
        lambda: truth_and_estimate(SCENE, RESULT.assign(object_temperature=CELSIUS), (1, 1)),
        "Invalid units 'degC' of 'object_temperature' of the result",
    ),
]
"""Call that is refused -> what its message says."""


@pytest.mark.parametrize(("call", "message"), CASES)
def test_a_wrong_argument_is_named(call: Call, message: str) -> None:
    """A TypeError or ValueError that says what, which value, and what it must be."""
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        call()
    assert "Must" in str(caught.value)


def few(part: xr.DataArray) -> xr.DataArray:
    """Two frames."""
    return part.isel(time=slice(0, 2))


def film(emission: xr.DataArray = OBJECT, change: xr.DataArray = CHANGE) -> list[Any]:
    """A film of two frames."""
    parts = (few(APPARENT), few(emission), few(change))
    return list(drawings.scenes.separated_film(*parts, title="a"))


def rows(
    emission: xr.DataArray = OBJECT,
    change: xr.DataArray = CHANGE,
    frames: xr.DataArray = APPARENT,
) -> Any:
    """A figure of two frames."""
    labels = ("a [K]", "b [K]", "c [K]")
    parts = (few(frames), few(emission), few(change))
    return figures.separated_frames(*parts, title="plate", labels=labels)


LAID: dict[str, tuple[Callable[[Any], Any], Labelled, str]] = {
    "solve mask of pixels": (lambda it: solve(mask=it), PIXELS, "y x"),
    "solve mask of frames": (lambda it: solve(mask=it), FRAMES, "time"),
    "solve mask": (lambda it: solve(mask=it), FRAMES & PIXELS, "time y x"),
    "solve pool": (lambda it: solve(pool=it), PIXELS.astype(int), "y x"),
    "solve emissivity": (lambda it: calibrated(emissivity=it), MAPS, "y x band"),
    "solve emissivity_std": (
        lambda it: calibrated(emissivity=MAPS, emissivity_std=0.1 * it),
        MAPS,
        "y x band",
    ),
    "solve reflection_shift": (lambda it: solve(reflection_shift=it), FIELD, "y x"),
    "solve response": (lambda it: separation.solve(CAPTURE, it), CAMERA, "band"),
    "materials": (grouped, RESULT, "time y x band"),
    "reflected_change": (lambda it: reflected_change(it, RESULT), APPARENT, "time y x"),
    "apparent": (lambda it: response.apparent_temperature(it, COUNTS), CAMERA, "band"),
    "fit_response": (fitted, CAMERA["noise"], "band"),
    "correct": (lambda it: correction.correct(EVEN, it), PLAIN, "y x band"),
    "renew_offset": (lambda it: correction.renew_offset(PLAIN, it), FLAT, "y x band"),
    "correct_capture flat": (lambda it: correcting(flat=it), FLAT, "y x band"),
    "correct_capture drift_reference": (lambda it: correcting(drift_reference=it), PIXELS, "y x"),
    "undo_drift": (lambda it: correction.undo_drift(CAPTURE, it), PIXELS, "y x"),
    "undo_lag": (lambda it: correction.undo_lag(CAPTURE, 0.01 + 0.01 * it), STEPS, "band"),
    "find_shutter": (lambda it: correction.find_shutter(CAPTURE, closed=it), CLOSED, "time"),
    "align offset": (lambda it: aligned(offset=it), STEPS, "band"),
    "align transform": (lambda it: aligned(offset=0.0, transform=it), TRANSFORM, "band"),
    "bounds": (lambda it: limits.bounds(SCENE.isel(y=[0]), it), CAMERA, "band"),
    "plan": (lambda it: limits.plan(TABLE.isel(material=[0]), it), NOISE, "band"),
    "rank_filters": (lambda it: rank_filters(TABLE, it), NOISE, "band"),
    "truth_and_estimate": (lambda it: truth_and_estimate(it, RESULT, (1, 1)), SCENE, "y x"),
    "separated_frames emission": (lambda it: rows(emission=it), OBJECT, "time y x"),
    "separated_frames reflection": (lambda it: rows(change=it), CHANGE, "time y x"),
    "separated_film emission": (lambda it: film(emission=it), OBJECT, "time y x"),
    "separated_film change": (lambda it: film(change=it), CHANGE, "time y x"),
    "emissivity_by_contact": (
        lambda it: drawings.calibration.emissivity_by_contact(CONTACT, it),
        CONTACT["emissivity"],
        "material band",
    ),
    "observe": (lambda it: simulation.observe(SCENE, it, RNG), CAMERA, "band"),
    "capture": (lambda it: simulation.capture(CAPTURE, it), DETECTOR, "y x band"),
}
"""Function of a second array, that array, and its dims whose coordinates count."""


def moved(array: Labelled, dim: str) -> Labelled:
    """The same values on other coordinates: those of the window beside, or other names."""
    values = array[dim].values
    other = values + 1 if values.dtype.kind in "if" else np.char.add(values.astype(str), "'")
    return array.assign_coords({dim: (dim, other, array[dim].attrs)})


@pytest.mark.parametrize("name", LAID)
def test_coordinates_must_agree(name: str) -> None:
    """On the same coordinates, rounded or without those that may be missing, it runs.

    Others, another order, as mirrored, and another size are refused by the dim or band and value.
    """
    call, array, dims = LAID[name]
    rounded = {
        dim: (dim, array[dim].values * (1 + 2e-16), array[dim].attrs)
        for dim in {*dims.split()} & {"time", "y", "x"}
    }
    call(array.assign_coords(rounded))
    if isinstance(array, xr.DataArray):
        call(array.drop_vars([dim for dim in ("y", "x") if dim in array.coords]))
    for dim in dims.split():
        other = moved(array, dim)
        message = f"Invalid '{dim}' of .*: {other[dim].values[0]} at"
        assert_refused("Missing band '" if dim == "band" else message, call, other)
        if dim in {"time", "y", "x"}:
            assert_refused(f"'{dim}'", call, array.isel({dim: slice(None, None, -1)}))
        if dim in {"time", "y", "x"} and "separated_f" not in name and "frames" not in name:
            assert_refused(f"Invalid size .* of '{dim}'", call, array.isel({dim: slice(1, None)}))


@pytest.mark.parametrize(
    ("here", "there", "same"),
    [
        (np.arange(60), np.arange(60.0) + 1e-13, True),
        (np.cumsum(np.full(60, 0.1)), 0.1 * np.arange(1, 61), True),
        (TIME.astype(np.float32), TIME, True),
        (1.7e9 + TIME, 1.7e9 + TIME + 1 / 60, False),
        (TIME, np.where(TIME == 3.0, np.nan, TIME), False),
        (2**53 + 2 * np.arange(60), 2**53 + 2 + 2 * np.arange(60), False),
    ],
)
def test_times_differ_beyond_rounding(here: Any, there: Any, *, same: bool) -> None:
    """Coordinates are the same within rounding, whatever their type and size."""
    first, second = (COUNTS[0].drop_vars("time").assign_coords(time=time) for time in (here, there))
    with raising(None if same else "Invalid 'time' of "):
        xr.testing.assert_identical(laid_on(second, first, "the second", "the first"), first)


@pytest.mark.parametrize(
    "capture", [CAPTURE.where(COUNTS < 0), CAPTURE.where(COUNTS["band"] != "9.5")]
)
def test_a_capture_without_samples_is_named(capture: xr.Dataset) -> None:
    """All pixels are flagged; a mask of everything is said in the same words."""
    calls: tuple[Call, ...] = (
        lambda: separation.separate(capture, CAMERA),
        lambda: solve(mask=PIXELS & False),
    )
    for call in calls:
        with pytest.warns(UserWarning, match="Invalid samples in all of 48 pixels.*Must") as notes:
            result = call()
        assert np.all(result["status"] == np.uint32(Status.INVALID_SAMPLES))
        assert str(notes[0].message) in result.attrs["warnings"]


def test_a_reference_far_off_is_named() -> None:
    """A patch that the calibrated cameras read 20 K colder than stated is told, with how much."""
    black = response.counts(CAMERA, xr.full_like(OBJECT, 300.0)) + RNG.normal(0, 4, COUNTS.shape)
    raw, patch = CAPTURE.assign(counts=black.round().astype(np.uint16)), PATCH.drop_vars(["y", "x"])
    right = correction.Reference(CAMERA, patch, (300.0,))
    assert "warnings" not in correction.correct_capture(raw, PLAIN, reference=right).attrs
    wrong = correction.Reference(CAMERA, patch, (320.0,))
    with pytest.warns(UserWarning, match="Patch 0 of 320 K reads about -18 K off in band '"):
        correction.correct_capture(raw, PLAIN, reference=wrong)


def test_shutter_events_of_another_capture_are_refused() -> None:
    """Events whose times are not those of their frames are of another capture."""
    events = correction.find_shutter(CAPTURE, closed=CLOSED)
    assert correction.mark_shutter(CAPTURE, events).attrs["shutter_events"] == 2
    other = events.assign(start=events["start"] + 5.0)
    with pytest.raises(ValueError, match=r"of the events: 8\.1 at position 0, where .* 3\.1"):
        correction.mark_shutter(CAPTURE, other)


def test_bands_go_by_name() -> None:
    """In another order of bands the result is the same."""
    swapped = [1, 0]
    for known in (MAPS, GLASS):
        exchanged = calibrated(emissivity=known.isel(band=swapped))
        xr.testing.assert_identical(calibrated(emissivity=known), exchanged)
    other = response.apparent_temperature(CAMERA, COUNTS.isel(band=swapped))
    xr.testing.assert_identical(other.isel(band=swapped), APPARENT)
    with pytest.raises(ValueError, match="Repeated band"):
        calibrated(emissivity=GLASS.assign_coords(band=["8-14", "8-14"]))


def test_a_foreign_folder_stays(tmp_path: Path) -> None:
    """What is no store of ours is not replaced, nor the parts of a run; ours is."""
    mine, foreign, parts = (tmp_path / n for n in ("mine.zarr", "foreign.zarr", "all.zarr.parts"))
    for folder in (mine, foreign, parts):
        folder.mkdir()
    store.save(SCENE, mine, {})  # an empty folder
    store.save(CAPTURE, mine, {})
    assert "counts" in store.open_dataset(mine)
    (foreign / "notes.txt").write_text("precious")
    (parts / "precious.txt").write_text("precious")
    calls: tuple[Call, ...] = (
        lambda: store.save(SCENE, foreign, {}),
        lambda: whole(target=foreign),
        lambda: separation.run(mine, tmp_path / "all.zarr", CAMERA),
    )
    for call in calls:
        assert_refused("Foreign folder", call)
    assert (foreign / "notes.txt").read_text() == (parts / "precious.txt").read_text() == "precious"
    (note := tmp_path / "note.zarr").write_text("precious")
    assert_refused("Foreign file", store.save, SCENE, note, {})
    assert_raises(FileNotFoundError, "an address", store.save, SCENE, "s3://bucket/a.zarr", {})
    with pytest.raises(ValueError, match="Must be at most 60 letters"):
        store.save(SCENE.rename(emissivity="a/b"), tmp_path / "a.zarr", {})


def test_a_wrong_argument_leaves_nothing_of_a_run(tmp_path: Path) -> None:
    """It is refused before anything is made."""
    wrongs: list[tuple[str, Any, str]] = [
        ("seed", "3", "Invalid"),
        ("memory", "2e9", "Invalid"),
        ("provenance", "x", "Invalid"),
        ("method", "nonsense", "Must"),
        ("method", separation.Method(min), "Unknown method Method.* of a run. Must be one of"),
        ("memory", 1e6, "Invalid memory .* byte. Must be at least .* 60 frames.$"),
    ]
    for name, wrong, message in wrongs:
        with pytest.raises((TypeError, ValueError), match=message):
            separation.run(CAPTURE, tmp_path / "a.zarr", CAMERA, **{name: wrong})
    assert not list(tmp_path.iterdir())


def test_what_was_simulated_stays_simulated() -> None:
    """By a reader, in a pair with a recording, and by a correction of simulated movies."""
    simulated, measured = recorded(origin="simulated"), recorded(1, origin="measured")
    assert simulated.attrs["origin"] == "simulated"
    assert measured.attrs["origin"] == "measured"
    assert paired(simulated, measured).attrs["origin"] == "simulated"
    capture = RAW.assign_attrs(origin="measured")
    assert correction.correct(capture, CORRECTION).attrs["origin"] == "simulated"


def test_unusual_but_good_input_passes() -> None:
    """Counts of the other byte order, and labels of any size, below 0 for none."""
    swapped = RAW.assign(counts=RAW["counts"].astype(">u2"))
    one, other = (correction.correct(raw, CORRECTION)["counts"] for raw in (RAW, swapped))
    np.testing.assert_array_equal(one, other)
    labels = xr.DataArray(np.zeros(SHAPE, np.int64), dims=("y", "x"))
    labels[:, 4:] = 2**40
    labels[0] = -5
    result = separation.separate(CAPTURE, CAMERA, materials=labels)
    small = labels.where(labels < 2**40, 1).astype(int).clip(min=-1)
    again = separation.separate(CAPTURE, CAMERA, materials=small)
    xr.testing.assert_equal(result.drop_vars("material"), again.drop_vars("material"))
    assert not np.any(result["status"] & np.uint32(Status.DEAD_PIXEL))
