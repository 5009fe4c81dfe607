"""From raw counts of two cameras to temperatures in one call, in memory and by rows."""

import re
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG

from dbthermal import alignment, separation, simulation, store
from dbthermal.correction import correct_capture
from dbthermal.scene import separate_capture
from reproduction import disturbances
from reproduction.experiments import whole
from reproduction.experiments.pictures import Picture, smooth_shift

FRAME = 0.1  # [s]
STEP = 0.004  # of the simulated scene's clock [s]
INTERVAL = 1.96


def recorded(
    shape: tuple[int, int],
    walkers: int,
    shift: tuple[float, float] | None,
    seed: int,
    late: float = 0.0,
    *,
    stamped: bool = False,
) -> tuple[xr.Dataset, ...]:
    """Truth, raw capture, correction and response of 200 frames of people before glass.

    The second camera sees the reflections at a shift [pixel], and is exposed `late` [s].
    """
    rng, every, later = np.random.default_rng(seed), round(FRAME / STEP), round(late / STEP)
    every = every if later else 1
    time = np.arange(199 * every + 1 + later) * FRAME / every
    field = None if shift is None else smooth_shift(shape, *shift)
    truth = Picture(shape=shape, walkers=walkers).draw(time, GLASS, rng, field)
    taken: Any = {"every": every, "offsets": (0, later), "frames": 200}
    seen = disturbances.expose(truth, RIG.response(), rng, **taken)
    seen = seen if stamped else seen.drop_vars("exposure_time")
    detector = simulation.pattern(RIG, shape, rng)
    movies = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 6), 16, detector, rng)
    return truth, simulation.capture(seen, detector), *whole.calibrate(movies)


def accuracy(result: xr.Dataset, truth: xr.Dataset) -> tuple[float, float, float]:
    """Pixels without a flag [1]; RMS error of their object [K]; 95 % intervals that hold [1]."""
    good = result["status"] == 0
    error = result["object_temperature"] - truth["object_temperature"].interp(
        time=result["time"], kwargs={"fill_value": "extrapolate"}
    )
    inside = abs(error) < INTERVAL * result["object_temperature_std"]
    inside = inside.where(error.notnull() & good)
    rms = float((error.where(good) ** 2).mean() ** 0.5)
    return float(good.mean()), rms, float(inside.mean())


STAMPED = pytest.param((36, 48), None, 0.048, True, marks=pytest.mark.slow)  # as a wheel's bands


@pytest.mark.parametrize(
    ("shape", "shift", "late", "stamped"),
    [((28, 40), (3.0, 0.0), 0.0, False), ((36, 48), None, 0.024, False), STAMPED],
    ids=["apart", "one place", "one place, stamped"],
)
def test_commands_and_one_call_agree(
    shape: tuple[int, int], shift: tuple[float, float] | None, late: float, stamped: bool
) -> None:
    """Simulated people before cameras apart, or late: both ways find the clocks and agree.

    A parallax is no delay, a delay of cameras at one place is not spoilt, and after the resampling
    nearly all pixels have no flag.
    """
    truth, raw, fitted, response = recorded(shape, 4, shift, 2, late, stamped=stamped)
    if shift is not None:  # as by --offset 0 of the import
        raw = raw.assign_attrs(offset=0.0, offset_by="caller")
    corrected = correct_capture(raw, fitted)
    plain = alignment.time_offset(corrected)
    aligned = alignment.align(corrected)
    steps = separation.separate(aligned, response)
    one_call = separate_capture(raw, fitted, response, registration=None)
    beyond = 0.0 if stamped else late
    offsets = [one.attrs["time_offset"][1] for one in (aligned, one_call)]
    apart = abs(one_call["object_temperature"] - steps["object_temperature"])
    agree = (apart < one_call["object_temperature_std"]).where(apart.notnull())
    figures = [accuracy(one, truth) for one in (steps, one_call)]
    bridged = float(steps["bridged"].mean())
    print(
        f"all pixels tell {plain:.4f} s; found {offsets} s, true {beyond}; "
        f"no flag, RMS [K], hold: {np.round(figures, 3).tolist()}; bridged {bridged:.3f}; "
        f"differ by less than a deviation in {float(agree.mean()):.4f}"
    )
    np.testing.assert_allclose(offsets, beyond, rtol=0, atol=0.02 * FRAME)
    assert float(agree.mean()) > 0.99
    for good, rms, hold in figures:
        assert good > 0.9
        assert rms < 0.15  # [K]
        assert hold > 0.9
    if shift is None:
        assert 0.0 < bridged < 0.05
        assert not bool(steps["bridged"].all("time").any())
    else:  # else the scene would not tell
        assert abs(plain) > FRAME
        assert aligned.attrs["time_offset"] == [0.0, 0.0]
        assert "reflection_shift" in one_call


