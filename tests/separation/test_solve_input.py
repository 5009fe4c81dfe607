"""Input of `solve`: order of bands, randomness, and what is recorded of it."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import response as responses
from dbthermal import separation
from dbthermal.simulation import Rig

RIG = Rig()
TIME = np.arange(350) / 10.0


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def test_order_of_bands_and_tiles_does_not_matter(glass: Glass) -> None:
    """The same pixels give the same values with the bands exchanged, and one by one."""
    _, capture, response = glass
    whole = separation.solve(capture, response)
    exchanged = separation.solve(capture.isel(band=[1, 0]), response).sel(band=list(RIG.bands))
    single = separation.solve(capture.isel(y=[2], x=[3]), response)
    # The prior's spectrum is a small difference: it feels the rounding of single precision.
    for name in (
        "object_temperature",
        "emissivity",
        "reflection_ratio",
        "background_temperature_std",
    ):
        one, pixel = single[name].values[..., 0, 0], whole[name].values[..., 2, 3]
        np.testing.assert_array_equal(exchanged[name].values, whole[name].values)
        np.testing.assert_allclose(one, pixel, rtol=2e-3 if name.endswith("std") else 1e-5)


@pytest.mark.parametrize("method", ["naive", "dbvt"])
def test_random_starts_hang_on_the_seed_alone(glass: Glass, method: str) -> None:
    """Random starts depend on the seed: the same one repeats the result, another changes it."""
    capture, response = glass[1].isel(time=slice(0, 60)), glass[2]
    few = separation.DbvtSettings(steps=3, stages=1) if method == "dbvt" else None
    first, again, other = (
        separation.solve(capture, response, method, settings=few, seed=seed)["emissivity"]
        for seed in (1, 1, 2)
    )
    xr.testing.assert_identical(first, again)
    assert float(abs(first - other).max()) > 1e-6


def test_progress_is_shown(glass: Glass, capsys: pytest.CaptureFixture[str]) -> None:
    """A bar counts the pixels, on request."""
    _, capture, response = glass
    separation.solve(capture, response, progress=True)
    assert "subspace: 100%" in capsys.readouterr().err
    separation.solve(capture, response)
    assert capsys.readouterr().err == ""


def test_options_are_recorded(glass: Glass) -> None:
    """The result records the settings of its method."""
    settings = separation.RatioSettings("narrow")
    result = separation.solve(*glass[1:], "ratio", settings=settings)
    assert "kind='narrow'" in result.attrs["settings"]


def test_apparent_is_the_reading_of_the_quieter_band(glass: Glass) -> None:
    """Method "apparent" gives the blackbody temperature of the quieter band's counts."""
    _, capture, response = glass
    found = separation.solve(capture, response, "apparent")["object_temperature"]
    counts = responses.curve(response, "8-14").counts(found.values.astype(np.float64))
    np.testing.assert_allclose(counts, capture["counts"][0], rtol=0, atol=0.05)  # [count]
