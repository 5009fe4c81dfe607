"""Band emissivities and the choice of a filter: closed forms, then the public libraries."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from refused import assert_refused, refused
from scipy.integrate import quad

from dbthermal import emissivity, planck, readers, schema
from dbthermal.bands import FILTERS, Band
from reproduction import libraries
from reproduction.filters import condition_numbers, pair_summary, rank_filters


def spectrum(wavelength_um: object, values: object) -> xr.Dataset:
    """Spectrum from wavelengths in micrometres, linear and without gaps between them."""
    ends, knots = np.asarray(values, dtype=float), np.asarray(wavelength_um, dtype=float)
    if np.all(np.diff(knots) > 0) and np.all(np.isfinite(ends)):
        within = np.arange(0.0, 20.0, 0.5)
        fine = np.union1d(knots, within[(within > knots[0]) & (within < knots[-1])])
        knots, ends = fine, np.interp(fine, knots, ends)
    return sparse(knots, ends)


def sparse(wavelength_um: object, values: object) -> xr.Dataset:
    """Spectrum of these wavelengths in micrometres alone."""
    wavelength = np.asarray(wavelength_um, dtype=float) * 1e-6
    return xr.Dataset(
        {"emissivity": ("wavelength", np.asarray(values, dtype=float))},
        coords={"wavelength": wavelength},
    )


def table(**rows: list[float]) -> xr.Dataset:
    """Table of materials by name, in the bands 8-14 and 9.5, and 8.5 where there is a third."""
    values = np.array(list(rows.values()))
    dims = ("material", "band")
    return xr.Dataset(
        {"emissivity": (dims, values), "coverage": (dims, np.ones_like(values))},
        coords={"material": list(rows), "band": ["8-14", "9.5", "8.5"][: values.shape[1]]},
    )


@pytest.fixture(scope="module")
def spectra(mirror: Path) -> dict[str, xr.Dataset]:
    """Every spectrum of the three libraries, by the embedded table's name."""
    paths = sorted((mirror / "ecostress").glob("*.spectrum.txt"))
    spectra = {path.name: readers.ecostress(path) for path in paths}
    slum = libraries.slum(mirror / "slum" / "LUMA_SLUM_IR.csv")
    spectra |= {f"LUMA_SLUM_IR.csv:{code}": sample for code, sample in slum.items()}
    others = sorted({*(mirror / "ucsb").glob("*.csv")} - {mirror / "ucsb" / "MANIFEST.csv"})
    return spectra | {path.name: libraries.ucsb(path) for path in others}


