"""Comparisons: every method on the same pixels."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from reproduction import experiments

VARIANTS = {"calibrated": "calibrated", "prior": "bcp"}
CELL: dict[str, Any] = {
    "emissivity": [0.86, 0.72],
    "noise": [0.03, 0.35],
    "variants": {name: {"method": method} for name, method in VARIANTS.items()},
    "plate": {"frames": 120, "shape": [10, 24], "crossings": 6},
    "pixels": 20,
    "seed": 2,
}


def test_all_methods_see_the_same_pixels() -> None:
    """Every method has its errors at each pixel that has a reflection; others take no part."""
    compared = experiments.compare(**CELL)
    assert compared.attrs["origin"] == "simulated"
    assert dict(compared.sizes) == {"variant": 2, "pixel": 20, "band": 2}
    assert float(compared["emissivity_error"].sel(variant="calibrated").max()) < 1e-6
    assert np.all(compared["object_temperature_rmse"].sel(variant="prior") > 0)
    with pytest.raises(ValueError, match=r"Invalid number of pixels 240\. Must be at most"):
        experiments.compare(**{**CELL, "pixels": 240})


def test_medians_count_what_the_default_solves() -> None:
    """Medians omit pixels that the default does not solve, and count others' failures as worst."""
    rmse = [[0.1, 0.3, np.nan, 0.2], [1.0, np.nan, 90.0, 2.0]]
    parts = {
        "object_temperature_rmse": (("variant", "pixel"), rmse, {"units": "K"}),
        "emissivity_error": (("variant", "band", "pixel"), np.full((2, 2, 4), 0.05)),
        "status": (("variant", "pixel"), [[0, 0, 1, 0], [0, 4, 0, 0]]),
    }
    comparison = xr.Dataset(parts, {"variant": ["subspace", "other"]})
    medians = experiments.medians(comparison)
    expected = {"object_temperature_rmse": [0.2, 2.0], "solved": [0.75] * 2, "good": [0.75] * 2}
    for name, values in (expected | {"wrong": [0.0, 0.0]}).items():
        np.testing.assert_allclose(medians[name], values, rtol=0, atol=1e-12)
    lost = experiments.medians(comparison.isel(pixel=[1, 2]))
    assert np.isnan(lost["object_temperature_rmse"].sel(variant="other"))