def test_a_response_of_another_integration_time() -> None:
    """Cameras apart whose noise is not as stated: all steps take the same band for the quietest."""
    truth, raw, correction, response = recorded((24, 40), 4, (3.0, 0.0), 1)
    noise = response["noise"].where(response["band"] != "9.5", 0.02 * response["noise"])
    options: dict[str, Any] = {"registration": None, "aligning": {"offset": 0.0}}
    with pytest.warns(UserWarning, match="The noise of the capture, which is used, is"):
        result = separate_capture(raw, correction, response.assign(noise=noise), **options)
    assert result.attrs["reference_band"] == "8-14"
    good, rms, hold = accuracy(result, truth)
    print(f"no flag {good:.3f}, RMS {rms:.3f} K, hold {hold:.3f}")
    assert good > 0.5
    assert rms < 0.15  # [K]
    assert hold > 0.9


@pytest.mark.parametrize("wrong", [{"workers": 0}, {"prior": "gold"}, {"surroundings": 9000.0}])
def test_what_cannot_be_is_refused_before_the_work(wrong: dict[str, Any]) -> None:
    """Options of the last step come before the clocks, which of a still scene cannot be found."""
    _, raw, correction, response = recorded((24, 40), 0, None, 1)
    with pytest.raises(ValueError, match=r"workers 0|Unknown prior 'gold'|surroundings \[K\] 9000"):
        separate_capture(raw, correction, response, registration=None, separating=wrong)


def test_a_target_has_the_same_result(tmp_path: Path) -> None:
    """Films on disk, from a lazy capture to a store, of cameras apart, are those in memory."""
    truth, raw, fitted, response = recorded((24, 36), 6, (2.4, 1.2), 5)
    path = tmp_path / "raw.zarr"
    store.save(raw, path, {})
    options: dict[str, Any] = {"registration": None, "aligning": {"offset": 0.0}}
    at_once = separate_capture(raw, fitted, response, **options)
    options["target"] = tmp_path / "all.zarr"
    lazy = separate_capture(store.open_dataset(path), fitted, response, **options)
    assert "..." in repr(lazy)  # not read
    assert "reflection_shift" in at_once
    good, rms, hold = accuracy(at_once, truth)
    print(f"{good:.2f} without a flag, {rms:.3f} K, intervals hold {hold:.3f}")
    assert good > 0.8
    assert rms < 0.2  # [K]
    assert sorted(one.name for one in tmp_path.iterdir()) == ["all.zarr", "raw.zarr"]
    for name in at_once.data_vars:
        # The level at which the residual pattern is stated is that of other samples.
        tolerance = 0.01 if str(name).endswith("_std") else 1e-3
        np.testing.assert_allclose(
            lazy[name], at_once[name], rtol=tolerance, atol=1e-5, err_msg=str(name)
        )


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
    """Rows of 640 pixels at 60 Hz for 35 s, cameras apart, from raw counts: at most 6 GB."""
    rig: dict[str, Any] = {"shift": (2.4, 1.2), "view": (3, -2), "late": 1, "shutter": (0.4,)}
    options = {**rig, "lost": (0.03, 0.005), "steps": 9, "frames": 16}
    recording = whole.record((48, 640), (2100, 60.0), 1, **options)
    fitted, response = whole.calibrate(recording.movies)
    store.save(recording.capture, tmp_path / "raw.zarr", {})
    del recording
    options = {"transform": whole.registration(rig["view"])}
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        most = fresh.submit(peak, tmp_path, fitted, response, options).result()
    good = float((store.open_dataset(tmp_path / "all.zarr")["status"] == 0).mean())
    print(f"{most / 1e9:.2f} GB, {good:.2f} of the pixels without a flag")
    assert most < 6e9
