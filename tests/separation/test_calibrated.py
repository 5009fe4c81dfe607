"""Separation with known emissivities: exact without noise, and at its closed-form variance."""

import functools

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, emissivity_of, people, plain_capture
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import assert_refused
from scenes import held

from dbthermal import mixing, schema, separation, simulation
from dbthermal import response as responses
from dbthermal.simulation import Rig

FRAMES = separation.CalibratedSettings(smooth=False)


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


@settings(max_examples=25)
@given(
    first=st.floats(0.05, 0.95),
    second=st.floats(0.05, 0.95),
    warm=st.floats(275.0, 345.0),
    cold=st.floats(275.0, 345.0),
)
def test_calibrated_inverts_the_image_formation(
    first: float, second: float, warm: float, cold: float
) -> None:
    """Without noise the calibrated method returns the temperatures that went in."""
    if abs(first - second) < 0.05:
        return
    response = RIG.response()
    curves = [responses.curve(response, name) for name in RIG.bands]
    counts = [
        mixing.leaving(e, curve.counts(warm), curve.counts(cold))
        for e, curve in zip((first, second), curves, strict=True)
    ]
    # Two frames, one an hair warmer: a signal that never changes is flagged, not solved.
    movie = np.array(counts)[:, None, None, None] * np.array([1.0, 1.0 + 1e-9])[None, :, None, None]
    known = emissivity_of(first, second)
    result = separation.solve(plain_capture(movie), response, "calibrated", emissivity=known)
    for name, value in (("object_temperature", warm), ("background_temperature", cold)):
        np.testing.assert_allclose(result[name].values[0], value, rtol=0, atol=2e-3)  # [K]


@pytest.mark.parametrize("step", [64.0, 1e-3])
def test_noise_and_rounding_are_in_the_deviations(glass: Glass, step: float) -> None:
    """Errors are those of the closed form, of no flag; counts in steps far wider than the noise err
    by step / sqrt(12) more, and say so.
    """
    scene, capture, response = glass
    whole = step * (capture["counts"] / step).round()
    coarse = capture.assign(counts=whole.where(whole["band"] == "9.5", capture["counts"]))
    result = separation.solve(coarse, response, "calibrated", emissivity=GLASS, settings=FRAMES)
    for name in ("object_temperature", "background_temperature"):
        scores = (result[name] - scene[name]) / result[f"{name}_std"]
        assert float(scores.std()) == pytest.approx(1.0, abs=0.05)
    assert not result["status"].any()


def test_one_frame_can_be_calibrated(glass: Glass) -> None:
    """A single frame is enough with known emissivities, and is no constant signal."""
    scene, capture, response = glass
    result = separation.solve(capture.isel(time=[7]), response, "calibrated", emissivity=GLASS)
    assert not np.any(result["status"])
    error = result["object_temperature"] - scene["object_temperature"].isel(time=[7])
    assert float(abs(error).max()) < 5 * 0.4  # five standard deviations [K]


def test_emissivities_whose_errors_go_together(glass: Glass) -> None:
    """A covariance, laid on the bands by their names, makes solvable what two deviations do not."""
    scene, capture, response = glass
    rng, shape = np.random.default_rng(5), scene["emissivity"].shape[1:]
    shared, own = 0.02 * rng.standard_normal(shape), 0.004 * rng.standard_normal(shape)
    off = xr.DataArray([shared, 2.0 * shared + own], dims=("band", "y", "x"))
    known = scene["emissivity"] + off
    together = 0.02**2 * np.array([[1.0, 2.0], [2.0, 4.0]]) + np.diag([0.0, 0.004**2])
    names = list(RIG.bands)
    turned = {"band": names[::-1], "other_band": names[::-1]}
    covariance = xr.DataArray(together[::-1, ::-1], turned, ("band", "other_band"))
    solve = functools.partial(separation.solve, capture, response, "calibrated", emissivity=known)
    result = solve(emissivity_covariance=covariance)
    stds = xr.DataArray(np.sqrt(np.diag(together)), {"band": names}, ("band",))
    apart = solve(emissivity_std=stds)
    assert float(schema.has_flag(apart["status"], "gray").mean()) > 0.9
    assert not np.any(schema.has_flag(result["status"], "gray"))
    assert 0.92 < held(result, scene) < 0.98
    assert_refused("no negative eigenvalue", solve, emissivity_covariance=covariance - 0.1)
    with pytest.raises(ValueError, match="Must be symmetric"):
        solve(emissivity_covariance=covariance + xr.zeros_like(covariance) + np.eye(2)[0] * 1e-3)
    assert_refused(r"Invalid emissivity_std.*, and finite", solve, emissivity_std=np.inf * known)
    with pytest.raises(ValueError, match="beside an emissivity_covariance"):
        solve(emissivity_covariance=covariance, emissivity_std=abs(known))


