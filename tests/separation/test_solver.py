"""`solve` for all methods: settings, randomness, tiles and unusable pixels."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import response as responses
from dbthermal import separation, simulation
from dbthermal.simulation import Rig

TIME = np.arange(60) / 10.0  # s


@pytest.fixture(scope="module")
def scene() -> xr.Dataset:
    """Four rows of six pixels of plate glass."""
    emissivity = xr.DataArray([0.86, 0.72], dims="band", coords={"band": ["8-14", "9.5"]})
    return simulation.walkers(TIME, (4, 6), emissivity, np.random.default_rng(1), crossings=2)


@pytest.fixture(scope="module")
def capture(scene: xr.Dataset) -> xr.Dataset:
    """Corrected counts of the scene."""
    return simulation.observe(scene, Rig().response(), np.random.default_rng(2))


@pytest.mark.parametrize("method", ["naive", "dbvt"])
def test_random_starts_hang_on_the_seed_alone(capture: xr.Dataset, method: str) -> None:
    """Random starts depend on the seed: the same one repeats the result, another changes it."""
    response = Rig().response()
    few = separation.DbvtSettings(steps=3, stages=1) if method == "dbvt" else None
    first, again, other = (
        separation.solve(capture, response, method, settings=few, seed=seed)["emissivity"]
        for seed in (1, 1, 2)
    )
    xr.testing.assert_identical(first, again)
    assert float(abs(first - other).max()) > 1e-6


BAD: dict[str, tuple[str, dict[str, Any], type[Exception], str]] = {
    "settings of another": (
        "naive",
        {"settings": separation.RatioSettings()},
        TypeError,
        "Invalid settings of type RatioSettings for method 'naive'. Must be NaiveSettings",
    ),
    "negative seed": ("naive", {"seed": -1}, ValueError, "Invalid seed -1. Must be zero or"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_settings_are_named(capture: xr.Dataset, case: str) -> None:
    """An error names the field, the value and the rule."""
    method, arguments, error, message = BAD[case]
    with pytest.raises(error, match=message):
        separation.solve(capture, Rig().response(), method, **arguments)


def test_progress_is_shown(capture: xr.Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    """A bar counts the pixels, on request."""
    separation.solve(capture, Rig().response(), progress=True)
    assert "subspace: 100%" in capsys.readouterr().err
    separation.solve(capture, Rig().response())
    assert capsys.readouterr().err == ""


def test_options_are_recorded(capture: xr.Dataset) -> None:
    """The result records the settings of its method."""
    result = separation.solve(
        capture, Rig().response(), "ratio", settings=separation.RatioSettings("narrow")
    )
    assert "kind='narrow'" in result.attrs["settings"]


def test_apparent_is_the_reading_of_the_quieter_band(capture: xr.Dataset) -> None:
    """Method "apparent" gives the blackbody temperature of the quieter band's counts."""
    response = Rig().response()
    found = separation.solve(capture, response, "apparent")["object_temperature"]
    counts = responses.curve(response, "8-14").counts(found.values.astype(np.float64))
    np.testing.assert_allclose(counts, capture["counts"][0], rtol=0, atol=0.05)  # [count]
