"""Separation with known emissivities: exact without noise, and at its closed-form variance."""

import functools

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal import mixing, schema, separation
from dbthermal import response as responses
from dbthermal.separation._baselines.calibrated import temperature_variance
from dbthermal.simulation import Rig

RIG = Rig()


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


@settings(max_examples=25, deadline=None)
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
    capture = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), movie)},
        coords={"band": list(RIG.bands), "time": [0.0, 0.1]},
    )
    result = separation.solve(
        capture, response, "calibrated", emissivity=emissivity_of(first, second)
    )
    for name, value in (("object_temperature", warm), ("background_temperature", cold)):
        np.testing.assert_allclose(result[name].values[0], value, rtol=0, atol=2e-3)  # [K]


def test_calibrated_noise_is_the_bound(glass: Glass) -> None:
    """Known emissivities: errors are those of the closed form, 0.35 K and 2.1 K for glass."""
    scene, capture, response = glass
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(capture, response, "calibrated", emissivity=known)
    for name in ("object_temperature", "background_temperature"):
        scores = (result[name] - scene[name]) / result[f"{name}_std"]
        assert float(scores.std()) == pytest.approx(1.0, abs=0.05)
    assert not result["status"].any()


@pytest.mark.parametrize("step", [64.0, 1e-3])
def test_rounding_is_in_the_deviations(glass: Glass, step: float) -> None:
    """Counts in steps far wider than the noise err by step / sqrt(12) more, and say so."""
    scene, capture, response = glass
    whole = step * (capture["counts"] / step).round()
    coarse = capture.assign(counts=whole.where(whole["band"] == "9.5", capture["counts"]))
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(coarse, response, "calibrated", emissivity=known)
    scores = (result["object_temperature"] - scene["object_temperature"]) / result[
        "object_temperature_std"
    ]
    print(f"steps of {step} counts: scores of standard deviation {float(scores.std()):.3f}")
    assert float(scores.std()) == pytest.approx(1.0, abs=0.05)


def test_unlabelled_emissivity_goes_by_position(glass: Glass) -> None:
    """An emissivity without band names is taken in the capture's order, as xarray aligns it."""
    _, capture, response = glass
    named = emissivity_of(0.86, 0.72)
    results = [
        separation.solve(capture.isel(time=[7]), response, "calibrated", emissivity=emissivity)
        for emissivity in (named, named.drop_vars("band"))
    ]
    xr.testing.assert_identical(*results)


def test_one_frame_can_be_calibrated(glass: Glass) -> None:
    """A single frame is enough with known emissivities, and is no constant signal."""
    scene, capture, response = glass
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(capture.isel(time=[7]), response, "calibrated", emissivity=known)
    assert not np.any(result["status"])
    error = result["object_temperature"] - scene["object_temperature"].isel(time=[7])
    assert float(abs(error).max()) < 5 * 0.4  # five standard deviations [K]


def test_nonsense_in_one_pixel_stays_there(glass: Glass) -> None:
    """Counts that no two temperatures give are flagged, and other pixels are not affected."""
    _, capture, response = glass
    wild = capture.copy(deep=True)
    wild["counts"].values[1, :, 0, 0] = wild["counts"].values[0, :, 0, 0]
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(wild, response, "calibrated", emissivity=known)
    assert result["status"].values[0, 0] & schema.Status.OUTSIDE_RESPONSE
    assert not np.any(result["status"].values[1:])


def test_emissivities_whose_errors_go_together(glass: Glass) -> None:
    """With the ratio known far better than the emissivities, their covariance makes it solvable.

    By two deviations alone each pixel would be gray; the intervals hold with the covariance, which
    is laid on the bands by their names.
    """
    scene, capture, response = glass
    rng, shape = np.random.default_rng(5), scene["emissivity"].shape[1:]
    shared, own = 0.02 * rng.standard_normal(shape), 0.004 * rng.standard_normal(shape)
    known = scene["emissivity"] + xr.DataArray(
        [shared, 2.0 * shared + own], dims=("band", "y", "x")
    )
    together = 0.02**2 * np.array([[1.0, 2.0], [2.0, 4.0]]) + np.diag([0.0, 0.004**2])
    names = list(RIG.bands)
    covariance = xr.DataArray(
        together[::-1, ::-1],
        {"band": names[::-1], "other_band": names[::-1]},
        ("band", "other_band"),
    )
    solve = functools.partial(separation.solve, capture, response, "calibrated", emissivity=known)
    result = solve(emissivity_covariance=covariance)
    apart = solve(
        emissivity_std=xr.DataArray(np.sqrt(np.diag(together)), {"band": names}, ("band",))
    )
    assert float(schema.has_flag(apart["status"], "gray").mean()) > 0.9
    assert not np.any(schema.has_flag(result["status"], "gray"))
    error = abs(result["object_temperature"] - scene["object_temperature"])
    share = float((error < 1.96 * result["object_temperature_std"]).where(error.notnull()).mean())
    print(f"object: 95 % intervals hold in {share:.3f}")
    assert 0.92 < share < 0.98
    with pytest.raises(ValueError, match="no negative eigenvalue"):
        solve(emissivity_covariance=covariance - 0.1)
    with pytest.raises(ValueError, match="beside an emissivity_covariance"):
        solve(emissivity_covariance=covariance, emissivity_std=abs(known))


def test_linear_variances_are_the_closed_form() -> None:
    """The design's figures for glass with noise (0.04, 0.4) K: 0.40 K and 2.4 K a frame."""
    mixed = mixing.matrix([0.86, 0.72])
    none = np.zeros((2, 2))
    variance = temperature_variance(mixed, (0.04, 0.4), np.array([300.0, 300.0]), none)
    np.testing.assert_allclose(np.sqrt(variance), [0.40, 2.4], rtol=0, atol=0.07)  # [K]
