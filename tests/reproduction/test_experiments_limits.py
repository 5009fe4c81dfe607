"""Experiments on limits and nuisances: known numbers; notebooks 10 and 11 assert what they find."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from refused import refused

from reproduction.experiments import limits, nuisances

GLASS, PAIR = [0.86, 0.72], ["8-14", "9.5"]
COMMON = {"ends": [20.0, 45.0], "clock": [350, 10.0]}
VIEWS: dict[str, Any] = {"shape": [24, 32], "clock": [50, 10.0], "seed": 1}


@pytest.mark.parametrize(
    ("moved", "right", "bleeding"), [(0, 1.0, 0), (2, 1.0, 0), (5, 1 - 3 / 36, 1), (None, 0.0, 0)]
)
def test_border_is_judged_beyond_two_pixels(moved: int | None, right: float, bleeding: int) -> None:
    """A border two pixels off is kept; five off, three columns of 36 bleed; without labels 0."""
    columns = xr.DataArray(np.indices((10, 40))[1], dims=("y", "x"))
    labels = columns * 0 - 1 if moved is None else (columns >= 20 + moved).astype(int)
    kept = limits.border_kept(labels, (columns >= 20).astype(int))
    assert float(kept["right"]) == pytest.approx(right, abs=1e-12)
    assert int(kept["bleeding"]) == bleeding


test_experiments_that_cannot_be_made = refused(
    lambda call: call(),
    [
        (
            lambda: limits.pooled([3], GLASS, pixels=400, seed=1, **COMMON),
            "Invalid size 3 of a group. Must divide the 400 pixels",
        ),
        (
            lambda: nuisances.disturbed("rain", pixels={}, nuisance={}, seed=1),
            "Unknown nuisance 'rain'. Must be one of",
        ),
        (
            lambda: nuisances.parallax(0.1, shift=[0.0, 0.0], **VIEWS),
            "Must be multiples of 1/4 along x",
        ),
        (lambda: nuisances.parallax(1.0, shift=[12.0, 0.0], **VIEWS), "within 12 together"),
    ],
)
