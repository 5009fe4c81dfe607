"""Input of `solve`: order, bad pixels and frames, and their status; test_refusals has the rest."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import response as responses
from dbthermal import schema, separation
from dbthermal.separation._tiles import Estimate
from dbthermal.simulation import Rig

RIG = Rig()
TIME = np.arange(350) / 10.0


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def test_order_of_bands_and_tiles_does_not_matter(
    glass: Glass,
) -> None:
    """The same pixels give the same values with the bands exchanged, and one by one."""
    _, capture, response = glass
    whole = separation.solve(capture, response)
    exchanged = separation.solve(capture.isel(band=[1, 0]), response).sel(band=list(RIG.bands))
    single = separation.solve(capture.isel(y=[2], x=[3]), response)
    # The prior's spectrum is a small difference: it feels the rounding of single precision.
    for name, rtol in (
        ("object_temperature", 1e-5),
        ("emissivity", 1e-5),
        ("reflection_ratio", 1e-5),
        ("background_temperature_std", 2e-3),
    ):
        np.testing.assert_array_equal(exchanged[name].values, whole[name].values)
        np.testing.assert_allclose(
            single[name].values[..., 0, 0], whole[name].values[..., 2, 3], rtol=rtol
        )


def test_temperature_outside_the_response_is_flagged(
    glass: Glass,
) -> None:
    """An object beyond the calibrated range is extrapolated and flagged, never clipped."""
    scene, capture, response = glass
    narrow = response.assign(temperature_max=xr.DataArray(323.15, attrs={"units": "K"}))
    result = separation.solve(capture, narrow)
    assert np.all(result["status"].values & schema.Status.OUTSIDE_RESPONSE)
    error = result["object_temperature"] - scene["object_temperature"]
    assert float(np.sqrt((error**2).mean())) < 0.5  # [K]


def test_saturated_counts_are_flagged(glass: Glass) -> None:
    """Counts that heap at the end of a type, or below it, are flagged where they occur."""
    _, capture, response = glass
    counts = np.rint(capture["counts"].values).astype(np.uint16)
    counts[0, 100:110, 1, 1] = 65535
    counts[1, :, 2, 3] = np.minimum(counts[1, :, 2, 3], np.quantile(counts[1, :, 2, 3], 0.8))
    whole = capture.assign(counts=(capture["counts"].dims, counts.astype(np.float32)))
    flagged = separation.solve(whole, response)["status"].values & schema.Status.SATURATED != 0
    np.testing.assert_array_equal(np.argwhere(flagged), [[1, 1], [2, 3]])


def test_masked_samples_do_not_saturate_a_pixel(glass: Glass) -> None:
    """Frames at the detector's limit that the mask leaves out leave no flag."""
    _, capture, response = glass
    counts = np.rint(capture["counts"].values).astype(np.uint16)
    counts[:, 100:110] = 65535
    used = xr.DataArray((TIME < 10.0) | (TIME >= 11.0), dims="time")
    dims, attrs = capture["counts"].dims, capture["counts"].attrs
    whole = capture.assign(counts=(dims, counts.astype(np.float32), attrs))
    result = separation.solve(whole, response, mask=used)
    assert not np.any(result["status"].values & schema.Status.SATURATED)
    assert np.all(separation.solve(whole, response)["status"] & schema.Status.SATURATED)


def test_frozen_frames_are_flagged(glass: Glass) -> None:
    """Frames that repeat while a shutter is closed are flagged in every pixel."""
    _, capture, response = glass
    frozen = capture.copy(deep=True)
    frozen["counts"].values[:, 201:206] = frozen["counts"].values[:, [200]]
    assert np.all(separation.solve(frozen, response)["status"] & schema.Status.FROZEN_FRAMES)
    assert not np.any(separation.solve(capture, response)["status"])


@pytest.mark.parametrize("band", [0, 1])
def test_frozen_frames_of_one_band_are_flagged_or_left_out(glass: Glass, band: int) -> None:
    """Two lost frames of one band cost nothing but themselves, ten are flagged everywhere."""
    scene, capture, response = glass
    for copies in (2, 10):
        frozen = capture.copy(deep=True)
        frozen["counts"].values[band, 201 : 201 + copies] = frozen["counts"].values[band, 200]
        result = separation.solve(frozen, response)
        flagged = result["status"].values & schema.Status.FROZEN_FRAMES != 0
        assert np.all(flagged) if copies > 2 else not np.any(result["status"])
        error = result["object_temperature"] - scene["object_temperature"]
        assert np.all(np.isnan(error[201 : 201 + copies]))
        assert float(np.sqrt((error**2).mean())) < 0.5  # [K]


@pytest.mark.parametrize("name", ["gray", None])
def test_a_quantity_that_is_nan_in_all_frames_has_a_flag(name: str | None) -> None:
    """A quantity that is NaN in all frames is flagged as outside the response, or by its cause."""
    before = np.full(1, 0 if name is None else schema.Status.bits()[name], dtype=np.uint32)
    warm, none, share = np.full((9, 1), 300.0), np.full((9, 1), np.nan), np.full((2, 1), 0.5)
    found = Estimate(warm, 0.1 * np.ones((9, 1)), none, none, share, 0.1 * share, before)
    status = found.check_range(responses.curve(RIG.response(), RIG.bands[0])).status
    assert status[0] == before[0] or name is None
    assert status[0] != 0
