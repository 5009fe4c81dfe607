"""Arguments that nobody should give: each is named, with the value and the rule, before any work.

Found by people who had not seen the code. What was accepted in silence comes first.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import xarray as xr

from dbthermal import (
    alignment,
    calibration,
    correction,
    mixing,
    noise,
    readers,
    separation,
    simulation,
    store,
)
from dbthermal.scene import separate_capture
from dbthermal.schema import Status

RIG = simulation.Rig()
RESPONSE = RIG.response()
RNG = np.random.default_rng(1)
SHAPE = (6, 8)
GLASS = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
SCENE = simulation.walkers(np.arange(60) / 10, SHAPE, GLASS, RNG)
CORRECTED = simulation.observe(SCENE, RESPONSE, RNG)
DETECTOR = simulation.pattern(RIG, SHAPE, RNG)
RAW = simulation.capture(CORRECTED, DETECTOR)
MOVIES = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 3), 16, DETECTOR, RNG)
FITTED = correction.fit_correction(correction.blackbody_statistics(MOVIES))
ALONE = separation.solve(CORRECTED, RESPONSE, workers=1)
Call = Callable[[], Any]


def recorded(band: int = 0, **attrs: str) -> xr.Dataset:
    """Recording of one band."""
    counts = RAW["counts"].isel(band=band, drop=True).assign_attrs(attrs)
    return readers.array(counts, unit="count", clock=10.0)


def paired(first: xr.Dataset, second: xr.Dataset) -> xr.Dataset:
    """Two recordings as one capture."""
    return readers.two_bands(first, second, bands=("8-14", "9.5"), offset=0.0)


def streamed(time: Any, frames: Any = None, segment: Any = 0, **options: Any) -> Any:
    """Frames that a stream takes."""
    stream = separation.Stream(CORRECTED.isel(time=[0]), RESPONSE, frame_rate=10.0, **options)
    first = CORRECTED["counts"].values[:, 0] if frames is None else frames
    return stream.update(time, first, segment=segment)


def whole(**options: Any) -> xr.Dataset:
    """All steps from raw counts."""
    return separate_capture(RAW, FITTED, RESPONSE, registration=None, **options)


def completed(result: xr.Dataset = ALONE, **options: Any) -> xr.Dataset:
    """Result, completed."""
    return separation.complete(result, CORRECTED, RESPONSE, **options)


def of_celsius() -> xr.Dataset:
    """Correction of blackbodies in degrees Celsius."""
    frames = correction.blackbody_statistics(MOVIES)
    return correction.fit_correction(frames.assign_coords(temperature=[2.0, 40.0, 70.0]))


def walkers_of_celsius() -> xr.Dataset:
    """People in a room of 22 degrees Celsius."""
    time = np.arange(9.0)
    return simulation.walkers(time, SHAPE, GLASS, RNG, temperatures=(22.0, 32.0, 60.0))


def of_flags(flag: int) -> xr.Dataset:
    """Pair of which one recording has a flag of more bits than there are."""
    flags = ("time", np.full(60, flag))
    return paired(recorded().assign(frame_flags=flags), recorded(1))


ONE, NOTHING = np.ones((60, 3)), cast(Any, None)
NEGATIVE = ALONE.assign(object_temperature_std=-ALONE["object_temperature_std"])
IN_KELVIN = CORRECTED["counts"][:, 0].assign_attrs(units="K")
EMPTY = CORRECTED.isel(y=slice(0, 0))  # so that what is refused is refused before the work
STILL = recorded().isel(time=[0])
CASES: list[tuple[Call, str]] = [
    (lambda: calibration.Bias(air_temperature=22.0), r"air_temperature \[K\] 22.0.*in kelvin"),
    (walkers_of_celsius, "temperatures.*in kelvin"),
    (of_celsius, "temperature.*in kelvin"),
    (lambda: simulation.Background(level=22.0), r"level \[K\] 22.0.*in kelvin"),
    (lambda: simulation.Background(drift=np.nan), "drift"),
    (lambda: simulation.Rig(offset=np.nan), "offset"),
    (lambda: completed(surroundings=295.0, surroundings_std=True), "surroundings_std"),
    (lambda: completed(surroundings_std=1e-30), "surroundings_std"),
    (lambda: separation.separate(EMPTY, RESPONSE, surroundings_std=1e-30), "surroundings_std"),
    (lambda: completed(NEGATIVE), "object_temperature_std.*negative"),
    (lambda: streamed(np.datetime64("2024-01-01")), "time"),
    (lambda: streamed("0.1"), "time"),
    (lambda: streamed(0.1, segment=1.5), "segment"),
    (lambda: streamed(0.1, IN_KELVIN), "units 'K'"),
    (lambda: streamed(0.1, memory=[10.0]), "memory"),
    (lambda: streamed(0.1, latency=1e9), "latency"),
    (lambda: paired(STILL, STILL), "Same counts"),
    (lambda: of_flags(65536), "frame_flags"),
    (lambda: mixing.matrix([86.0, 72.0]), "emissivity 86.0"),
    (lambda: mixing.condition_number(0.9), "two bands"),
    (lambda: noise.estimate(ONE.astype(complex), ONE, np.arange(60)), "signal"),
    (lambda: noise.second_difference(ONE[:4], [0.0, 1.0, 1.0, 2.0]), "Must rise"),
    (lambda: alignment.align(CORRECTED, offset=0.0, reflection_shift=cast(Any, 3)), "shift"),
    (lambda: correction.correct_capture(RAW, FITTED, shutter=NOTHING), "shutter"),
    (lambda: whole(correcting=None), "correct_capture.*mapping"),
    (lambda: whole(aligning={"ofset": 0.0}), "ofset.*offset"),
    (lambda: separation.separate(NOTHING, RESPONSE), "corrected"),
    (lambda: store.open_dataset(NOTHING), "path"),
    (lambda: readers.flir(NOTHING), "path"),
]


@pytest.mark.parametrize(("call", "message"), CASES)
def test_a_wrong_argument_is_named(call: Call, message: str) -> None:
    """A TypeError or ValueError that says what, which value, and what it must be."""
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        call()
    assert "Must" in str(caught.value)


def test_a_foreign_folder_stays(tmp_path: Path) -> None:
    """What is no store of ours is not replaced, nor the parts of a run; ours is."""
    mine = tmp_path / "mine.zarr"
    mine.mkdir()
    store.save(SCENE, mine, {})  # an empty folder
    store.save(CORRECTED, mine, {})
    assert "counts" in store.open_dataset(mine)
    foreign = tmp_path / "foreign.zarr"
    foreign.mkdir()
    (foreign / "notes.txt").write_text("precious")
    parts = tmp_path / "all.zarr.parts"
    parts.mkdir()
    (parts / "precious.txt").write_text("precious")
    capture = tmp_path / "capture.zarr"
    store.save(CORRECTED, capture, {})
    calls: tuple[Call, ...] = (
        lambda: store.save(SCENE, foreign, {}),
        lambda: whole(target=foreign),
        lambda: separation.run(capture, tmp_path / "all.zarr", RESPONSE),
    )
    for call in calls:
        with pytest.raises(ValueError, match="Foreign folder"):
            call()
    assert (foreign / "notes.txt").read_text() == (parts / "precious.txt").read_text() == "precious"
    with pytest.raises(FileNotFoundError, match="an address"):
        store.save(SCENE, "s3://bucket/a.zarr", {})
    with pytest.raises(ValueError, match="Must have no '/'"):
        store.save(SCENE.rename(emissivity="a/b"), tmp_path / "a.zarr", {})


def test_what_was_simulated_stays_simulated() -> None:
    """By a reader, in a pair with a recording, and by a correction of simulated movies."""
    simulated, measured = recorded(origin="simulated"), recorded(1)
    assert simulated.attrs["origin"] == "simulated"
    assert measured.attrs["origin"] == "measured"
    assert paired(simulated, measured).attrs["origin"] == "simulated"
    capture = RAW.assign_attrs(origin="measured")
    assert correction.correct(capture, FITTED).attrs["origin"] == "simulated"


def test_unusual_but_good_input_passes() -> None:
    """Counts of the other byte order, and labels of any size, below 0 for none."""
    swapped = RAW.assign(counts=RAW["counts"].astype(">u2"))
    one, other = (correction.correct(raw, FITTED)["counts"] for raw in (RAW, swapped))
    np.testing.assert_array_equal(one, other)
    labels = xr.DataArray(np.zeros((6, 8), np.int64), dims=("y", "x"))
    labels[:, 4:] = 2**40
    labels[0] = -5
    result = separation.separate(CORRECTED, RESPONSE, materials=labels)
    small = labels.where(labels < 2**40, 1).astype(int).clip(min=-1)
    again = separation.separate(CORRECTED, RESPONSE, materials=small)
    xr.testing.assert_equal(result.drop_vars("material"), again.drop_vars("material"))
    assert not np.any(result["status"] & np.uint32(Status.DEAD_PIXEL))
