"""Calibration: a response from blackbodies against Planck's law, an emissivity against truth."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import GLASS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refused import refused

from dbthermal import bands, calibration, response, schema
from reproduction.experiments.bench import contact_measurements

Floats = NDArray[np.float64]
Change = Callable[[xr.DataArray], xr.DataArray]
LOWEST, HIGHEST = 283.15, 343.15  # 10 to 70 degrees Celsius [K]
UNIT = 115.0 / float(bands.FILTERS["8-14"].slope(300.0))  # count per W m-2 sr-1
OFFSET = 15500.0  # count
STDS = (0.1, 0.05)  # of a thermocouple's and of a blackbody's reading [K]


def planck_counts(name: str, temperature: Floats) -> Floats:
    """Counts of an ideal camera: proportional to the band's radiance, and an offset."""
    return OFFSET + UNIT * bands.FILTERS[name].radiance(temperature)


def blackbody(number: int = 13, names: tuple[str, ...] = ("8-14", "9.5")) -> xr.DataArray:
    """Exact counts (band, temperature) at a number of temperatures."""
    temperature = np.linspace(LOWEST, HIGHEST, number)
    counts = [planck_counts(name, temperature) for name in names]
    coords = {"band": list(names), "temperature": temperature}
    return xr.DataArray(counts, coords, attrs={"units": "count"})


def noise_of(*values: float, **attrs: str) -> xr.DataArray:
    """Noise of the first of the two bands [count]."""
    return xr.DataArray([*values], {"band": ["8-14", "9.5"][: len(values)]}, "band", attrs=attrs)


@pytest.fixture(scope="module")
def two_bands() -> xr.Dataset:
    """Response of two bands with 3 and 4 counts of noise."""
    return calibration.fit_response(blackbody(), noise_of(3.0, 4.0))


@pytest.mark.parametrize("name", bands.FILTERS)
@pytest.mark.parametrize("number", [4, 13])
def test_planck_is_met(name: str, number: int) -> None:
    """From four temperatures the inverse is exact within 0.05 mK over 10-70 C in every filter."""
    fitted = calibration.fit_response(blackbody(number, (name,)))
    temperature = np.linspace(LOWEST, HIGHEST, 241)
    found = response.curve(fitted, name).inverse(planck_counts(name, temperature))
    np.testing.assert_allclose(found, temperature, rtol=0, atol=5e-5)  # K


def test_response_is_a_stage(two_bands: xr.Dataset) -> None:
    """A response over what was measured, referred to 298.15 K, where NETD is noise over slope."""
    assert schema.check(two_bands, "response") is two_bands
    assert float(two_bands["temperature_min"]) == LOWEST
    assert float(two_bands["temperature_max"]) == HIGHEST
    assert float(two_bands["reference_temperature"]) == 298.15
    assert all("units" in variable.attrs for variable in two_bands.data_vars.values())
    for name, noise in (("8-14", 3.0), ("9.5", 4.0)):
        slope = UNIT * float(bands.FILTERS[name].slope(298.15))
        assert float(two_bands["netd"].sel(band=name)) == pytest.approx(noise / slope, rel=1e-5)
        assert float(two_bands["noise"].sel(band=name)) == noise


def test_residuals(two_bands: xr.Dataset) -> None:
    """A residual is measured less fitted counts; least squares leave no sum and no slope."""
    temperature = two_bands["temperature"].values
    for kind, name in (("exact", "residual"), ("linear", "linear_residual")):
        found = two_bands[name].sel(band="9.5")
        fitted = response.curve(two_bands, "9.5", kind).counts(temperature)
        np.testing.assert_allclose(found, planck_counts("9.5", temperature) - fitted, atol=1e-9)
        assert float(found.sum()) == pytest.approx(0.0, abs=1e-8)
        moment = float(found.values @ (temperature - 300.0))
        assert kind == "exact" or moment == pytest.approx(0.0, abs=1e-5)
    assert float(abs(two_bands["linear_residual"]).max()) > 10.0  # the line does not fit


def test_noise_goes_by_the_band_s_name(two_bands: xr.Dataset) -> None:
    """Noise is assigned to the bands by name, in any order and beside other bands."""
    noise = xr.DataArray([9.0, 4.0, 3.0], dims="band", coords={"band": ["10.6", "9.5", "8-14"]})
    fitted = calibration.fit_response(blackbody(), noise)
    np.testing.assert_array_equal(fitted["noise"], two_bands["noise"])
    assert "noise" not in calibration.fit_response(blackbody())


@settings(max_examples=25)
@given(gain=st.floats(0.05, 50.0), shift=st.floats(-2e4, 2e4))
def test_gain_and_offset_of_the_camera(gain: float, shift: float) -> None:
    """Scaled and shifted counts change amplitude and offset alike, and no temperature."""
    counts = blackbody(5, ("9.5",))
    before = calibration.fit_response(counts).isel(band=0)
    after = calibration.fit_response(gain * counts + shift)
    read = response.curve(after, "9.5").inverse(gain * counts[0] + shift)
    np.testing.assert_allclose(read, counts["temperature"], rtol=0, atol=1e-6)  # K
    for name, times in (("amplitude", gain), ("effective_wavelength", 1.0)):
        assert float(after[name][0]) == pytest.approx(times * float(before[name]), rel=1e-4)


