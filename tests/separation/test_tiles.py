"""Tiles cover the image, hold its signals, and their estimates return to their places."""

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr

from dbthermal import response, simulation
from dbthermal.schema import Status
from dbthermal.separation import _inputs, _tiles, get_method
from dbthermal.simulation import Rig

TIME = np.arange(40) / 10.0  # s
RIG = Rig()


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    """Seven rows of nine pixels, the noisier band first."""
    emissivity = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
    rng = np.random.default_rng(1)
    scene = simulation.walkers(TIME, (7, 9), emissivity, rng, crossings=2)
    return simulation.observe(scene, RIG.response(), rng).isel(band=[1, 0])


def inputs_of(capture: xr.Dataset, method: str = "subspace", **known: object) -> _inputs.Inputs:
    """Checked inputs of a method."""
    none = dict.fromkeys(("settings", "emissivity", "emissivity_std", "mask", "pool"))
    none["reflection_shift"] = None
    given: dict[str, object] = {**none, "seed": 3, "response_kind": "exact", **known}
    return _inputs.check(
        capture,
        RIG.response(),
        get_method(method),
        method,
        **given,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("pixels", [1, 4, 9, 20, 100])
def test_windows_cover_the_rows_once(pixels: int) -> None:
    """Every pixel of the rows lies in one window, none of which is too large."""
    seen = np.zeros((12, 9), dtype=int)
    for window in _tiles.windows(slice(3, 10), 9, pixels):
        seen[window] += 1
        assert _tiles.numbers(window, 9).size <= pixels
    assert np.all(seen[3:10] == 1)
    assert seen.sum() == 7 * 9


def test_numbers_are_those_of_the_flat_image() -> None:
    """A window's pixels by their place in the raveled image."""
    image = np.arange(12 * 9).reshape(12, 9)
    window = (slice(4, 7), slice(2, 5))
    np.testing.assert_array_equal(_tiles.numbers(window, 9), image[window].ravel())


def test_tile_holds_the_linearised_signals_quietest_band_first(capture: xr.Dataset) -> None:
    """Signals, noise and responses of the window, relative to the reference."""
    cuts = list(_tiles.cut(inputs_of(capture), slice(2, 7)))
    assert [cut.window for cut in cuts] == [(slice(2, 7), slice(0, 9))]
    ((frames, pixels, tile),) = cuts[0].parts
    assert frames.all()
    assert pixels.all()
    assert [curve.band for curve in tile.curves] == list(RIG.bands)
    assert tile.noise == pytest.approx(RIG.noise[:2])
    curve = response.curve(RIG.response(), "8-14")
    counts = capture["counts"].sel(band="8-14").isel(y=slice(2, 7)).values.reshape(40, -1)
    expected = curve.linearise(counts) - curve.reference
    np.testing.assert_allclose(tile.signals[0], expected, rtol=0, atol=1e-9)  # K


def test_known_emissivities_go_along(capture: xr.Dataset) -> None:
    """Emissivity and material of a tile are those of its pixels, in the tile's order of bands."""
    image = np.linspace(0.5, 0.9, 63).reshape(7, 9)
    known = xr.DataArray(np.stack([image - 0.1, image]), dims=("band", "y", "x"))
    flat = image.ravel()
    material = _tiles.Material(np.stack([flat, flat]), flat, flat, flat, flat, flat)
    checked = inputs_of(capture, "calibrated", emissivity=known)
    ((_, _, tile),) = next(_tiles.cut(checked, slice(2, 7), material)).parts
    assert tile.emissivity is not None
    assert tile.material is not None
    np.testing.assert_array_equal(tile.emissivity, np.stack([flat, flat - 0.1])[:, 18:])
    np.testing.assert_array_equal(tile.material.emissivity, flat[18:])


def test_a_pixel_that_lacks_frames_has_a_tile_of_its_own(capture: xr.Dataset) -> None:
    """A pixel with missing frames gets its own tile; no other pixel loses frames."""
    there = np.ones((40, 7, 9), dtype=bool)
    there[10:16, 1, 2] = False
    mask = xr.DataArray(there, dims=("time", "y", "x"))
    (cut,) = _tiles.cut(inputs_of(capture, mask=mask), slice(0, 7))
    sizes = {(tile.time.size, int(pixels.sum())) for _, pixels, tile in cut.parts}
    assert sizes == {(40, 62), (34, 1)}


def estimate(pixels: int, frames: int = 5) -> _tiles.Estimate:
    """Estimate of 300 K + number of the pixel, without a bit."""
    film, share = np.ones((frames, pixels)), np.ones((2, pixels))
    return _tiles.Estimate(
        object_temperature=300.0 + np.arange(pixels) * film,
        object_temperature_std=0.1 * film,
        background_temperature=290.0 * film,
        background_temperature_std=film,
        emissivity=0.8 * share,
        emissivity_std=0.01 * share,
        status=np.zeros(pixels, dtype=np.uint32),
    )


def selected(*places: int, size: int = 4) -> npt.NDArray[np.bool_]:
    """Mask with some places set."""
    return np.isin(np.arange(size), places)


def test_pixels_come_back_to_their_places() -> None:
    """Selecting and replacing are inverse."""
    whole = estimate(4)
    part = whole.select_pixels(selected(1, 3))
    np.testing.assert_array_equal(part.object_temperature[0], [301.0, 303.0])
    back = estimate(4)
    back.replace_pixels(selected(1, 3), part)
    np.testing.assert_array_equal(back.object_temperature, whole.object_temperature)


def test_undefined_quantities_lose_their_deviation_too() -> None:
    """An undefined quantity is NaN with its standard deviation, in its own pixels alone."""
    nowhere = selected()
    found = estimate(4).undefine(selected(1), nowhere, selected(2))
    for name, pixel in (("object_temperature", 1), ("background_temperature", 2)):
        for ending in ("", "_std"):
            lost = np.isnan(getattr(found, name + ending)).all(axis=0)
            np.testing.assert_array_equal(lost, selected(pixel))
    assert np.isfinite(found.emissivity).all()


def test_range_allows_for_the_noise() -> None:
    """A temperature is flagged from five standard deviations beyond the calibrated range."""
    curve = response.curve(RIG.response(), "8-14")
    found = estimate(4)
    found.object_temperature[2] = curve.highest + np.array([0.0, 0.4, 0.6, np.nan])
    checked = found.check_range(curve)
    expected = [0, 0, Status.OUTSIDE_RESPONSE, Status.OUTSIDE_RESPONSE]
    np.testing.assert_array_equal(checked.status, expected)
    assert np.isnan(checked.object_temperature_std[2, 3])
