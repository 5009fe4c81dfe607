"""Methods to compare with: exact under their assumptions, and undefined or wrong beyond them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import FILMS, GLASS, RIG, plain_capture
from marks import slow
from numpy.typing import NDArray
from refused import refused

from dbthermal import bands, mixing, planck, schema, separation
from dbthermal import response as responses
from dbthermal.simulation import Rig
from reproduction import experiments, methods
from reproduction.experiments import cases
from reproduction.methods.bcp import BcpSettings
from reproduction.methods.dbvt import METHOD as DBVT
from reproduction.methods.dbvt import DbvtSettings
from reproduction.methods.naive import NaiveSettings
from reproduction.methods.ratio import RatioSettings

Floats = NDArray[np.float64]
RESPONSE = RIG.response()
CURVES = [responses.curve(RESPONSE, name) for name in RIG.bands]
TIME = np.arange(120) / 4.0
WARM = np.linspace(290.0, 340.0, 24)[:, np.newaxis, np.newaxis]
KINDS = ["wide", "narrow"]


def capture_of(counts: list[Floats], names: tuple[str, ...] = RIG.bands) -> xr.Dataset:
    """Capture of counts (time, y, x) a band, without noise."""
    return plain_capture(np.stack(counts), np.arange(len(counts[0])) / 4.0, names)


def seen(warm: Floats, cold: Floats, emissivity: tuple[float, float]) -> xr.Dataset:
    """Capture of an object before a background, both (time, y, x) [K]."""
    pairs = zip(emissivity, CURVES, strict=True)
    return capture_of([mixing.leaving(e, it.counts(warm), it.counts(cold)) for e, it in pairs])


def solve(capture: xr.Dataset, method: str, settings: Any = None, **options: Any) -> xr.Dataset:
    """Separate by a method to compare with."""
    record = methods.get_method(method)
    return separation.solve(capture, RESPONSE, record, settings=settings, **options)


HEATED = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}  # someone walks by


@pytest.fixture(scope="module")
def heated() -> xr.Dataset:
    """Scene of thirty pixels."""
    return cases.simulate(HEATED, RIG, TIME, 30, seed=2)[0]


@pytest.fixture(scope="module")
def glass(heated: xr.Dataset) -> xr.Dataset:
    """Capture of the thirty pixels of glass, without noise."""
    warm, cold = (heated[name].values for name in FILMS)
    return seen(warm, cold, (0.86, 0.72))


def test_naive_meets_the_images_and_is_wrong(glass: xr.Dataset, heated: xr.Dataset) -> None:
    """Without noise the image error is zero in every pixel, and the answer kelvins off."""
    found = solve(glass, "naive", seed=5)
    rest = []
    for band, curve in enumerate(CURVES):
        parts = (found[f"{name}_temperature"].values for name in ("object", "background"))
        made = mixing.leaving(found["emissivity"].values[band], *map(curve.counts, parts))
        rest.append((glass["counts"].values[band] - made) / curve.reference_slope)
    misfit = np.sqrt(np.mean(np.square(rest), axis=(0, 1)))
    errors = found["object_temperature"] - heated["object_temperature"]
    off = float(((errors**2).mean("time") ** 0.5).median())
    of_emissivity = abs(found["emissivity"] - GLASS).median(("y", "x"))
    assert misfit.max() < 1e-3  # K
    assert off > 3.0  # K
    assert float(of_emissivity.max()) > 0.1


def test_too_few_steps_are_flagged(glass: xr.Dataset) -> None:
    """A pixel that improves at its last step is not converged; after a hundred it is."""
    _, capture, response = noisy(QUIET, 8)
    result = separation.solve(capture, response, DBVT, settings=DbvtSettings(stages=1, steps=2))
    assert np.all(result["status"].values & schema.Status.NOT_CONVERGED)
    early, late = (
        schema.has_flag(solve(glass, "naive", settings)["status"], "not_converged")
        for settings in (NaiveSettings(iterations=1), NaiveSettings())
    )
    assert np.mean(early) > 0.9
    assert np.mean(late) < 0.05


test_settings_outside_their_range = refused(
    lambda settings, options: settings(**options),
    [
        (NaiveSettings, {"starts": 0}, "Invalid starts 0 of method 'naive'. Must be at least 1."),
        (NaiveSettings, {"shift_std": -1.0}, r"Invalid shift_std \[K\] of method 'naive' -1.0"),
        (NaiveSettings, {"tolerance": 0.0}, "Invalid tolerance of method 'naive' 0.0"),
        (RatioSettings, {"kind": "wien"}, "Unknown kind 'wien' of method 'ratio'. Must be one of"),
        (DbvtSettings, {"huber": -1.0}, "Invalid huber -1.0 of method 'dbvt'. Must be at least 0."),
        (DbvtSettings, {"curvature": 0.0}, "curvature of method 'dbvt'"),
        (DbvtSettings, {"starts": 0}, "Invalid starts 0 of method 'dbvt'. Must be at least 1."),
        (DbvtSettings, {"margin": 0.5}, "margin 0.5 of method 'dbvt'. Must lie in (0, 0.5)"),
        (DbvtSettings, {"start": "truth"}, "Unknown start 'truth' of method 'dbvt'. Must be one"),
        (BcpSettings, {"patch": 4}, "Invalid patch 4 of method 'bcp'. Must be odd."),
        (BcpSettings, {"patch": "15"}, "patch '15' of method"),
        (BcpSettings, {"patch": 15.0}, "whole number"),
        (NaiveSettings, {"starts": 2.5}, "starts 2.5 of method"),
        (RatioSettings, {"order": 2.5}, "order 2.5 of method"),
        (BcpSettings, {"percentile": 101.0}, "Invalid percentile 101.0 of method 'bcp'"),
        (BcpSettings, {"least_transmission": 0.0}, "Invalid least_transmission 0.0 of method"),
    ],
)


def test_a_record_has_its_name_in_the_result() -> None:
    """An outside method is named in the result; without a name, "outside"."""
    apparent = separation.get_method("apparent")
    for record, name in ((apparent, "apparent"), (replace(apparent, name="mine"), "mine")):
        result = separation.solve(gray_body("wide", 1.0), RESPONSE, record)
        assert result.attrs["method"] == name
    assert separation.Method(apparent.separate).name == "outside"


def gray_body(kind: str, share: float) -> xr.Dataset:
    """A gray body in a room without emission, for either kind of radiance."""
    apparent = []
    for name in RIG.bands:
        band = bands.get(name)
        if kind == "wide":
            apparent.append(band.temperature(share * band.radiance(WARM)))
        else:
            radiance = share * planck.spectral_radiance(band.centre, WARM)
            apparent.append(planck.brightness_temperature(band.centre, radiance))
    return capture_of([curve.counts(level) for curve, level in zip(CURVES, apparent, strict=True)])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [1.0, 0.95, 0.6])
def test_ratio_of_a_gray_body(kind: str, share: float) -> None:
    """Without a background a gray body's temperature and emissivity are exact."""
    found = solve(gray_body(kind, share), "ratio", RatioSettings(kind, order=None))
    np.testing.assert_allclose(found["object_temperature"], WARM, rtol=0, atol=3e-5)  # K
    np.testing.assert_allclose(found["emissivity"], share, rtol=0, atol=1e-6)
    black = schema.Status.NONPHYSICAL_EMISSIVITY if share == 1.0 else 0  # outside (0, 1)
    np.testing.assert_array_equal(found["status"], black)
    assert bool(found["background_temperature"].isnull().all())


