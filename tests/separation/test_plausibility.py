"""Bands that are exchanged, a calibration of another range, and results of flags alone are told."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import calibration, schema, simulation
from dbthermal.separation._doubts import against_response, hardly_measured, of_one_camera

RIG = simulation.Rig()


def capture(rig: simulation.Rig) -> xr.Dataset:
    """Glass before which people walk by, simulated."""
    rng = np.random.default_rng(1)
    glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    scene = simulation.walkers(np.arange(100) / 10, (12, 16), glass, rng)
    return simulation.observe(scene, rig.response(), rng)


@pytest.fixture(scope="module")
def corrected() -> xr.Dataset:
    """Capture of two cameras whose noises in counts are alike."""
    return capture(RIG)


def test_right_response_is_not_spoken_against(corrected: xr.Dataset) -> None:
    """Nothing is said of a capture and its own response, nor of raw counts."""
    assert against_response(corrected, RIG.response()) == []
    raw = corrected.assign(counts=corrected["counts"].astype(np.uint16))
    assert against_response(raw, RIG.response()) == []


def test_exchanged_recordings_are_told(corrected: xr.Dataset) -> None:
    """A capture whose bands are exchanged contradicts the response by its level."""
    names = list(RIG.bands)
    exchanged = corrected.assign_coords(band=names[::-1]).sel(band=names)
    assert any("lie outside the" in one for one in against_response(exchanged, RIG.response()))


def test_samples_outside_the_calibration_are_counted(corrected: xr.Dataset) -> None:
    """A quarter of the samples above the calibrated range is told as a share, by band."""
    response = RIG.response()
    high = corrected["counts"].copy()
    high[0, :, :3] += 60000.0
    (said,) = against_response(corrected.assign(counts=high), response)
    assert said.startswith("25% of the samples of band '8-14' lie outside the ")


@pytest.mark.parametrize(("band", "kelvin"), [(1, 1.0), (0, 2.0)])
def test_a_step_of_one_camera_is_told(corrected: xr.Dataset, band: int, kelvin: float) -> None:
    """All pixels of one band step at once; the scene does not, nor does a marked shutter event."""
    response, slope = RIG.response(), [115.0, 11.5][band]
    late = (corrected["time"] > 5.0).astype(np.float32)
    stepped = corrected.copy(deep=True)
    stepped["counts"][band] += kelvin * slope * late
    (said,) = of_one_camera(stepped, response)
    print(said)
    assert said.startswith(f"The level of band '{RIG.bands[band]}' steps by ")
    assert "at 5.1 s in all pixels" in said
    assert of_one_camera(corrected, response) == []
    assert of_one_camera(stepped.assign(segment=late.astype(np.int32)), response) == []
    both = corrected.copy(deep=True)
    both["counts"] += kelvin * late * xr.DataArray([115.0, 2 * 11.5], dims="band")
    assert of_one_camera(both, response) == []  # the room's light is switched
    # A resampling of one band left out where most of the change is: what it keeps cancels.
    kelvins = np.resize([4.0, -2.0, 4.0, 2.0, 4.0, 0.0, 4.0, -2.0, 2.0], both["counts"].shape[2:])
    moved = xr.DataArray(kelvins, dims=("y", "x"))
    partly = corrected.copy(deep=True)
    change = late * xr.DataArray([115.0, 11.5], dims="band") * moved
    partly["counts"] += change
    kept = (partly["band"] != RIG.bands[1 - band]) | (partly["time"] < 5.0) | (moved < 4.0)
    partly["counts"] = partly["counts"].where(kept)
    assert of_one_camera(partly, response) == []


def test_exchanged_blackbody_is_told_by_the_netd() -> None:
    """A filter that is quieter than the open camera is warned of, and the sentence stays."""
    counts = RIG.response()["counts"]
    noise = RIG.response()["noise"]
    assert "warnings" not in calibration.fit_response(counts, noise).attrs
    exchanged = (one.assign_coords(band=list(RIG.bands)[::-1]) for one in (counts, noise))
    with pytest.warns(UserWarning, match=r"Noise of .* in band '9.5', of .* K in '8-14', which"):
        fitted = calibration.fit_response(*exchanged)
    assert len(fitted.attrs["warnings"]) == 1
    assert "temperatures of " in fitted.attrs["blackbody"]


def test_flags_alone_are_summed_up() -> None:
    """Where less than a tenth of the moving pixels is measured, the main reasons are named."""
    status = np.full((10, 10), schema.Status.BANDS_APART, np.uint32)
    status[0] = schema.Status.NO_BACKGROUND_MOTION
    status[1, :9] = 0
    result = xr.Dataset({"status": (("y", "x"), status, schema.status_attrs())})
    assert hardly_measured(result) == []
    status[1, 0] = schema.Status.SATURATED
    (said,) = hardly_measured(result)
    assert "9% of the 90 pixels with moving reflections have no flag" in said
    assert "bands_apart 81%, no_background_motion 10%, saturated 1%" in said
