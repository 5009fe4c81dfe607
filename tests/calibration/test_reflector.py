"""Emissivity by the reflector method and on the bench: without errors, and its uncertainty."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of
from refused import refused

from dbthermal import calibration, response
from dbthermal.calibration import Bias
from dbthermal.simulation import Rig
from reproduction.experiments import bench

STDS = (0.2, 0.3)  # of a contact reading and of the foil [K]
TRUE = np.array([0.3, 0.45])
NO_ERRORS = bench.Bench(
    contact=(0.0, 0.0),
    foil_emissivity=0.0,
    mirrored_excess=(0.0, 0.0),
    reading_std=1e-9,
    blackbody_std=1e-9,
    foil_std=1e-9,
    probe_tolerance=0.0,
    logger_tolerance=0.0,
    blackbody_tolerance=0.0,
)


@pytest.fixture(scope="module")
def known() -> xr.Dataset:
    """Response of the simulated rig."""
    return Rig().response()


def measured(of: xr.Dataset, warm: float, foil: float) -> xr.Dataset:
    """Measurement without errors of a material in front of one reflected temperature [K]."""
    own, reflected = response.counts(of, xr.DataArray([warm, foil], dims="level")).values.T
    films = {"counts": TRUE * own + (1 - TRUE) * reflected, "reflected_counts": reflected}
    labelled = {name: (("band", "measurement"), one[:, None]) for name, one in films.items()}
    read = {"object_temperature": ("measurement", [warm])}
    return xr.Dataset(labelled | read, {"band": of["band"].values})


def test_deviation_is_the_standards_formula(known: xr.Dataset) -> None:
    """An exact measurement: exact, by sqrt(W^2 + e^2 Wo^2 + (1-e)^2 Wr^2) / |Wo - Wr|."""
    found = calibration.reflector_emissivity(measured(known, 325.0, 295.0), known, STDS)
    np.testing.assert_allclose(found["emissivity"], TRUE, rtol=0, atol=1e-12)
    assert np.all(np.isnan(found["reduced_chi2"]))
    curve = response.curve(known, "9.5")
    noise, share = float(known["noise"].sel(band="9.5")), TRUE[1]
    of_object = float(curve.count_slope(325.0)) * STDS[0]
    of_foil = np.hypot(noise, float(curve.count_slope(295.0)) * STDS[1])
    parts = [noise, share * of_object, (1 - share) * of_foil]
    expected = np.linalg.norm(parts) / float(curve.counts(325.0) - curve.counts(295.0))
    assert float(found["emissivity_std"].sel(band="9.5")) == pytest.approx(expected, rel=1e-6)


test_bad_measurements = refused(
    lambda known, change: calibration.reflector_emissivity(
        change(measured(known, 325.0, 295.0)), known, STDS
    ),
    [
        (lambda it: it.drop_vars("reflected_counts"), "Missing variable 'reflected_counts'"),
        (lambda it: it.transpose(), "Invalid dims ('measurement', 'band')"),
        (lambda it: it.assign(counts=it["counts"] * np.nan), "Invalid counts: NaN or infinite"),
        (lambda it: warmer(it, 60), "Invalid object temperature 385.0 K in band '8-14'"),
        (lambda it: warmer(it, -29.5), "and reflection in band '8-14'. Must exceed 1.08"),
        (lambda it: it.assign_coords(band=["8-14", "10.6"]), "Missing band '10.6'"),
    ],
    "known",
)


def warmer(it: xr.Dataset, by: float) -> xr.Dataset:
    """Measurements with other readings of the object."""
    return it.assign(object_temperature=it["object_temperature"] + by)


@pytest.mark.parametrize("sample", bench.OBJECTS, ids=lambda sample: sample.name)
def test_both_procedures_are_exact_without_errors(known: xr.Dataset, sample: bench.Sample) -> None:
    """With errors of zero, noise of a billionth and a perfect mirror both give the truth."""
    quiet, rng = known.assign(noise=1e-9 * known["noise"]), np.random.default_rng(0)
    mirror = replace(sample, stray=0.0)
    true = bench.band_emissivity(mirror, ("8-14", "9.5"))
    series = bench.bench_series(quiet, mirror, NO_ERRORS, rng)
    foil = bench.reflector_series(quiet, mirror, NO_ERRORS, rng)
    by_contact = calibration.fit_emissivity(series, quiet, STDS)
    by_foil = calibration.reflector_emissivity(foil, quiet, STDS)
    for found in (by_contact, by_foil):
        np.testing.assert_allclose(found["emissivity"], true, rtol=0, atol=1e-8)


@pytest.fixture(scope="module")
def table(known: xr.Dataset) -> xr.Dataset:
    """Forty series of each object by every procedure."""
    return bench.compare_procedures(known, np.random.default_rng(1), repeats=40)


def test_bench_s_error_bars_are_true(table: xr.Dataset) -> None:
    """Coverage is 68 % when the common errors are stated, and far less when they are not."""
    coverage = table["coverage"].mean(("object", "band"))
    assert float(coverage.sel(procedure="bench")) == pytest.approx(0.68, abs=0.06)
    assert float(coverage.sel(procedure="bench, plain fit")) < 0.4


def test_reflector_method_fails_at_low_emissivity(table: xr.Dataset) -> None:
    """Mirrors seem to emit twice as much or more; paint and glass are right within 0.03."""
    mean = table["mean"].sel(procedure="reflector", band="8-14")
    assert np.all(mean.values[:2] > 1.8 * np.array([0.10, 0.05]))
    np.testing.assert_allclose(mean.values[2:], [0.87, 0.95, 0.95], rtol=0, atol=0.03)


def test_its_failure_is_the_mirrored_direction(known: xr.Dataset) -> None:
    """In a uniform room its error is below 0.015; it grows with the mirrored direction's excess."""
    found = bench.reflector_sensitivity(known, np.random.default_rng(1), (0.0, 11.0), repeats=60)
    assert found["mean"].dims == ("object", "excess", "band")
    even = found["mean"].sel(excess=0.0)
    np.testing.assert_allclose(even, found["true"], rtol=0, atol=0.015)
    mirrors = found["mean"].isel(object=[0, 1])
    assert float(mirrors.diff("excess").min()) > 0.03