def test_ratio_smooths_before_it_divides() -> None:
    """Five polynomials in 120 frames: the noise falls by about the square root of 24."""
    warm = np.repeat(np.linspace(300.0, 325.0, 120), 40).reshape(120, 5, 8)
    capture, rng = seen(warm, warm, (1.0, 1.0)), np.random.default_rng(1)
    drawn = capture["counts"].copy(data=rng.standard_normal(capture["counts"].shape))
    noisy = capture.assign(counts=capture["counts"] + RESPONSE["noise"] * drawn)
    plain, smooth = (
        float(((solve(noisy, "ratio", setting)["object_temperature"] - warm) ** 2).mean() ** 0.5)
        for setting in (RatioSettings(order=None), RatioSettings())
    )
    assert plain / smooth == pytest.approx(24**0.5, rel=0.2)


HOT, ROOM = 320.0, 295.0
EXACT: dict[str, Any] = {"window": 1, "reflected_temperature": ROOM}  # smooths nothing


def half_black() -> xr.Dataset:
    """An image of 20 x 40 at 320 K in a room of 295 K: black left of the middle, else 0.5.

    One frame is a hair warmer: a signal that never changes is flagged.
    """
    share = np.where(np.arange(40) < 20, 1.0, 0.5) * np.ones((3, 20, 1))
    hair = (1.0 + 1e-12 * np.arange(3.0))[:, np.newaxis, np.newaxis]
    levels = [(curve.counts(HOT), curve.counts(ROOM)) for curve in CURVES]
    return capture_of([mixing.leaving(share, *pair) * hair for pair in levels])


