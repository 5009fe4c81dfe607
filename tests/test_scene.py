"""From raw counts of two cameras to temperatures in one call, in memory and by rows."""

import math
import re
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import _arrays, _rows, scene, schema, simulation, store
from dbthermal.alignment import align
from dbthermal.correction import correct_capture
from dbthermal.scene import separate_capture
from dbthermal.simulation import Rig
from reproduction.experiments import whole
from reproduction.experiments.pictures import Picture, smooth_shift

SHAPE, RIG = (32, 40), Rig()


@pytest.fixture(scope="module")
def plate() -> tuple[xr.Dataset, xr.Dataset, xr.Dataset, xr.Dataset]:
    """Truth, raw capture, correction and response: glass that two cameras see from one place."""
    rng = np.random.default_rng(3)
    glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
    truth = simulation.walkers(np.arange(200) / 10.0, SHAPE, glass, rng)
    detector = simulation.pattern(RIG, SHAPE, rng)
    movies = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 6), 16, detector, rng)
    raw = simulation.capture(simulation.observe(truth, RIG.response(), rng), detector)
    return truth, raw, *whole.calibrate(movies)


def test_a_target_has_the_same_result(
    plate: tuple[xr.Dataset, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By rows, from a lazy capture to a store, the result is that of one call in memory."""
    _, raw, fitted, response = plate
    path = tmp_path / "raw.zarr"
    store.save(raw, path, {})
    monkeypatch.setattr(_rows, "_BLOCK", 100_000)
    options: dict[str, Any] = {"registration": None, "aligning": {"offset": 0.0}}
    at_once = separate_capture(raw, fitted, response, **options)
    lazy = separate_capture(
        store.open_dataset(path), fitted, response, **options, target=tmp_path / "all.zarr"
    )
    assert "..." in repr(lazy)  # not read
    for name in at_once.data_vars:
        # The level at which the residual pattern is stated is that of other samples.
        tolerance = 0.01 if str(name).endswith("_std") else 1e-6
        np.testing.assert_allclose(
            lazy[name], at_once[name], rtol=tolerance, atol=1e-5, err_msg=str(name)
        )


def test_cameras_apart_have_the_same_result_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Films on disk, of which each camera sees another place, are those of one call in memory."""
    monkeypatch.setattr(_arrays, "_LEAST", 0)
    shape, rng = (40, 64), np.random.default_rng(5)
    glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
    picture = Picture(shape=shape, walkers=8)
    shift = smooth_shift(shape, 2.4, 1.2)
    truth = picture.draw(np.arange(200) / 10.0, glass, rng, shift)
    detector = simulation.pattern(RIG, shape, rng)
    movies = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 6), 16, detector, rng)
    raw = simulation.capture(simulation.observe(truth, RIG.response(), rng), detector)
    calibrated = whole.calibrate(movies)
    options: dict[str, Any] = {"registration": None, "aligning": {"offset": 0.0}}
    at_once = separate_capture(raw, *calibrated, **options)
    on_disk = separate_capture(raw, *calibrated, **options, target=tmp_path / "all.zarr")
    assert "reflection_shift" in at_once
    good = float((at_once["status"] == 0).mean())
    error = abs(at_once["object_temperature"] - truth["object_temperature"])
    print(f"{good:.2f} without a flag, {float(error.median()):.3f} K")
    assert good > 0.8
    assert float(error.median()) < 0.1  # [K]
    assert [one.name for one in tmp_path.iterdir()] == ["all.zarr"]
    for name in at_once.data_vars:
        np.testing.assert_allclose(on_disk[name], at_once[name], rtol=1e-3, err_msg=str(name))


Seen = Callable[[float], tuple[float, int]]


def clocks_tried(
    plate: tuple[xr.Dataset, ...],
    monkeypatch: pytest.MonkeyPatch,
    start: list[float],
    seen: Seen,
    std: float = 0.0,
) -> tuple[list[float], list[float], xr.Dataset]:
    """Offsets found, from those that what moves one way tells; those tried [frame]; the result.

    By an offset of the other bands [frame] a camera is seen late [frame], with a deviation, and one
    is the reference.
    """
    _, raw, fitted, response = plate
    corrected, frame, tried = correct_capture(raw, fitted), 0.1, list[float]()
    bands = [*RIG.bands, "more"][: len(start)]
    corrected = corrected.isel(band=[0, 1, 1][: len(bands)]).assign_coords(band=bands)

    def started(capture: xr.Dataset, offset: xr.DataArray | None = None, **_: Any) -> xr.Dataset:
        first = xr.DataArray(np.array(start) * frame, dims="band", coords={"band": bands})
        return align(capture, offset=first if offset is None else offset)

    def shift(aligned: xr.Dataset, _: xr.Dataset) -> xr.Dataset:
        offsets = np.array(aligned.attrs["time_offset"]) / frame
        tried.append(float(offsets[1:].mean()))
        late, reference = seen(tried[-1])
        told = {"delay": late * frame, "delay_std": std * frame}
        return xr.Dataset(attrs={"reference_band": bands[reference], **told})

    monkeypatch.setattr(scene, "align", started)
    monkeypatch.setattr(scene, "_shift", shift)
    monkeypatch.setattr(scene, "seen_apart", lambda _: True)
    monkeypatch.setattr(scene, "cameras_apart", lambda *_: (1.0, []))
    aligned, field = scene._aligned(corrected, response, {})
    found = [offset / frame for offset in aligned.attrs["time_offset"]]
    assert field is not None
    assert abs(field.attrs["delay"]) == abs(seen(float(np.mean(found[1:])))[0] * frame)
    return found, tried, aligned


