"""Comparisons: every method on the same pixels."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from reproduction import experiments

PLATE: dict[str, Any] = {"frames": 120, "shape": [10, 24], "crossings": 6}
VARIANTS: dict[str, dict[str, Any]] = {
    "subspace": {"method": "subspace"},
    "calibrated": {"method": "calibrated"},
    "prior": {"method": "bcp"},
}
CELL: dict[str, Any] = {
    "emissivity": [0.86, 0.72],
    "noise": [0.03, 0.35],
    "variants": VARIANTS,
    "plate": PLATE,
    "pixels": 20,
    "seed": 2,
}


def test_all_methods_see_the_same_pixels() -> None:
    """Every method has its errors at each pixel; known emissivities have no error."""
    found = experiments.compare(**CELL)
    assert found.attrs["origin"] == "simulated"
    assert dict(found.sizes) == {"variant": 3, "pixel": 20, "band": 2}
    assert float(found["emissivity_error"].sel(variant="calibrated").max()) < 1e-6
    assert np.all(found["object_temperature_rmse"].sel(variant="prior") > 0)


def test_pixels_without_reflection_take_no_part() -> None:
    """More pixels than have a moving reflection raise an error with their number."""
    with pytest.raises(ValueError, match=r"Invalid number of pixels 240\. Must be at most"):
        experiments.compare(**{**CELL, "pixels": 240})


def test_medians_count_what_the_default_solves() -> None:
    """Medians omit pixels that the default does not solve, and count others' failures as worst."""
    rmse = [[0.1, 0.3, np.nan, 0.2], [1.0, np.nan, 90.0, 2.0]]
    comparison = xr.Dataset(
        {
            "object_temperature_rmse": (("variant", "pixel"), rmse, {"units": "K"}),
            "emissivity_error": (
                ("variant", "band", "pixel"),
                np.full((2, 2, 4), 0.05),
                {"units": "1"},
            ),
            "status": (("variant", "pixel"), [[0, 0, 1, 0], [0, 4, 0, 0]]),
        },
        coords={"variant": ["subspace", "other"]},
    )
    found = experiments.medians(comparison)
    np.testing.assert_allclose(found["object_temperature_rmse"], [0.2, 2.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["solved"], [0.75, 0.75], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["good"], [0.75, 0.75], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found["wrong"], [0.0, 0.0])
    lost = experiments.medians(comparison.isel(pixel=[1, 2]))
    assert np.isnan(lost["object_temperature_rmse"].sel(variant="other"))