def test_bcp_by_hand() -> None:
    """Seven columns beside the blackbody take its temperature and t = 0.5; beyond, t = 1."""
    capture = half_black()
    found = solve(capture, "bcp", BcpSettings(**EXACT))
    warm, share = found["object_temperature"].values, found["emissivity"].values
    apparent = solve(capture, "apparent")["object_temperature"].values
    close: dict[str, Any] = {"rtol": 0, "atol": 1e-4}  # K, single precision
    np.testing.assert_allclose(warm[..., :27], HOT, **close)
    np.testing.assert_allclose(warm[..., 27:], apparent[..., 27:], **close)
    np.testing.assert_allclose(share[..., :20], 1.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(share[..., 20:27], 0.5, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["background_temperature"], ROOM, **close)


def stationary() -> xr.Dataset:
    """Separation by the ratio of 10.6 and 8-14 um, which turns near 33 C: two temperatures fit."""
    names = ("8-14", "10.6")
    capture = capture_of([20000.0 + WARM, 20000.0 + WARM], names)
    return separation.solve(capture, Rig(bands=names).response(), methods.get_method("ratio"))


BEYOND = BcpSettings(reflected_temperature=500.0)
test_what_has_no_answer = refused(
    lambda call: call(),
    [
        (stationary, r"'8-14', '10.6' .* stationary near 30\d\.\d K"),
        (lambda: solve(half_black(), "bcp", BEYOND), r"Invalid reflected_temperature 500\.0 K"),
    ],
    error=ValueError,
)


def test_medians_count_what_the_default_solves() -> None:
    """Medians omit pixels that the default does not solve, and count others' failures as worst."""
    rmse = [[0.1, 0.3, np.nan, 0.2], [1.0, np.nan, 90.0, 2.0]]
    parts = {
        "object_temperature_rmse": (("variant", "pixel"), rmse, {"units": "K"}),
        "emissivity_error": (("variant", "band", "pixel"), np.full((2, 2, 4), 0.05)),
        "status": (("variant", "pixel"), [[0, 0, 1, 0], [0, 4, 0, 0]]),
    }
    comparison = xr.Dataset(parts, {"variant": ["subspace", "other"]})
    medians = experiments.comparison.medians(comparison)
    expected = {"object_temperature_rmse": [0.2, 2.0], "solved": [0.75] * 2}
    for name, values in (expected | {"wrong": [0.0, 0.0]}).items():
        np.testing.assert_allclose(medians[name], values, rtol=0, atol=1e-12)
    lost = experiments.comparison.medians(comparison.isel(pixel=[1, 2]))
    assert np.isnan(lost["object_temperature_rmse"].sel(variant="other"))


QUIET = (0.003, 0.03)
LONG = np.arange(350) / 10.0
Scene = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def noisy(noise: tuple[float, float], pixels: int) -> Scene:
    """Scene of pixels, its capture and its response."""
    return cases.simulate(HEATED, Rig(noise=noise), LONG, pixels, seed=41)


def errors(scene: xr.Dataset, result: xr.Dataset) -> tuple[float, float]:
    """Median error of the worse emissivity [1], and median RMSE of the object [K]."""
    of_emissivity = abs(result["emissivity"] - scene["emissivity"]).max("band")
    of_object = result["object_temperature"] - scene["object_temperature"]
    return float(of_emissivity.median()), float(((of_object**2).mean("time") ** 0.5).median())


@pytest.mark.parametrize(("noise", "pixels"), [(QUIET, 20), *slow(((0.03, 0.05), 50))])
def test_random_starts_find_the_emissivities(noise: tuple[float, float], pixels: int) -> None:
    """From random emissivities the median error at low noise is below 0.02, the object's 0.3 K."""
    scene, capture, response = noisy(noise, pixels)
    result = separation.solve(capture, response, DBVT, seed=3)
    of_emissivity, of_object = errors(scene, result)
    assert of_emissivity < 0.02
    assert of_object < 0.3
    assert float((result["status"] == 0).mean()) > 0.9


@pytest.mark.slow
def test_a_start_at_the_separator_is_as_good_as_random_ones() -> None:
    """Started at the subspace separator it ends no higher, and everywhere with a result."""
    scene, capture, response = noisy((0.03, 0.35), 40)
    random = separation.solve(capture, response, DBVT, seed=3)
    start = DbvtSettings(start="subspace")
    started = separation.solve(capture, response, DBVT, settings=start, seed=3)
    of_random, of_started = errors(scene, random), errors(scene, started)
    assert np.all(np.array(of_started) <= 1.1 * np.array(of_random))
    assert bool(started["emissivity"].notnull().all())


def test_exact_response_is_taken_out() -> None:
    """Taking out the bend of the exact response at least halves the emissivity's error."""
    scene, capture, response = noisy(QUIET, 15)
    bent, straight = (
        errors(scene, separation.solve(capture, response, DBVT, settings=settings))
        for settings in (DbvtSettings(bend_updates=0), None)
    )
    assert straight[0] < 0.5 * bent[0]