def test_noisy_counts() -> None:
    """Four parameters from 13 counts of error s: the curve is off by s sqrt(4/13), residuals 9."""
    rng, error = np.random.default_rng(1), 0.3
    exact = blackbody(13, ("9.5",)).isel(band=0, drop=True)
    repeats = {"band": [f"repeat {index}" for index in range(60)]}
    noise = xr.DataArray(rng.standard_normal((60, 13)), repeats, ("band", "temperature"))
    noisy = (exact + error * noise).transpose("band", "temperature")
    fitted = calibration.fit_response(noisy)
    off = (noisy - fitted["residual"] - exact) / error
    assert float((off**2).mean() ** 0.5) == pytest.approx((4 / 13) ** 0.5, rel=0.15)
    assert float(abs(off).max()) < 3.5
    chi2 = (fitted["residual"] ** 2).sum("temperature") / error**2
    assert float(chi2.mean()) == pytest.approx(9.0, rel=0.15)


test_bad_counts = refused(
    lambda change: calibration.fit_response(change(blackbody())),
    [
        (lambda it: it.T, "Invalid dims ('temperature', 'band') of the blackbody counts"),
        (lambda it: it.assign_attrs(units="K"), "Invalid units 'K' of the blackbody"),
        (lambda it: it.where(it["temperature"] < 340), "in band '8-14': NaN or inf"),
        (lambda it: it.where(it["temperature"] < 340, 1.6e4), "Must grow with temp"),
        (lambda it: 0 * it, "Invalid counts 0.0 at 288.15 K in band '8-14', after 0.0"),
        (lambda it: it[:, :3], "Invalid number of blackbody temperatures 3"),
        (lambda it: it[:, ::-1], "Unordered 'temperature'"),
        (lambda it: it.isel(band=[0, 0]), "Repeated band"),
        (lambda it: it.drop_vars("temperature"), "Missing coordinate 'temperature'"),
        (lambda it: at(it, 10, 70), r"temperature \[K\] of a blackbody 10.0.*in kelvin, not"),
        (lambda it: it.values, "Invalid blackbody counts of type ndarray"),
    ],
)


def at(counts: xr.DataArray, first: float, last: float) -> xr.DataArray:
    """The counts at other temperatures."""
    return counts.assign_coords(temperature=np.linspace(first, last, counts.sizes["temperature"]))


test_bad_noise_and_accuracy = refused(
    lambda stated: calibration.fit_response(blackbody(), **stated),
    [
        ({"noise": noise_of(3.0)}, "Missing band '9.5' in the noise, of ['8-14']"),
        ({"noise": noise_of(3, 4).drop_vars("band")}, "Missing coordinate 'band' of the noise"),
        ({"noise": noise_of(3, 4).rename(band="filter")}, "Invalid dims ('filter',) of the noise"),
        ({"noise": noise_of(0.03, 0.35, units="K")}, "Invalid units 'K' of the noise"),
        ({"noise": noise_of(3.0, -4.0)}, "Must be finite and positive"),
        ({"noise": np.ones(2)}, "Invalid noise of type ndarray"),
        ({"offset_std": -0.1}, "Invalid offset_std of the response -0.1. Must lie in"),
        ({"gain_std": (0.01, np.nan)}, "Invalid gain_std of the response nan"),
        ({"pattern_std": (0.1, 0.1, 0.1)}, "Invalid pattern_std of shape (3,)"),
        ({"blackbody_emissivity": 1.1}, "Invalid blackbody_emissivity of the response 1.1"),
        ({"blackbody_accuracy": -1.0}, "Invalid blackbody_accuracy of the response -1.0"),
    ],
)


WARM = np.linspace(303.15, 333.15, 8)
COLD = np.linspace(323.15, 293.15, 8)