def test_other_bands_follow_the_kin() -> None:
    """Metals by the ratio of emissivities, dielectrics by that of reflectances, all in (0, 1)."""
    for sample in bench.OBJECTS:
        value = bench.band_emissivity(sample, ("8-14", "9.5"))
        assert float(value[0]) == pytest.approx(sample.emissivity, abs=1e-12)
        assert 0 < float(value[1]) < 1
    glass = bench.band_emissivity(bench.OBJECTS[-1], ("9.5",))
    assert float(glass[0]) == pytest.approx(1 - 0.05 * (1 - 0.7180) / (1 - 0.8605), abs=1e-9)


def test_common_errors_do_not_average_out(known: xr.Dataset) -> None:
    """Sixteen times the measurements: a deviation of noise falls by 4, one of a bias stays."""

    def stated(number: int, bias: Bias) -> float:
        stds, warm = (0.1, 0.05), np.full(number, 330.0)
        rng, true = np.random.default_rng(0), emissivity_of(0.9, 0.8)
        series = bench.contact_measurements(known, true, warm, warm - 35.0, stds, rng)
        return float(calibration.fit_emissivity(series, known, stds, bias)["emissivity_std"][0])

    alone, common = Bias(), Bias(object_tolerance=2.0)
    assert stated(4, alone) / stated(64, alone) == pytest.approx(4.0, rel=0.01)
    assert stated(4, common) / stated(64, common) == pytest.approx(1.0, rel=0.03)


