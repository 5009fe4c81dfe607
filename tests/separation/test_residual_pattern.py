"""What a calibration of few frames leaves from pixel to pixel is part of the error bars."""

import numpy as np
import pytest
import xarray as xr
from captures import GLASS
from scenes import held

from dbthermal import correction, separation, simulation
from dbthermal.simulation import Rig

RIG = Rig(bad_fraction=0.0)
SHAPE, STEPS, TIME = (20, 24), np.linspace(278.15, 343.15, 4), np.arange(1050) / 30.0


def calibrated(seed: int, frames: int = 16) -> tuple[xr.Dataset, xr.Dataset]:
    """Detector with a fixed pattern, and its correction from so many frames a step."""
    rng = np.random.default_rng(seed)
    detector = simulation.pattern(RIG, SHAPE, rng)
    movies = simulation.blackbody_movies(RIG, STEPS, frames, detector, rng)
    return detector, correction.fit_correction(correction.blackbody_statistics(movies))


def left(detector: xr.Dataset, fitted: xr.Dataset, level: float) -> xr.DataArray:
    """Error (band, y, x) [count] of corrected counts of a view of one level [count]."""
    raw = detector["gain"] * level + detector["offset"]
    error = fitted["gain"] * raw + fitted["offset"] - level
    return error - error.mean(("y", "x"))


@pytest.mark.parametrize("away", [0.0, 1500.0])
def test_deviation_of_what_is_left(away: float) -> None:
    """The scatter of corrected pixels is the stated one, at the centre and far from it."""
    detector, fitted = calibrated(1)
    for band in range(2):
        level = float(fitted["centre"][band]) + away
        here = left(detector, fitted, level).isel(band=band)
        one = fitted.isel(band=band)
        stated = float(np.hypot(one["offset_std"], away * one["gain_std"]))
        # Of 480 pixels a deviation is known within 3 %.
        assert float(here.std()) == pytest.approx(stated, rel=0.1)


def test_two_temperatures_need_the_noise() -> None:
    """Without degrees of freedom the noise of the movies tells; without it nothing is stated."""
    rng = np.random.default_rng(2)
    detector = simulation.pattern(RIG, SHAPE, rng)
    movies = simulation.blackbody_movies(RIG, STEPS[[0, -1]], 16, detector, rng)
    statistics = correction.blackbody_statistics(movies)
    fitted = correction.fit_correction(statistics)
    level = float(fitted["centre"][0])
    here = left(detector, fitted, level).isel(band=0)
    assert float(here.std()) == pytest.approx(float(fitted["offset_std"][0]), rel=0.1)
    assert "offset_std" not in correction.fit_correction(statistics.drop_vars("noise"))


def test_a_flat_image_leaves_its_own_noise() -> None:
    """New offsets have the error of one image instead of that of all, centred on its level."""
    detector, fitted = calibrated(3)
    rng = np.random.default_rng(4)
    level, noise = 17000.0, RIG.response()["noise"] / np.sqrt(16)
    flat = detector["gain"] * level + detector["offset"]
    flat = flat + noise * xr.DataArray(rng.standard_normal(flat.shape), dims=flat.dims)
    renewed = correction.renew_offset(fitted, flat)
    for band in range(2):
        here = left(detector, renewed, level).isel(band=band)
        assert float(here.std()) == pytest.approx(float(renewed["offset_std"][band]), rel=0.1)
    np.testing.assert_allclose(renewed["centre"], level, rtol=0, atol=40.0)  # [count]


@pytest.mark.parametrize("band", RIG.bands)
def test_an_offset_moves_the_result_as_stated(band: str) -> None:
    """An offset of a count moves object and background by what it adds to the bars."""
    rng, response = np.random.default_rng(5), RIG.response()
    scene = simulation.walkers(TIME[::3], (6, 8), GLASS, rng)
    capture = simulation.observe(scene, response, rng, dtype="float64")
    offset = xr.zeros_like(response["noise"])
    offset.loc[band] = 1.0  # [count]
    before = separation.solve(capture, response)
    after = separation.solve(capture.assign(counts=capture["counts"] + offset), response)
    stated = separation.solve(capture.assign(pattern_std=offset), response)
    good = (before["status"] == 0) & (after["status"] == 0)
    for kind in ("object_temperature", "background_temperature"):
        moved = abs(after[kind] - before[kind]).where(good)
        added = (stated[f"{kind}_std"] ** 2 - before[f"{kind}_std"] ** 2) ** 0.5
        assert float((moved / added).median()) == pytest.approx(1.0, abs=0.03)
    np.testing.assert_array_equal(stated["emissivity_std"], before["emissivity_std"])


def test_intervals_hold_the_residual_pattern() -> None:
    """After a calibration of 16 frames a step 92 to 98 % hold, far fewer without the term."""
    rng, response = np.random.default_rng(1), RIG.response()
    scene = simulation.walkers(TIME, SHAPE, GLASS, rng)
    detector, fitted = calibrated(1)
    raw = simulation.capture(simulation.observe(scene, response, rng), detector)
    corrected = correction.correct_capture(raw, fitted)
    shares = {}
    for name, capture in {"with": corrected, "without": corrected.drop_vars("pattern_std")}.items():
        result = separation.solve(capture, response)
        shares[name] = held(result, scene, where=result["status"] == 0)
    assert 0.92 <= shares["with"] <= 0.98
    assert shares["without"] < 0.8