def readings(of: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """Eight measurements of glass."""
    return contact_measurements(of, GLASS, WARM, COLD, STDS, rng)


@pytest.fixture
def measured(two_bands: xr.Dataset) -> xr.Dataset:
    """Readings with errors."""
    return readings(two_bands, np.random.default_rng(2))


def test_emissivity_is_the_weighted_slope(two_bands: xr.Dataset, measured: xr.Dataset) -> None:
    """The result solves York's normal equation, with the weights of the docstring."""
    fitted = calibration.fit_emissivity(measured, two_bands, STDS).sel(band="9.5")
    curve = response.curve(two_bands, "9.5")
    warm, cold = measured["object_temperature"], measured["background_temperature"]
    across = curve.counts(warm) - curve.counts(cold)
    slope = float(fitted["emissivity"])
    residual = measured["counts"].sel(band="9.5").values - curve.counts(cold) - slope * across
    own, other = (curve.count_slope(warm) * STDS[0]) ** 2, (curve.count_slope(cold) * STDS[1]) ** 2
    variance = 4.0**2 + slope**2 * own + (1 - slope) ** 2 * other
    adjusted = across + (slope * own - (1 - slope) * other) * residual / variance
    std, chi2 = np.sum(adjusted**2 / variance) ** -0.5, np.sum(residual**2 / variance) / 7
    np.testing.assert_allclose(fitted["residual"], residual, rtol=0, atol=1e-9)
    assert float(np.sum(adjusted * residual / variance)) == pytest.approx(0.0, abs=1e-6)
    assert float(fitted["emissivity_std"]) == pytest.approx(float(std), rel=1e-9)
    assert float(fitted["reduced_chi2"]) == pytest.approx(float(chi2), rel=1e-9)


def test_emissivity_s_error_bar_is_true(two_bands: xr.Dataset) -> None:
    """Over 250 repeats the normalised error has variance 1 and no bias; reduced chi-square is 1."""
    rng = np.random.default_rng(0)
    movies = (readings(two_bands, rng) for _ in range(250))
    fits = [calibration.fit_emissivity(movie, two_bands, STDS) for movie in movies]
    together = xr.concat(fits, dim="repeat")
    score = (together["emissivity"] - GLASS) / together["emissivity_std"]
    variance, bias = score.var("repeat"), score.mean("repeat")
    chi2 = together["reduced_chi2"].mean("repeat")
    np.testing.assert_allclose(variance, 1.0, rtol=0, atol=0.15)
    np.testing.assert_allclose(bias, 0.0, rtol=0, atol=0.2)  # 3 standard errors
    np.testing.assert_allclose(chi2, 1.0, rtol=0, atol=0.1)


def warmer(name: str, by: float = 0.0, units: str = "K") -> Callable[[xr.Dataset], xr.Dataset]:
    """Change of a temperature by some kelvins, or of its units."""
    return lambda it: it.assign({name: (it[name] + by).assign_attrs(units=units)})


CASES: list[tuple[Callable[[xr.Dataset], Any], str]] = [
    (lambda it: it.transpose(), "Invalid dims ('measurement', 'band')"),
    (lambda it: it.drop_vars("counts"), "Missing variable 'counts' in the contact"),
    (lambda it: it.isel(measurement=[0]), "Invalid number of measurements 1"),
    (lambda it: it.assign(counts=it["counts"] * np.nan), "Invalid counts: NaN or infinite"),
    (warmer("object_temperature", units="C"), "Invalid units 'C' of 'object_temperature'"),
    (warmer("object_temperature", 50), "K in band '8-14'. Must lie in the response's range"),
    (warmer("background_temperature", -50), "Invalid background temperature 2"),
    (
        lambda it: it.assign(background_temperature=it["object_temperature"] + 0.3),
        "three standard deviations of the difference",
    ),
    (lambda it: it.assign_coords(band=["8-14", "10.6"]), "Missing band '10.6' in the resp"),
    # Bands with exchanged names give no emissivity, but an error that says what may be wrong.
    (lambda it: it.assign_coords(band=["9.5", "8-14"]), "names or files exchanged"),
]
DEVIATIONS: list[Any] = [(0.0, 0.05), (0.1, -0.05), (np.nan, 0.05), 0.1]


test_bad_measurements = refused(
    lambda two_bands, measured, change, stds, *lost: calibration.fit_emissivity(
        change(measured), two_bands.drop_vars(lost), stds
    ),
    [(change, STDS, message) for change, message in CASES]
    + [(xr.Dataset.copy, stds, "Invalid reading_std [K]") for stds in DEVIATIONS]
    + [(xr.Dataset.copy, STDS, "noise", "Missing noise of the response")],
    "two_bands measured",
)


def test_one_drift_of_a_list_is_of_all_bands() -> None:
    """As an option of a command has it, which may be stated for each band."""
    listed = calibration.fit_response(blackbody(), offset_std=[0.3])
    xr.testing.assert_identical(listed, calibration.fit_response(blackbody(), offset_std=0.3))


def test_accuracy_is_never_zero_unless_stated() -> None:
    """A sweep states what is usual, and more drift where its counts are off the curve."""
    usual = calibration.fit_response(blackbody())
    assert {name: usual[name].values.max() for name in response.ACCURACY} == pytest.approx(
        dict(response.ACCURACY), rel=1e-6
    )
    off = 0.8 * UNIT * np.array([[1.0], [0.1]]) * np.tile([1.0, -1.0], 7)[:13]
    uneven = calibration.fit_response(blackbody() + off, temperature_std=2.0)
    assert (uneven["offset_std"] > 1.001 * usual["offset_std"]).all()
    exact = calibration.fit_response(blackbody(), None, **response.EXACT)
    assert response.accuracy(exact, ["9.5", "8-14"]).reading(1, 330.0) == 0.0
    older = exact.drop_vars([*response.ACCURACY])
    assert response.accuracy(older, ["9.5"]).reading(0, 310.65) > 0.5