@pytest.mark.parametrize("start", [-3.6, -0.25, 0.3, 0.549])
@pytest.mark.parametrize("slope", [0.3, 0.8, 3.0])
def test_clocks_are_found_from_a_poor_start(
    plate: tuple[xr.Dataset, ...], monkeypatch: pytest.MonkeyPatch, start: float, slope: float
) -> None:
    """A delay seen too short or too long, with an error, leads to the clock by which it is none.

    No delay is seen at clocks that are set together, for which these have no reason to be.
    """
    true = 0.55

    def seen(clock: float) -> tuple[float, int]:
        error = 0.02 * math.sin(5.0 * clock)
        return (0.0 if clock == 0.0 else slope * (true - clock) + error), 0

    (_, found), tried, aligned = clocks_tried(plate, monkeypatch, [0.0, start], seen)
    print(f"from {start} frames, in {len(tried)} trials: {found:.3f}, true {true}")
    assert abs(found - true) < 0.02 / slope + 0.02
    assert "warnings" not in aligned.attrs


def test_clocks_of_other_bands_stay_apart(
    plate: tuple[xr.Dataset, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three bands the others move together: what they differ by was told before."""
    found, *_ = clocks_tried(plate, monkeypatch, [0.0, 0.9, -1.0], lambda clock: (0.2 - clock, 0))
    np.testing.assert_allclose(found, [0.0, 1.15, -0.75], atol=0.02)


def test_clocks_are_found_of_either_reference(
    plate: tuple[xr.Dataset, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The band that is interpolated may be the quietest then: what is late, is the other one."""

    def seen(clock: float) -> tuple[float, int]:
        return (0.45 - clock, 0) if abs(clock - round(clock)) > 0.15 else (clock - 0.45, 1)

    (_, found), *_ = clocks_tried(plate, monkeypatch, [0.0, -0.3], seen)
    assert abs(found - 0.45) < 0.02


def test_clocks_that_windows_tell_differently_are_doubted(
    plate: tuple[xr.Dataset, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No delay is left, but parts of the image contradict one another."""
    with pytest.warns(UserWarning, match=r"clocks may be off by 0\.2 frames"):
        (_, found), *_ = clocks_tried(plate, monkeypatch, [0.0, 0.1], lambda c: (0.1 - c, 0), 0.2)
    assert abs(found - 0.1) < 0.02


@pytest.mark.parametrize("after", [0.3, np.nan])
def test_clocks_that_nothing_tells_are_doubted(
    plate: tuple[xr.Dataset, ...], monkeypatch: pytest.MonkeyPatch, after: float
) -> None:
    """Where the reflections are seen late by every clock, or by one alone, the result says so."""

    def seen(clock: float) -> tuple[float, int]:
        return (0.3 if abs(clock + 0.2) < 0.01 else after), 0

    with pytest.warns(UserWarning, match=r"clocks may be off by 0\.3 frames"):
        (_, found), tried, aligned = clocks_tried(plate, monkeypatch, [0.0, -0.2], seen)
    assert abs(found + 0.2) < 0.01
    assert len(tried) == 3
    assert "0.3 frames" in aligned.attrs["warnings"][-1]


@pytest.mark.slow
def test_a_large_image_is_aligned_by_means(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clocks and the shift of means over squares are those of all pixels."""
    rig: dict[str, Any] = {"shift": (2.4, 1.2), "view": (3, -2), "late": 1, "shutter": (0.4,)}
    recording = whole.record(
        (64, 96), (300, 10.0), 1, **rig, lost=(0.03, 0.005), steps=6, frames=16
    )
    fitted, response = whole.calibrate(recording.movies)
    corrected = correct_capture(recording.capture, fitted)
    options = {"transform": whole.registration(rig["view"])}
    aligned, found = [], []
    for pixels in (64 * 96, 64 * 96 // 4):
        monkeypatch.setattr(scene, "_PIXELS", pixels)
        capture, field = scene._aligned(corrected, response, options)
        assert field is not None
        aligned.append(capture)
        found.append(field)
    clocks = [capture.attrs["time_offset"][1] for capture in aligned]
    true = smooth_shift((66, 99), *rig["shift"])[1, 2:, :96]  # of the part that both views show
    known = found[0]["known"].values & found[1]["known"].values
    errors = [field["shift"].values[1][known] - true[known] for field in found]
    spread = [float(np.sqrt(np.mean(error**2))) for error in errors]
    print(f"clocks {clocks} s, true 0.05; shifts off by {spread} pixels, {known.mean():.2f} known")
    np.testing.assert_allclose(clocks, 0.05, atol=0.005)  # 0.05 of a frame
    assert known.mean() > 0.9
    assert spread[1] < 1.5 * spread[0]
    assert aligned[1]["counts"].shape == aligned[0]["counts"].shape
    np.testing.assert_allclose(aligned[1]["noise_factor"], aligned[0]["noise_factor"], rtol=0.02)


@pytest.mark.slow
def test_clocks_are_found_where_the_first_shift_is_false() -> None:
    """At 50 Hz what moves by the cameras' shift is seen as a delay of many frames."""
    rig: dict[str, Any] = {"shift": (-4.0, 0.8), "view": (-1, 4), "late": 2, "shutter": (0.76,)}
    recording = whole.record((48, 62), (419, 50.0), 1, **rig, lost=(0.01, 0.01), steps=4, frames=16)
    fitted, response = whole.calibrate(recording.movies)
    corrected = correct_capture(recording.capture, fitted)
    aligned, field = scene._aligned(
        corrected, response, {"transform": whole.registration(rig["view"])}
    )
    print(f"clock {aligned.attrs['time_offset'][1]:.4f} s, true 0.02")
    assert abs(aligned.attrs["time_offset"][1] - 0.02) < 0.002  # 0.1 of a frame
    assert field is not None
    assert field["known"].mean() > 0.8


def test_a_square_without_some_samples_is_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pixel that lacks samples does not step the mean; a bad one and a missing frame count."""
    rng, level = np.random.default_rng(2), np.array([20000.0, 21000.0])[:, None, None, None]
    pattern, change = rng.normal(0.0, 500.0, (2, 1, 6, 9)), rng.normal(0.0, 50.0, (2, 40, 1, 1))
    counts = (level + pattern + change).astype(np.float32)
    counts[1, 10:20, 0, 0] = np.nan  # single samples
    counts[0, 30] = np.nan  # a frame
    counts[0, :, 0:3, 3:6] = np.nan  # a square that one band does not see
    status = np.zeros((6, 9), np.uint32)
    status[4, 4] = schema.Status.DEAD_PIXEL
    counts[:, :, 4, 4] = 7.0
    corrected = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts), "status": (("y", "x"), status)},
        {"band": ["8-14", "9.5"], "time": np.arange(40) / 10.0},
    )
    monkeypatch.setattr(scene, "_PIXELS", 6)
    small = scene._of_squares(corrected)
    values = small["counts"].values
    assert values.shape == (2, 40, 2, 3)
    blind = np.zeros((2, 3), dtype=bool)
    blind[0, 1] = True
    np.testing.assert_array_equal(small["status"] != 0, blind)
    assert np.isnan(values[:, :, blind]).all()
    there = np.arange(40) != 30
    assert np.isnan(values[0, 30]).all()
    seen = values[:, there][:, :, ~blind]
    expected = np.broadcast_to(change[:, there, 0], seen.shape)
    np.testing.assert_allclose(seen - seen[:, :1], expected - expected[:, :1], atol=10.0)
    np.testing.assert_allclose(
        seen[..., 1:] - seen[:, :1, 1:], (expected - expected[:, :1])[..., 1:], atol=0.02
    )


def test_a_target_is_refused_before_the_work(plate: tuple[xr.Dataset, ...], tmp_path: Path) -> None:
    """A folder of another end is named before anything is computed."""
    with pytest.raises(ValueError, match=r"Must end in '\.zarr'"):
        separate_capture(plate[1].isel(y=slice(0, 0)), *plate[2:], target=tmp_path / "all.nc")


def peak(folder: Path, fitted: xr.Dataset, response: xr.Dataset, options: dict[str, Any]) -> int:
    """Separate what is in a folder by one thread; the most memory of this process [byte]."""
    raw, one = store.open_dataset(folder / "raw.zarr"), {"workers": 1}
    separate_capture(
        raw, fitted, response, aligning=options, separating=one, target=folder / "all.zarr"
    )
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return 1024 * int(found[1])


@pytest.mark.bench
def test_memory_of_long_captures(tmp_path: Path) -> None:
    """Rows of 640 pixels at 60 Hz for 35 s, cameras apart, from raw counts: at most 6 GB.

    Of these rows; more of them add some 4 kB a pixel.
    """
    rig: dict[str, Any] = {"shift": (2.4, 1.2), "view": (3, -2), "late": 1, "shutter": (0.4,)}
    recording = whole.record(
        (48, 640), (2100, 60.0), 1, **rig, lost=(0.03, 0.005), steps=9, frames=16
    )
    fitted, response = whole.calibrate(recording.movies)
    store.save(recording.capture, tmp_path / "raw.zarr", {})
    del recording
    options = {"transform": whole.registration(rig["view"])}
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        most = fresh.submit(peak, tmp_path, fitted, response, options).result()
    good = float((store.open_dataset(tmp_path / "all.zarr")["status"] == 0).mean())
    print(f"{most / 1e9:.2f} GB, {good:.2f} of the pixels without a flag")
    assert most < 6e9