@given(st.floats(0.01, 1.05), st.floats(150.0, 1000.0))
def test_gray_stays_gray(value: float, temperature: float) -> None:
    """A gray body, unphysical or not, has its emissivity in every band, at every temperature."""
    made = emissivity.band_table({"gray": spectrum([7, 15], [value] * 2)}, FILTERS, temperature)
    np.testing.assert_allclose(made["emissivity"], value, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(made["coverage"], 1.0)


@pytest.mark.parametrize("band", FILTERS.values(), ids=FILTERS)
def test_average_against_quadrature(band: Band) -> None:
    """A kinked spectrum, its kinks off the band's edges, agrees with adaptive quadrature."""
    knots = [7.5, 8.31, 9.42, 10.07, 12.2, 13.3, 14.2]
    made = spectrum(knots, [0.9, 0.2, 0.8, 0.5, 0.95, 0.3, 0.7])
    fine = made["wavelength"].values

    def radiance(wavelength: float) -> float:
        return float(planck.spectral_radiance(wavelength * 1e-6, 320.0)) * 1e-6

    def emitted(wavelength: float) -> float:
        return radiance(wavelength) * float(np.interp(wavelength * 1e-6, fine, made["emissivity"]))

    edges = (band.lower * 1e6, band.upper * 1e6)
    kinks = [knot for knot in fine * 1e6 if edges[0] < knot < edges[1]] or None
    above, below = (
        quad(f, *edges, points=kinks, epsabs=0, epsrel=1e-11)[0] for f in (emitted, radiance)
    )
    result = emissivity.band_table({"kinked": made}, [band], 320.0)
    assert float(result["emissivity"][0, 0]) == pytest.approx(above / below, abs=1e-9)


def test_weight_moves_with_temperature() -> None:
    """A step at 10 um counts the share of the radiance beyond it, which falls as it gets hotter."""
    step = {"step": spectrum([8, 10 - 1e-9, 10 + 1e-9, 14], [0, 0, 1, 1])}
    for temperature in (250.0, 300.0, 600.0):
        upper, whole = (b.radiance(temperature) for b in (Band("", 10e-6, 14e-6), FILTERS["8-14"]))
        result = emissivity.band_table(step, ["8-14"], temperature)["emissivity"]
        assert float(result[0, 0]) == pytest.approx(float(upper / whole), abs=1e-8)


def test_short_spectrum_is_averaged_if_asked() -> None:
    """On request the average runs over the covered part, and the result states its share."""
    short = {"metal": spectrum([8, 12.5], [0.1, 0.4]), "whole": spectrum([8, 14], [0.1, 0.5])}
    made = emissivity.band_table(short, FILTERS, minimum_coverage=0.7)
    alone = emissivity.band_table(short, [Band("part", 8e-6, 12.5e-6)])
    radiances = [float(Band("", 8e-6, end).radiance(300.0)) for end in (12.5e-6, 14e-6)]
    covered = float(alone["emissivity"][0, 0])
    assert float(made["emissivity"][0, 0]) == pytest.approx(covered, abs=1e-12)
    assert float(made["coverage"][0, 0]) == pytest.approx(radiances[0] / radiances[1], abs=1e-12)
    np.testing.assert_array_equal(made["coverage"].sel(material="whole"), 1.0)


SHORT, METAL = spectrum([8, 11], [1, 1]), spectrum([0.3, 12.5], [0.1, 0.1])
BAD: list[tuple[dict[str, object], str]] = [
    ({"spectra": {}}, "Empty spectra"),
    ({"spectra": [1, 2]}, "Invalid spectra of type list"),
    ({"bands": []}, "Invalid bands []"),
    ({"bands": ["9.5", "9.5"]}, "Invalid bands ['9.5', '9.5']"),
    ({"bands": ["9.4"]}, "Unknown band '9.4'"),
    ({"bands": "9.4"}, "Unknown band '9.4'"),
    ({"bands": ["9.5", 8.5]}, "Invalid band 8.5"),
    ({"spectra": {"%": spectrum([8, 14], [86.0, 86.0])}}, "Invalid emissivity 86.0 of '%'"),
    (
        {"spectra": {"metal": METAL}},
        "coverage 0.7808 of band '8-14' by the spectrum of 'metal', 3e-",
    ),
    (
        {"spectra": {"m": SHORT}, "bands": ["12.1"], "minimum_coverage": 1e-9},
        "0.0000 of band '12.1'",
    ),
    ({"spectra": {"holed": spectrum([8, 9, 14], [1, np.nan, 1])}}, "nan of 'holed' at 9e-06 m"),
    ({"spectra": {"turned": spectrum([14, 8], [1, 1])}}, "Unordered 'wavelength'"),
    ({"temperature": 27.0}, "Invalid temperature [K] in band '8-14' 27.0"),
    ({"minimum_coverage": 0.0}, "Invalid minimum_coverage 0.0"),
    ({"minimum_coverage": 1.1}, "Invalid minimum_coverage 1.1"),
]


WHOLE: dict[str, Any] = {"spectra": {"m": spectrum([8, 14], [1, 1])}, "bands": FILTERS}
test_bad_arguments = refused(lambda change: emissivity.band_table(**(WHOLE | change)), BAD)


def test_pair_summary_leaves_gray_out_of_the_mean() -> None:
    """A gray material is infinite in the median, not in the mean, and is counted."""
    numbers = condition_numbers(table(a=[0.9, 0.5], b=[0.8, 0.8], c=[0.9, 0.7]))
    summary = pair_summary(numbers)
    values = np.sort(numbers.values[:, 0, 1])
    assert summary["median"].values[0, 1] == values[1]
    assert summary["mean"].values[0, 1] == pytest.approx(values[:2].mean(), abs=1e-12)
    assert summary["finite"].values.tolist() == [[0, 2], [2, 0]]
    np.testing.assert_array_equal(np.diag(summary["mean"]), np.inf)


def test_noise_behind_filters() -> None:
    """At 300 K a filter of half a micrometre at 9.5 um makes 30 mK ten times as much."""
    noise = emissivity.filter_noise(0.03, FILTERS)
    expected = [0.03, 0.279, 0.299, 0.113, 0.420]  # from the integral of dL/dT over each band
    np.testing.assert_allclose(noise, expected, rtol=0, atol=0.0005)
    assert noise.attrs["units"] == "K"


def test_single_frame_std() -> None:
    """Plate glass at 0.04 and 0.4 K: 0.41 K; gray: infinite; others: the scatter of solutions."""
    noise = xr.DataArray([0.04, 0.4], coords={"band": ["8-14", "9.5"]}, dims="band")
    drawn = np.random.default_rng(2).standard_normal((2, 200_000)) * noise.values[:, np.newaxis]
    scatter = np.linalg.solve(np.array([[0.3, 0.7], [0.5, 0.5]]), drawn)[0].std()
    for pair, expected in (([0.86, 0.72], 0.408), ([0.9, 0.9], np.inf), ([0.3, 0.5], scatter)):
        choice = rank_filters(table(m=pair), noise)
        assert choice["band"].values.tolist() == ["9.5"]
        assert float(choice["object_temperature_std"][0]) == pytest.approx(expected, rel=0.01)


def test_choice_weighs_condition_against_noise() -> None:
    """Filters are ordered by condition number; the lowest deviation may belong to another."""
    made = table(a=[0.90, 0.70, 0.75], b=[0.85, 0.60, 0.66])
    noise = xr.DataArray([0.03, 0.6, 0.1], coords={"band": made["band"]}, dims="band")
    choice = rank_filters(made, noise)
    assert choice["band"].values.tolist() == ["9.5", "8.5"]
    assert choice["condition_number"].values[0] < choice["condition_number"].values[1]
    assert choice.attrs["lowest_condition_number"] == "9.5"
    assert choice.attrs["lowest_std"] == "8.5"


def noise_of(*values: float, units: str = "K") -> xr.DataArray:
    """Noise of the first of both bands."""
    names = {"band": ["8-14", "9.5"][: len(values)]}
    return xr.DataArray(list(values), names, dims="band", attrs={"units": units})


GLASSY, PERCENT = table(glass=[0.86, 0.72]), table(glass=[86.0, 72.0])


test_tables_that_rank_no_filter = refused(
    lambda call, *arguments: call(*arguments),
    [
        (rank_filters, GLASSY, noise_of(0.03), "Missing band '9.5' in the noise"),
        (rank_filters, GLASSY, noise_of(0.03, 0.0), "Invalid noise [K] 0.0"),
        (rank_filters, GLASSY, noise_of(0.03, np.nan), "Invalid noise [K] nan"),
        (rank_filters, GLASSY, noise_of(3.0, 3.0, units="count"), "units 'count' of the noise"),
        (rank_filters, PERCENT, noise_of(0.03, 0.03), "Invalid emissivity of the table 86"),
        (partial(rank_filters, beside="10.6"), GLASSY, noise_of(0.03, 0.03), "Must hold '10.6'"),
        (condition_numbers, table(m=[0.9]), "Must be at least two"),
        (pair_summary, np.ones(3), "Invalid condition numbers of type ndarray"),
        (emissivity.filter_noise, "0.03", ["8-14"], "Invalid noise [K] '0.03'"),
        (emissivity.library_mixture, ["x"], "Invalid bands ['x'] of the library's emissivities"),
    ],
)


def test_embedded_table_is_whole() -> None:
    """The embedded table has 25 materials of three libraries in five bands."""
    made = schema.check(emissivity.embedded_table(), "emissivity_table")
    assert dict(made.sizes) == {"material": 25, "band": 5}
    assert made["band"].values.tolist() == list(FILTERS)
    assert len(set(made["material"].values)) == 25
    assert ((made["emissivity"] > 0) & (made["emissivity"] < 1)).all()
    assert {*made["library"].values} == {"ECOSTRESS 1.0", "SLUM 1.0", "MODIS UCSB"}
    glass = made["emissivity"].sel(material="plate window glass", band=["8-14", "9.5"])
    np.testing.assert_allclose(glass, [0.861, 0.718], rtol=0, atol=0.002)
    text = Path(emissivity.__file__).with_name("emissivity_table.csv").read_text("utf-8")
    for credit in ("courtesy of the Jet Propulsion", "doi:10.1016/j.isprsjprs.2014.05.005"):
        assert credit in text


def test_tables_lack_a_new_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """A filter without columns in the packaged tables raises an error that names table and rule."""
    wide = {**FILTERS, "8.6": Band("8.6", 8e-6, 9.2e-6)}
    monkeypatch.setattr(emissivity, "FILTERS", wide)
    for call, table in (
        (emissivity.embedded_table, "table"),
        (lambda: emissivity.library_mixture(["8-14"]), "mixture"),
    ):
        assert_refused(f"of 'emissivity_{table}.csv'. Must begin with .*8.6", call)


@pytest.mark.data
def test_embedded_table_from_the_libraries(spectra: dict[str, xr.Dataset]) -> None:
    """Each row is what the libraries give, to its last decimal."""
    made = emissivity.embedded_table()
    sources = dict(zip(made["material"].values, made["source"].values, strict=True))
    chosen = {material: spectra[source] for material, source in sources.items()}
    again = emissivity.band_table(chosen, FILTERS, minimum_coverage=0.7)
    for name in ("emissivity", "coverage"):
        np.testing.assert_allclose(made[name], again[name], rtol=0, atol=5.01e-5)


def test_library_mixture_is_a_distribution() -> None:
    """Its weights add up to 1, its covariances are positive, and bands go by name."""
    mixture = emissivity.library_mixture(["9.5", "8-14"])
    assert float(mixture["weight"].sum()) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.eigvalsh(mixture["covariance"]).min() > 0
    other = emissivity.library_mixture(["8-14", "9.5"]).sel(band=["9.5", "8-14"])
    np.testing.assert_array_equal(mixture["mean"], other["mean"])


@pytest.mark.data
def test_library_mixture_has_the_moments_of_the_libraries(spectra: dict[str, xr.Dataset]) -> None:
    """Mean and covariance of all spectra, but for the wide component, and its floor of 0.005."""
    made = emissivity.band_table(spectra, FILTERS, minimum_coverage=0.7)["emissivity"].values
    mixture = emissivity.library_mixture(FILTERS).isel(component=slice(-1))
    weight, mean = mixture["weight"].values / mixture["weight"].values.sum(), mixture["mean"].values
    centre = weight @ mean
    off = mean - centre
    covariance = np.tensordot(weight, mixture["covariance"].values, 1) + (weight * off.T) @ off
    np.testing.assert_allclose(centre, made.mean(axis=0), rtol=0, atol=1e-3)
    expected = np.cov(made.T) + 0.005**2 * np.eye(5)
    np.testing.assert_allclose(covariance, expected, rtol=0, atol=2e-4)


@pytest.mark.data
def test_every_spectrum_of_the_libraries(spectra: dict[str, xr.Dataset]) -> None:
    """All 993 make a table, six beyond [0, 1]; 224 differ by 0.05 between the two bands."""
    assert sum(one.attrs["unphysical_values"] > 0 for one in spectra.values()) == 6
    assert min(float(one["wavelength"][-1]) for one in spectra.values()) > 12.39e-6
    made = emissivity.band_table(spectra, FILTERS, minimum_coverage=0.7)
    short = made["coverage"].sel(band="8-14") < emissivity.MINIMUM_COVERAGE
    difference = made["emissivity"].sel(band="8-14") - made["emissivity"].sel(band="9.5")
    assert (made.sizes["material"], int(short.sum())) == (993, 22)
    assert int((abs(difference) > 0.05).sum()) == 224
    assert float(made["coverage"].drop_sel(band="8-14").min()) == 1.0


@pytest.mark.data
def test_filter_of_the_paper(spectra: dict[str, xr.Dataset]) -> None:
    """The lowest condition number belongs to the filter at 9.5 um, as published."""
    whole = {name: one for name, one in spectra.items() if one["wavelength"][-1] > 13e-6}
    made = emissivity.band_table(whole, FILTERS)
    choice = rank_filters(made, emissivity.filter_noise(0.03, FILTERS))
    assert choice.attrs["lowest_condition_number"] == "9.5"
    assert float(choice["condition_number"][0]) == pytest.approx(98.9, abs=0.5)


def test_gap_is_not_covered() -> None:
    """Nothing is known across a gap of more than 1 um, nor between the two ends of a spectrum."""
    whole = np.arange(6.0, 16.01, 0.1)
    holed = whole[(whole < 8.55) | (whole > 13.45)]
    for knots, share in ((holed, "0.1"), ([6.0, 16.0], "0.0000")):
        with pytest.raises(ValueError, match=f"Invalid coverage {share}.* without gaps"):
            emissivity.band_table({"m": sparse(knots, np.sin(knots) ** 2)}, ["8-14"])
    made = emissivity.band_table({"m": sparse(holed, holed / 20)}, ["8-14"], minimum_coverage=0.1)
    parts = [Band("low", 8e-6, 8.5e-6), Band("high", 13.5e-6, 14e-6)]
    weights = np.array([float(part.radiance(300.0)) for part in parts])
    alone = emissivity.band_table({"m": sparse(whole, whole / 20)}, parts)["emissivity"].values[0]
    expected = weights @ alone / weights.sum()
    assert float(made["emissivity"][0, 0]) == pytest.approx(expected, abs=1e-3)
    share = weights.sum() / float(FILTERS["8-14"].radiance(300.0))
    assert float(made["coverage"][0, 0]) == pytest.approx(share, abs=1e-2)
    coarse = emissivity.band_table({"m": sparse(np.arange(7.0, 16.0), np.full(9, 0.5))}, FILTERS)
    np.testing.assert_array_equal(coarse["coverage"], 1.0)