def test_bars_are_the_closed_form(glass: Glass) -> None:
    """Equation 2 for glass before a background near it: 0.35 K and 2.1 K a frame."""
    _, capture, response = glass
    result = separation.solve(capture, response, "calibrated", emissivity=GLASS, settings=FRAMES)
    s = [RIG.noise[0], RIG.noise[1]]
    for name, share in (("object_temperature", 1.0), ("background_temperature", 0.0)):
        weights = [abs(share - e) for e in (0.72, 0.86)]
        expected = np.hypot(weights[0] * s[0], weights[1] * s[1]) / (0.86 - 0.72)
        # At first both are as warm as the reference, where the responses' slopes are 1.
        first = float(result[f"{name}_std"].isel(time=0).median())
        assert first == pytest.approx(expected, rel=0.05)


def test_smoothed_as_far_as_the_curve_allows(glass: Glass) -> None:
    """The object's error falls fourfold at least, its intervals hold; the background stays."""
    scene, capture, response = glass
    smooth, frames = (
        separation.solve(capture, response, "calibrated", emissivity=GLASS, settings=settings)
        for settings in (None, FRAMES)
    )
    name = "object_temperature"
    errors = [part[name] - scene[name] for part in (smooth, frames)]
    rmse = [float(np.sqrt((error**2).mean())) for error in errors]
    assert rmse[0] < 0.25 * rmse[1]
    assert 0.92 <= held(smooth, scene) <= 0.98
    xr.testing.assert_equal(smooth["background_temperature"], frames["background_temperature"])


@pytest.mark.parametrize("rise", [0.3, 2.0, 8.0])
def test_a_rapid_object_is_not_smoothed_away(rise: float) -> None:
    """Rises of 0.3 to 8 s come out within their intervals, also while they last."""
    time, rng = np.arange(300) / 10.0, np.random.default_rng(4)
    step = 0.5 * (1.0 + np.tanh(2.0 * np.log(3.0) / rise * (time - 15.0)))
    warm = np.broadcast_to(295.0 + 30.0 * step[:, None, None], (300, 8, 10))
    cold = 295.0 + 3.0 * rng.standard_normal((300, 8, 10))
    scene = simulation.scene(time, warm, cold, GLASS)
    capture = simulation.observe(scene, RIG.response(), rng)
    result = separation.solve(capture, RIG.response(), "calibrated", emissivity=GLASS)
    score = abs(result["object_temperature"] - warm) / result["object_temperature_std"]
    steep = abs(time - 15.0) < rise
    within = [float((score.isel(time=part) < 1.96).mean()) for part in (slice(None), steep)]
    assert 0.9 <= within[0] <= 0.99
    assert within[1] >= 0.75


def test_a_third_band_lessens_the_noise() -> None:
    """Three bands give what two give, with less noise, and true deviations."""
    rig = Rig(bands=("8-14", "9.5", "10.6"), noise=(0.03, 0.35, 0.15))
    known, response = emissivity_of(0.86, 0.72, 0.93, bands=rig.bands), rig.response()
    scene, capture = people(6, 100, (8, 10), known, rig)
    results = [
        separation.solve(
            part, response, "calibrated", emissivity=known.sel(band=part["band"]), settings=FRAMES
        )
        for part in (capture, capture.isel(band=[0, 1]))
    ]
    stds = [float(part["object_temperature_std"].mean()) for part in results]
    score = results[0]["object_temperature"] - scene["object_temperature"]
    score = score / results[0]["object_temperature_std"]
    assert stds[0] < 0.95 * stds[1]
    assert float(score.std()) == pytest.approx(1.0, abs=0.05)