def test_scatter_does_not_pass_for_contrast(known: xr.Dataset) -> None:
    """Readings that scatter by 0.5 K at a contrast of 2 K give no bias; the scatter is stated."""
    rng, true = np.random.default_rng(3), emissivity_of(0.9, 0.8)
    warm, stds = np.full(200, 300.0), (0.5, 0.05)
    series = (
        bench.contact_measurements(known, true, warm, warm - 2.0, stds, rng) for _ in range(60)
    )
    found = xr.concat([calibration.fit_emissivity(it, known, stds) for it in series], "repeat")
    spread, stated = found["emissivity"].std("repeat"), found["emissivity_std"].mean("repeat")
    np.testing.assert_allclose(found["emissivity"].mean("repeat"), true, rtol=0, atol=0.01)
    np.testing.assert_allclose(spread / stated, 1.0, rtol=0, atol=0.25)


def test_deviations_grow_with_the_correction(known: xr.Dataset) -> None:
    """An offset counts 1 / (1 - m) times at the thermocouple, 1 - s times at the blackbody."""
    bias = Bias(0.6, (0.1, 0.3), 295.0, 0.3, (0.05, 0.15))
    curve, warm, step = response.curve(known, "9.5"), np.array([320.0]), 1e-3
    reading = 295.0 + 0.8 * (warm - 295.0)
    slopes = [
        np.diff([curve.counts(bias.corrected(reading + it)) for it in (-step, step)], axis=0),
        np.diff([bias.reflection(curve, warm + it) for it in (-step, step)], axis=0),
    ]
    effects = (bias.emitted(curve, warm, 0.2), bias.reflected(curve, warm, 0.2))
    for tolerance, slope, (scatter, common) in zip((0.6, 0.3), slopes, effects, strict=True):
        expected = slope[0] / (2 * step)  # count a kelvin of the reading
        np.testing.assert_allclose(scatter, 0.2 * expected, rtol=1e-6)
        np.testing.assert_allclose(common[0], tolerance / 3**0.5 * expected, rtol=1e-6)
    wrong = [replace(bias, contact=(m, m)).corrected(reading) for m in (0.2 - step, 0.2 + step)]
    contact = np.diff(wrong, axis=0)[0] / (2 * step) * 0.2 / 12**0.5 * curve.count_slope(warm)
    np.testing.assert_allclose(effects[0][1][1], contact, rtol=1e-5)


def test_no_convergence_is_an_error(known: xr.Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that is stopped before convergence raises an error with the band's name."""
    monkeypatch.setattr("dbthermal.calibration._ITERATIONS", 1)
    rng = np.random.default_rng(0)
    series = bench.bench_series(known, bench.OBJECTS[0], bench.Bench(), rng)
    with pytest.raises(ArithmeticError, match=r"No convergence in band '8-14': emissivity 0\."):
        calibration.fit_emissivity(series, known, STDS)


COLD = bench.Bench(object_temperatures=(300.0,))


test_bad_bias_and_bench = refused(
    lambda known, call: call(known),
    [
        (lambda _: Bias(object_tolerance=-0.5), "object_tolerance [K] -0.5. Must lie in [0.0, "),
        (lambda _: Bias(contact=(0.05, 0.0)), "Invalid contact (0.05, 0.0). Must be a range"),
        (lambda _: Bias(stray=(0.0, 1.0)), "Invalid stray (0.0, 1.0). Must be a range"),
        (lambda _: Bias(air_temperature=-20.0), "Invalid air_temperature [K] -20.0"),
        (
            lambda it: bench.reflector_series(it, bench.OBJECTS[0], COLD, np.random.default_rng(0)),
            "One must be 10.0 K above the air's 295.15 K",
        ),
        (
            lambda it: bench.compare_procedures(it, np.random.default_rng(0), repeats=1),
            "Invalid comparison of 5 samples, 1 times",
        ),
    ],
    "known",
)
