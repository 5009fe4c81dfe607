"""Bands that are exchanged, a calibration of another range, and results of flags alone are told."""

import numpy as np
import pytest
import xarray as xr
from captures import RIG, people
from scenes import Scene, heard
from worlds import RESPONSE, World, seen

from dbthermal import calibration, schema, separation


@pytest.fixture(scope="module")
def glass_plate() -> Scene:
    """Glass before which people walk by, seen by two cameras whose noises in counts are alike."""
    return Scene(*people(1, 100, (12, 16)), RIG.response())


def said(capture: xr.Dataset, response: xr.Dataset) -> list[str]:
    """Warnings of the default way."""
    return list(heard(lambda: separation.separate(capture, response)).said)


def test_exchanged_recordings_are_told(glass_plate: Scene) -> None:
    """Bands that are exchanged contradict the response; no temperature stands without a flag."""
    names = list(RIG.bands)
    exchanged = glass_plate.capture.assign_coords(band=names[::-1]).sel(band=names)
    found = heard(lambda: separation.separate(exchanged, glass_plate.response))
    assert any("lie outside the" in one for one in found.said)
    assert list(found.said) == found.result.attrs["warnings"]
    status = found.result["status"].values
    beyond = (status & np.uint32(schema.Status.OUTSIDE_RESPONSE)) != 0
    stands = found.result["object_temperature"].notnull().any("time").values
    assert (status != 0).all()
    assert not (stands & ~beyond).any()


def test_samples_outside_the_calibration_are_counted(glass_plate: Scene) -> None:
    """Samples above the calibrated range are told as a share, by band; of the right one nothing."""
    assert said(glass_plate.capture, glass_plate.response) == []
    high = glass_plate.capture["counts"].copy()
    high[0, :, :3] += 60000.0
    (one, *_) = said(glass_plate.capture.assign(counts=high), glass_plate.response)
    assert one.startswith("25% of the samples of band '8-14' lie outside the ")


@pytest.mark.parametrize(("band", "kelvin"), [(1, 1.0), (0, 2.0)])
def test_a_step_of_one_camera_is_told(glass_plate: Scene, band: int, kelvin: float) -> None:
    """All pixels of one band step at once; the scene does not, nor does a marked shutter event."""
    capture, response, slopes = glass_plate.capture, glass_plate.response, [115.0, 11.5]
    late = (capture["time"] > 5.0).astype(np.float32)

    def steps(changed: xr.Dataset) -> list[str]:
        return [one for one in said(changed, response) if one.startswith("The level of band")]

    stepped = capture.copy(deep=True)
    stepped["counts"][band] += kelvin * slopes[band] * late
    (told,) = steps(stepped)
    assert told.startswith(f"The level of band '{RIG.bands[band]}' steps by ")
    assert "at 5.1 s in all pixels" in told
    assert steps(stepped.assign(segment=late.astype(np.int32))) == []
    both = capture.copy(deep=True)
    both["counts"] += kelvin * late * xr.DataArray([115.0, 2 * 11.5], dims="band")
    assert steps(both) == []  # the room's light is switched
    flickering = capture.copy(deep=True)
    noise = np.random.default_rng(1).normal(0.0, 0.05, capture.sizes["time"])  # K, of all pixels
    flickering["counts"][band] += slopes[band] * xr.DataArray(noise, dims="time")
    assert steps(flickering) == []
    # A resampling of one band left out where most of the change is: what it keeps cancels.
    kelvins = np.resize([4.0, -2.0, 4.0, 2.0, 4.0, 0.0, 4.0, -2.0, 2.0], both["counts"].shape[2:])
    moved = xr.DataArray(kelvins, dims=("y", "x"))
    partly = capture.copy(deep=True)
    partly["counts"] += late * xr.DataArray(slopes, dims="band") * moved
    kept = (partly["band"] != RIG.bands[1 - band]) | (partly["time"] < 5.0) | (moved < 4.0)
    assert steps(partly.assign(counts=partly["counts"].where(kept))) == []


def test_dead_rows_do_not_set_the_bands_apart() -> None:
    """Two rows that one camera does not see, and nobody marked, are theirs alone."""
    capture, _ = seen(World(), 1)
    film = capture["counts"].values
    film[0, :, 20:22] = film[0, 0, 20:22]
    assert said(capture, RESPONSE) == []


def test_exchanged_blackbody_is_told_by_the_netd() -> None:
    """A filter that is quieter than the open camera is warned of, and the sentence stays."""
    counts, noise = RIG.response()["counts"], RIG.response()["noise"]
    assert "warnings" not in calibration.fit_response(counts, noise).attrs
    exchanged = (one.assign_coords(band=list(RIG.bands)[::-1]) for one in (counts, noise))
    with pytest.warns(UserWarning, match=r"Noise of .* in band '9.5', of .* K in '8-14', which"):
        fitted = calibration.fit_response(*exchanged)
    assert len(fitted.attrs["warnings"]) == 1
    assert "temperatures of " in fitted.attrs["blackbody"]
