"""Comparisons: every method on the same pixels."""

import numpy as np
import xarray as xr

from reproduction import experiments


def test_medians_count_what_the_default_solves() -> None:
    """Medians omit pixels that the default does not solve, and count others' failures as worst."""
    rmse = [[0.1, 0.3, np.nan, 0.2], [1.0, np.nan, 90.0, 2.0]]
    parts = {
        "object_temperature_rmse": (("variant", "pixel"), rmse, {"units": "K"}),
        "emissivity_error": (("variant", "band", "pixel"), np.full((2, 2, 4), 0.05)),
        "status": (("variant", "pixel"), [[0, 0, 1, 0], [0, 4, 0, 0]]),
    }
    comparison = xr.Dataset(parts, {"variant": ["subspace", "other"]})
    medians = experiments.comparison.medians(comparison)
    expected = {"object_temperature_rmse": [0.2, 2.0], "solved": [0.75] * 2}
    for name, values in (expected | {"wrong": [0.0, 0.0]}).items():
        np.testing.assert_allclose(medians[name], values, rtol=0, atol=1e-12)
    lost = experiments.comparison.medians(comparison.isel(pixel=[1, 2]))
    assert np.isnan(lost["object_temperature_rmse"].sel(variant="other"))
