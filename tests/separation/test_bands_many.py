"""Any number of bands: the error falls as the bound says, whatever their order."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import held

from dbthermal import schema, separation, simulation
from dbthermal.simulation import Background, Rig
from reproduction import experiments

TIME = np.arange(350) / 10.0
BANDS = ("8-14", "9.5", "10.6", "12.1")
NOISE = (0.03, 0.35, 0.15, 0.4)  # [K]
VALUES = (0.86, 0.72, 0.88, 0.95)
OBJECT = "object_temperature"
Case = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def case(number: int, pixels: int, seed: int) -> Case:
    """Scene, capture and response of the first so many bands."""
    rig = Rig(bands=BANDS[:number], noise=NOISE[:number])
    glass: dict[str, Any] = {"emissivity": list(VALUES[:number]), "start": 20, "stop": 60}
    return experiments.simulate(glass, rig, TIME, pixels, seed)


def pooled(error: xr.DataArray) -> float:
    """Root mean square."""
    return float(np.sqrt((error**2).mean()))


def test_error_bars_are_true() -> None:
    """Object and ratios scatter as stated in every band; clean pixels are not flagged."""
    scene, capture, response = case(4, 600, seed=2)
    result = separation.solve(capture, response)
    truth = (1 - scene["emissivity"]) / (1 - scene["emissivity"].sel(band="8-14"))
    others = {"band": slice(1, None)}
    errors = (result[OBJECT] - scene[OBJECT], (result["reflection_ratio"] - truth).isel(others))
    stds = (result[f"{OBJECT}_std"], result["reflection_ratio_std"].isel(others))
    scores = {name: e / s for name, e, s in zip(("object", "ratios"), errors, stds, strict=True)}
    for name, values in scores.items():
        spread = float(np.diff(np.nanquantile(values, [0.1587, 0.8413]))[0] / 2)
        print(f"{name}: spread of errors over their deviation {spread:.2f}")
        assert spread == pytest.approx(1.0, abs=0.15)
    assert held(result, scene, "emissivity") > 0.92
    assert float((result["status"] != 0).mean()) < 0.03
    assert float(abs(result["emissivity"] - scene["emissivity"]).median()) < 0.02


@settings(max_examples=10)
@given(order=st.permutations(range(4)))
def test_order_of_bands_does_not_matter(order: list[int]) -> None:
    """The quietest band leads, wherever it stands."""
    _, capture, response = case(4, 5, seed=3)
    names = list(BANDS)
    plain = separation.solve(capture, response)
    mixed = separation.solve(capture.isel(band=order), response).sel(band=names)
    assert mixed.attrs["reference_band"] == "8-14"
    quietest = mixed["band"] == "8-14"
    assert bool((mixed["reflection_ratio"].where(quietest, drop=True) == 1).all())
    assert bool(((mixed["reflection_ratio_std"] == 0) == quietest).all())
    for name in schema.STAGES["separated"]:
        value = mixed[name].values.astype(float)
        np.testing.assert_allclose(value, plain[name].values, rtol=1e-5, atol=1e-6)
    covariance = mixed["emissivity_covariance"].sel(other_band=names).values
    expected, variance = plain["emissivity_covariance"].values, plain["emissivity_std"].values ** 2
    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(np.einsum("bbyx->byx", covariance), variance, rtol=1e-4)


def test_three_bands_can_be_pooled() -> None:
    """A material's ratios are right within one per cent in every band."""
    _, capture, response = case(3, 400, seed=5)
    pool = xr.zeros_like(capture["counts"][0, 0], dtype=int)
    ratio = separation.solve(capture, response, pool=pool)["reflection_ratio"][:, 0, 0]
    expected = (1 - np.array(VALUES[:3])) / (1 - VALUES[0])
    print(f"ratios {ratio.values.round(4)}, true {expected.round(4)}")
    np.testing.assert_allclose(ratio, expected, rtol=0.02)


def test_differences_of_emissivities_are_as_certain_as_their_correlation_says() -> None:
    """Over many pixels of one truth the errors of two bands go together, nearly as stated."""
    rig, rng = Rig(bands=BANDS[:3], noise=NOISE[:3]), np.random.default_rng(3)
    warm, cold = 300.0 + 30.0 * (1.0 - np.exp(-TIME / 12.0)), 293.0 + 3.0 * ((TIME // 3.0) % 2)
    warm, cold = (np.broadcast_to(one[:, None, None], (350, 30, 50)) for one in (warm, cold))
    value = xr.DataArray([0.86, 0.72, 0.79], dims="band", coords={"band": list(rig.bands)})
    scene = simulation.scene(TIME, warm, cold, value)
    capture = simulation.observe(scene, rig.response(), rng)
    free = separation.SubspaceSettings(0.0)
    result = separation.solve(capture, rig.response(), settings=free)
    covariance = result["emissivity_covariance"].values.reshape(3, 3, -1)
    error = (result["emissivity"] - scene["emissivity"]).values.reshape(3, -1)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        stated = np.sqrt(covariance[a, a] + covariance[b, b] - 2.0 * covariance[a, b])
        scores = (error[a] - error[b]) / stated
        spread = float(np.diff(np.quantile(scores, [0.1587, 0.8413]))[0] / 2.0)
        print(f"bands {a} and {b}: errors over their deviation {spread:.2f}")
        assert 0.7 < spread < 1.05  # the level, which all bands share, is held to be less certain


def test_noise_of_many_bands_is_found() -> None:
    """Without a calibrated noise that of each band is estimated within 5 %."""
    _, capture, response = case(4, 200, seed=6)
    found = separation.solve(capture, response.drop_vars(["noise", "netd"]))["noise"]
    print(f"noise over the true one: {(found / response['noise']).values.round(3)}")
    np.testing.assert_allclose(found, response["noise"], rtol=0.05)


def test_a_gray_third_band_harms_nothing() -> None:
    """A third band with the emissivity of the first leaves the object's error as it is."""
    rig = Rig(bands=BANDS[:3], noise=(0.03, 0.35, 0.15))
    errors = []
    for bands in (2, 3):
        value = xr.DataArray([0.86, 0.72, 0.86], dims="band", coords={"band": list(BANDS[:3])})
        rng = np.random.default_rng(7)
        parts = (TIME, value, Background(), 200, rng)
        scene = simulation.independent_pixels(*parts, start=293.15, stop=333.15)
        capture = simulation.observe(scene, rig.response(), rng).isel(band=slice(0, bands))
        result = separation.solve(capture, rig.response())
        errors.append(pooled(result["object_temperature"] - scene["object_temperature"]))
    print(f"two bands {errors[0]:.3f} K, with a gray third {errors[1]:.3f} K")
    assert errors[1] < 1.05 * errors[0]
